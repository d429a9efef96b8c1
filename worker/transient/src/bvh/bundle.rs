//! Bundles: segments from one point to many, traced together.
//!
//! What a single ray finds is "some leaf whose box it meets holds a triangle that it meets": rounding is
//! monotonic, so a ray that meets a box meets every box around it, and the tree above the leaves decides
//! nothing. A bundle may therefore reach the leaves in any way that misses none, as long as each pair of
//! ray and leaf, and of ray and triangle, is judged by the single ray's operations. Here the nodes are
//! culled by the pyramid around all rays, eight children at a time.

use picofarm_scene::Vec3;

use super::{
    Bvh, EMPTY, LEAF, Pack,
    lanes::Lanes,
    last_fill, packs,
    traverse::{inverse, largest, traverse},
    usable,
};

/// Rays in a bundle: bits of a mask.
const MOST: usize = 64;
/// Fewer rays go singly.
const FEWEST: usize = 3;
/// Relative margin of the pyramid: over thirty times the rounding error of a slab test.
const MARGIN: f32 = 4e-6;
/// Absolute margin, for numbers that underflow.
const TINY: f32 = 1e-30;

/// The class of a ray that is not usable.
const USELESS: u8 = 6;

/// Answers `occluded` for every segment from `o`; the tree has nodes. `E` has eight lanes.
#[inline(always)]
pub(super) fn bundle<E: Lanes, W: Lanes>(
    bvh: &Bvh,
    stack: &mut [(u32, f32)],
    o: Vec3,
    to: &[Vec3],
    blocked: &mut [bool],
) {
    for (to, blocked) in to.chunks(MOST).zip(blocked.chunks_mut(MOST)) {
        // Rays whose largest component is the same, with the same sign, make a bundle.
        let mut class = [USELESS; MOST];
        let mut present = 0u32;
        for (c, &p) in class.iter_mut().zip(to) {
            let d = p - o;
            if usable(o, d, 1.0) {
                let k = largest(d);
                *c = (2 * k) as u8 + u8::from(d[k] < 0.0);
            }
            present |= 1 << *c;
        }
        if present & (1 << USELESS) != 0 {
            for (b, _) in blocked.iter_mut().zip(class).filter(|(_, c)| *c == USELESS) {
                *b = true;
            }
            present &= !(1 << USELESS);
        }
        while present != 0 {
            let c = present.trailing_zeros() as u8;
            present &= present - 1;
            let mut index = [0u8; MOST];
            let mut count = 0;
            for i in 0..to.len() {
                index[count & (MOST - 1)] = i as u8;
                count += usize::from(class[i] == c);
            }
            let index = &index[..count];
            let done = (count >= FEWEST)
                .then(|| Rays::new::<W>(o, to, index, usize::from(c / 2), c % 2 == 1))
                .flatten();
            if let Some(rays) = done {
                let free = rays.trace::<E, W>(bvh, stack);
                for (k, &i) in index.iter().enumerate() {
                    blocked[usize::from(i)] = free >> k & 1 == 0;
                }
            } else {
                for &i in index {
                    let i = usize::from(i);
                    blocked[i] = traverse::<E, true>(bvh, stack, o, to[i] - o, 1.0).1 != EMPTY;
                }
            }
        }
    }
}

/// Rays of one class, ray by ray; lanes beyond the last ray repeat the first.
struct Rays {
    o: Vec3,
    count: usize,
    /// The largest axis, and the other two in the order of the shear.
    axes: [usize; 3],
    negative: bool,
    inverse: [[f32; MOST]; 3],
    /// Shear: x, y, z of Woop et al.
    shear: [[f32; MOST]; 3],
    /// The pyramid: range of x and of y at unit depth, and the largest depth.
    slope: [(f32, f32); 2],
    depth: f32,
}

