//! The traversal, written once over [`Lanes`].

use picofarm_scene::Vec3;

use crate::scene::bvh::{
    lanes::Lanes,
    nodes::{EMPTY, LEAF, packs},
    tree::Bvh,
};

/// Returns 1/x. 1/0 would give 0·∞ = NaN in the slab test, so a huge finite slope replaces it.
#[inline(always)]
pub(crate) fn inverse(x: f32) -> f32 {
    1.0 / if x.abs() < 1e-18 {
        1e-18f32.copysign(x)
    } else {
        x
    }
}

/// Returns the axis of the largest component.
#[inline(always)]
pub(crate) fn largest(d: Vec3) -> usize {
    let (ax, ay, az) = (d.x.abs(), d.y.abs(), d.z.abs());
    if az >= ax && az >= ay {
        2
    } else if ay >= ax {
        1
    } else {
        0
    }
}

/// Returns the nearest hit (`ANY` = false) or some hit (`ANY` = true) with 0 < t ≤ `limit` below
/// node `root` (0: in the whole tree) as (t, triangle); triangle is [`EMPTY`] for a miss. The
/// caller has checked that ray and tree are usable and `stack` is deep enough.
#[inline(always)]
pub(crate) fn traverse<L: Lanes, const ANY: bool>(
    bvh: &Bvh,
    stack: &mut [(u32, f32)],
    root: u32,
    o: Vec3,
    d: Vec3,
    limit: f32,
) -> (f32, u32) {
    let iv = [
        L::splat(inverse(d.x)),
        L::splat(inverse(d.y)),
        L::splat(inverse(d.z)),
    ];
    let ov = [L::splat(o.x), L::splat(o.y), L::splat(o.z)];
    let sign = |x: f32| usize::from(x.is_sign_negative()) * 3;
    let near = [sign(d.x), 1 + sign(d.y), 2 + sign(d.z)];
    let far = [3 - sign(d.x), 4 - sign(d.y), 5 - sign(d.z)];
    let zero = L::splat(0.0);
    // A few ulp of slack on the far plane make the slab test watertight (Ize, JCGT 2013).
    let slack = L::splat(1.0 + 4.0 * f32::EPSILON);

    // Shear of Woop et al.: z is the ray's largest axis.
    let kz = largest(d);
    let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
    if d[kz] < 0.0 {
        std::mem::swap(&mut kx, &mut ky);
    }
    let (sx, sy, sz) = (
        L::splat(d[kx] / d[kz]),
        L::splat(d[ky] / d[kz]),
        L::splat(1.0 / d[kz]),
    );

    let (mut best, mut id) = (limit, EMPTY);
    let mut depth = 0;
    let mut current = root;
    'walk: loop {
        while current & LEAF == 0 {
            let node = &bvh.nodes[current as usize];
            let plane = |k: usize, a: usize| L::load(&node.bounds[k]).sub(ov[a]).mul(iv[a]);
            let t0 = plane(near[0], 0)
                .max(plane(near[1], 1))
                .max(plane(near[2], 2).max(zero));
            let t1 = plane(far[0], 0)
                .min(plane(far[1], 1))
                .min(plane(far[2], 2))
                .mul(slack)
                .min(L::splat(best));
            let mut mask = t0.le(t1);
            if mask == 0 {
                break;
            }
            let mut next = || {
                let i = mask.trailing_zeros() as usize & 7;
                mask &= mask - 1;
                (i, mask)
            };
            let (i, rest) = next();
            if rest == 0 {
                current = node.child[i];
                continue;
            }
            let mut t = [0.0; 8];
            t0.store(&mut t);
            let (j, mut rest) = next();
            let (first, second) = ((node.child[i], t[i]), (node.child[j], t[j]));
            if rest == 0 {
                let (go, keep) = if first.1 <= second.1 {
                    (first, second)
                } else {
                    (second, first)
                };
                bvh.prefetch::<L>(go.0);
                bvh.prefetch::<L>(keep.0);
                stack[depth] = keep;
                depth += 1;
                current = go.0;
                continue;
            }
            let base = depth;
            stack[depth] = first;
            stack[depth + 1] = second;
            depth += 2;
            bvh.prefetch::<L>(first.0);
            bvh.prefetch::<L>(second.0);
            while rest != 0 {
                let k;
                (k, rest) = next();
                bvh.prefetch::<L>(node.child[k]);
                stack[depth] = (node.child[k], t[k]);
                depth += 1;
            }
            if !ANY {
                // Insertion sort, farthest first.
                for a in base + 1..depth {
                    let x = stack[a];
                    let mut q = a;
                    while q > base && stack[q - 1].1 < x.1 {
                        stack[q] = stack[q - 1];
                        q -= 1;
                    }
                    stack[q] = x;
                }
            }
            depth -= 1;
            current = stack[depth].0;
        }
        if current & LEAF != 0 {
            for pack in &bvh.packs[packs(current)] {
                let at = |v: usize, k: usize| L::load(&pack.vertex[3 * v + k]).sub(ov[k]);
                let (az, bz, cz) = (at(0, kz), at(1, kz), at(2, kz));
                let (ax, ay) = (at(0, kx).sub(sx.mul(az)), at(0, ky).sub(sy.mul(az)));
                let (bx, by) = (at(1, kx).sub(sx.mul(bz)), at(1, ky).sub(sy.mul(bz)));
                let (cx, cy) = (at(2, kx).sub(sx.mul(cz)), at(2, ky).sub(sy.mul(cz)));
                let u = cx.mul(by).sub(cy.mul(bx));
                let v = ax.mul(cy).sub(ay.mul(cx));
                let w = bx.mul(ay).sub(by.mul(ax));
                let (low, high) = (u.min(v).min(w), u.max(v).max(w));
                let inside = zero.le(low) | high.le(zero);
                if inside == 0 {
                    continue;
                }
                let det = u.add(v).add(w);
                let t = sz.mul(u.mul(az).add(v.mul(bz)).add(w.mul(cz))).div(det);
                let crosses = inside & det.differs(zero);
                let mut hits = crosses & t.gt(zero) & t.le(L::splat(best));
                let mut needles = pack.needles(crosses);
                if hits | needles == 0 {
                    continue;
                }
                let mut distances = [0.0; 8];
                if !ANY || needles != 0 {
                    t.store(&mut distances);
                }
                let mut t = distances;
                while needles != 0 {
                    let k = needles.trailing_zeros() as usize & 7;
                    needles &= needles - 1;
                    t[k] = pack.exactly(k, o, d);
                    let hit = t[k] > 0.0 && t[k] <= best;
                    hits = hits & !(1 << k) | u32::from(hit) << k;
                }
                if ANY {
                    if hits == 0 {
                        continue;
                    }
                    return (0.0, 0);
                }
                while hits != 0 {
                    let k = hits.trailing_zeros() as usize & 7;
                    hits &= hits - 1;
                    if t[k] < best || (t[k] == best && pack.triangle(k) < id) {
                        best = t[k];
                        id = pack.triangle(k);
                    }
                }
            }
        }
        loop {
            if depth == 0 {
                break 'walk;
            }
            depth -= 1;
            if stack[depth].1 <= best {
                current = stack[depth].0;
                break;
            }
        }
    }
    (best, id)
}