impl Rays {
    /// `None` where the numbers are so large or small that the pyramid's margins would not hold.
    #[inline(always)]
    fn new<W: Lanes>(
        o: Vec3,
        to: &[Vec3],
        index: &[u8],
        kz: usize,
        negative: bool,
    ) -> Option<Self> {
        let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
        if negative {
            std::mem::swap(&mut kx, &mut ky);
        }
        let mut d = [[0.0f32; MOST]; 3];
        let padded = index.len().next_multiple_of(W::N);
        for k in 0..padded {
            let p = to[usize::from(*index.get(k).unwrap_or(&index[0]))] - o;
            (d[0][k], d[1][k], d[2][k]) = (p.x, p.y, p.z);
        }
        let mut rays = Self {
            o,
            count: index.len(),
            axes: [kx, ky, kz],
            negative,
            inverse: [[0.0; MOST]; 3],
            shear: [[0.0; MOST]; 3],
            slope: [(0.0, 0.0); 2],
            depth: 0.0,
        };
        for a in 0..3 {
            for k in 0..padded {
                rays.inverse[a][k] = inverse(d[a][k]);
            }
        }
        for k in 0..padded {
            rays.shear[0][k] = d[kx][k] / d[kz][k];
            rays.shear[1][k] = d[ky][k] / d[kz][k];
            rays.shear[2][k] = 1.0 / d[kz][k];
        }
        let range = |a: &[f32; MOST]| {
            let (mut low, mut high) = (W::load(a), W::load(a));
            for k in (W::N..padded).step_by(W::N) {
                low = low.min(W::load(&a[k..]));
                high = high.max(W::load(&a[k..]));
            }
            let (mut l, mut h) = ([0.0f32; 16], [0.0f32; 16]);
            low.store(&mut l);
            high.store(&mut h);
            let low = l[..W::N].iter().fold(f32::INFINITY, |a, &b| a.min(b));
            (
                low,
                h[..W::N].iter().fold(f32::NEG_INFINITY, |a, &b| a.max(b)),
            )
        };
        let (low, high) = range(&d[kz]);
        let (near, far) = if negative { (-high, -low) } else { (low, high) };
        let widest = o.x.abs().max(o.y.abs()).max(o.z.abs()).max(far);
        if !(near > 1e-9 && widest < 1e9) {
            return None;
        }
        rays.depth = far + far * MARGIN;
        // Components below 1e-18 count as that in the slab test.
        let least = 2e-18 / near;
        for a in 0..2 {
            let (low, high) = range(&rays.shear[a]);
            let (low, high) = if negative { (-high, -low) } else { (low, high) };
            rays.slope[a] = (
                low - (low.abs() * MARGIN + least),
                high + (high.abs() * MARGIN + least),
            );
        }
        Some(rays)
    }

    /// The rays that nothing blocks, as a mask.
    #[inline(always)]
    fn trace<E: Lanes, W: Lanes>(&self, bvh: &Bvh, stack: &mut [(u32, f32)]) -> u64 {
        let [kx, ky, kz] = self.axes;
        let (near, far) = if self.negative {
            (3 + kz, kz)
        } else {
            (kz, 3 + kz)
        };
        let sign = E::splat(if self.negative { -1.0 } else { 1.0 });
        let o = [E::splat(self.o.x), E::splat(self.o.y), E::splat(self.o.z)];
        let slope = self.slope.map(|(a, b)| (E::splat(a), E::splat(b)));
        let (zero, tiny) = (E::splat(0.0), E::splat(TINY));
        let deepest = E::splat(self.depth);
        let mut free = u64::MAX >> (MOST - self.count);
        let (mut current, mut depth) = (0u32, 0);
        loop {
            let node = &bvh.nodes[current as usize];
            let from_o = |k: usize, a: usize| E::load(&node.bounds[k]).sub(o[a]);
            let z0 = from_o(near, kz).mul(sign);
            let z1 = from_o(far, kz).mul(sign);
            let mut mask = z0.le(deepest) & zero.sub(tiny).le(z1);
            let (z0, z1) = (z0.max(zero), z1.min(deepest));
            for (a, (low, high)) in [kx, ky].into_iter().zip(slope) {
                let low = z0.mul(low).min(z1.mul(low)).sub(tiny);
                let high = z0.mul(high).max(z1.mul(high)).add(tiny);
                mask &= from_o(a, a).le(high) & low.le(from_o(3 + a, a));
            }
            while mask != 0 {
                let i = mask.trailing_zeros() as usize & 7;
                mask &= mask - 1;
                let child = node.child[i];
                if child & LEAF == 0 {
                    stack[depth].0 = child;
                    depth += 1;
                    continue;
                }
                let met = self.meet::<W>(&node.bounds, i, free);
                if met != 0 {
                    free &= !self.leaf::<E, W>(bvh, child, met);
                    if free == 0 {
                        return 0;
                    }
                }
            }
            if depth == 0 {
                return free;
            }
            depth -= 1;
            current = stack[depth].0;
        }
    }

    /// Which of the rays `of` meet box `i` of a node: the single ray's slab test, a lane for each ray.
    #[inline(always)]
    fn meet<W: Lanes>(&self, bounds: &[[f32; 8]; 6], i: usize, of: u64) -> u64 {
        let low: [W; 3] = std::array::from_fn(|a| W::splat(bounds[a][i] - self.o[a]));
        let high: [W; 3] = std::array::from_fn(|a| W::splat(bounds[3 + a][i] - self.o[a]));
        let slack = W::splat(1.0 + 4.0 * f32::EPSILON);
        let mut met = 0;
        for k in (0..self.count).step_by(W::N) {
            let lanes = of >> k & (u64::MAX >> (64 - W::N));
            if lanes == 0 {
                continue;
            }
            // Which plane is nearer depends on the sign; as min and max they are the same numbers.
            let plane = |a: usize| {
                let inverse = W::load(&self.inverse[a][k..]);
                let (p, q) = (low[a].mul(inverse), high[a].mul(inverse));
                (p.min(q), p.max(q))
            };
            let ((nx, fx), (ny, fy), (nz, fz)) = (plane(0), plane(1), plane(2));
            let t0 = nx.max(ny).max(nz.max(W::splat(0.0)));
            let t1 = fx.min(fy).min(fz).mul(slack).min(W::splat(1.0));
            met |= (u64::from(t0.le(t1)) & lanes) << k;
        }
        met
    }

    /// Which of the rays `of` meet a triangle of a leaf.
    #[inline(always)]
    fn leaf<E: Lanes, W: Lanes>(&self, bvh: &Bvh, leaf: u32, of: u64) -> u64 {
        let range = packs(leaf);
        let last = range.end - 1;
        let mut hit = 0;
        for p in range {
            let pack = &bvh.packs[p];
            let fill = if p == last { last_fill(leaf) } else { 8 };
            let left = of & !hit;
            // A register of triangles for each ray, or one of rays for each triangle?
            if left.count_ones() as usize <= fill * self.count.div_ceil(W::N) {
                hit |= self.by_ray::<E>(pack, left);
            } else {
                hit |= self.by_triangle::<W>(pack, fill, left);
            }
        }
        hit
    }

    #[inline(always)]
    fn by_ray<E: Lanes>(&self, pack: &Pack, mut of: u64) -> u64 {
        let [kx, ky, kz] = self.axes;
        let at = |v: usize, k: usize| E::load(&pack.vertex[3 * v + k]).sub(E::splat(self.o[k]));
        let vertices = std::array::from_fn(|v| [at(v, kx), at(v, ky), at(v, kz)]);
        let mut hit = 0;
        while of != 0 {
            let k = of.trailing_zeros() as usize & (MOST - 1);
            of &= of - 1;
            let shear = std::array::from_fn(|a| E::splat(self.shear[a][k]));
            hit |= u64::from(meets(&vertices, &shear) != 0) << k;
        }
        hit
    }

    #[inline(always)]
    fn by_triangle<W: Lanes>(&self, pack: &Pack, fill: usize, of: u64) -> u64 {
        let mut hit = 0;
        for lane in 0..fill {
            let at = |v: usize, k: usize| W::splat(pack.vertex[3 * v + k][lane] - self.o[k]);
            let vertices = std::array::from_fn(|v| {
                [
                    at(v, self.axes[0]),
                    at(v, self.axes[1]),
                    at(v, self.axes[2]),
                ]
            });
            for k in (0..self.count).step_by(W::N) {
                let lanes = (of & !hit) >> k & (u64::MAX >> (64 - W::N));
                if lanes == 0 {
                    continue;
                }
                let shear = std::array::from_fn(|a| W::load(&self.shear[a][k..]));
                hit |= (u64::from(meets(&vertices, &shear)) & lanes) << k;
            }
        }
        hit
    }
}

/// The triangle test of the single ray with limit 1: vertices relative to the origin, axes in the order
/// of the shear.
#[inline(always)]
fn meets<L: Lanes>(v: &[[L; 3]; 3], [sx, sy, sz]: &[L; 3]) -> u32 {
    let shear = |p: &[L; 3]| (p[0].sub(sx.mul(p[2])), p[1].sub(sy.mul(p[2])));
    let ((ax, ay), (bx, by), (cx, cy)) = (shear(&v[0]), shear(&v[1]), shear(&v[2]));
    let (az, bz, cz) = (v[0][2], v[1][2], v[2][2]);
    let zero = L::splat(0.0);
    let u = cx.mul(by).sub(cy.mul(bx));
    let v = ax.mul(cy).sub(ay.mul(cx));
    let w = bx.mul(ay).sub(by.mul(ax));
    let (low, high) = (u.min(v).min(w), u.max(v).max(w));
    let inside = zero.le(low) | high.le(zero);
    if inside == 0 {
        return 0;
    }
    let det = u.add(v).add(w);
    let t = sz.mul(u.mul(az).add(v.mul(bz)).add(w.mul(cz))).div(det);
    inside & det.differs(zero) & t.gt(zero) & t.le(L::splat(1.0))
}
