//! Bundles: segments from one point to many, traced together.
//!
//! A single ray's result is defined as "the ray hits the box of some leaf, and a triangle in that
//! leaf". Rounding is monotonic, so a ray that hits a box hits every box around it, and the
//! tree above the leaves does not affect the result. A bundle may therefore reach the leaves in any
//! order that misses none, as long as each pair of ray and leaf, and of ray and triangle, is tested
//! by the single ray's operations. Here a [`Pyramid`] around all rays culls the nodes, eight
//! children at a time, and the rays themselves cull the remaining ones: each entry on the stack
//! stores a mask of the rays that hit it. The finer a mesh is, the more nodes intersect a pyramid
//! alone, while the rays within it hit few of them.

use picofarm_scene::Vec3;

use crate::scene::bvh::{
    lanes::Lanes,
    nodes::{EMPTY, LEAF},
    pyramid::Pyramid,
    rays::{Column, MOST, Rays},
    traverse::{inverse, traverse},
    tree::{Bvh, Stack},
};

/// Least number of rays in a bundle; fewer rays are traced singly.
pub(crate) const FEWEST: usize = 6;

/// If at most this many rays are left at a node, they are traced singly from there.
const LAST: u32 = 2;

/// Computes `occluded` for every segment from `o`. The tree has nodes, and `E` has eight lanes.
#[inline(always)]
pub(crate) fn bundle<E: Lanes, W: Lanes>(
    bvh: &Bvh,
    stack: &mut Stack,
    o: Vec3,
    to: &[Vec3],
    blocked: &mut [bool],
) {
    let Stack {
        entries,
        masks,
        bundle,
        ..
    } = stack;
    for (to, blocked) in to.chunks(MOST).zip(blocked.chunks_mut(MOST)) {
        let [x, y, z] = &mut bundle.all;
        for (((x, y), z), p) in x.iter_mut().zip(y).zip(z).zip(to) {
            (*x, *y, *z) = (p.x - o.x, p.y - o.y, p.z - o.z);
        }
        let whole = u64::MAX >> (MOST - to.len());
        let (usable, classes) = classes::<W>(o, &bundle.all, to.len());
        let mut free = 0;
        for (class, mask) in classes.into_iter().enumerate() {
            let mask = mask & usable & whole;
            if mask == 0 {
                continue;
            }
            if mask.count_ones() as usize >= FEWEST {
                bundle.rays.take(o, &bundle.all, mask, class);
                if let Some(pyramid) = bundle.rays.prepare::<W>() {
                    let left = trace::<E, W>(&bundle.rays, &pyramid, bvh, (entries, masks));
                    free |= spread(left, mask);
                    continue;
                }
            }
            let mut rest = mask;
            while rest != 0 {
                let i = rest.trailing_zeros() as usize & (MOST - 1);
                rest &= rest - 1;
                let d = Vec3::new(bundle.all[0][i], bundle.all[1][i], bundle.all[2][i]);
                let hit = traverse::<E, true>(bvh, entries, 0, o, d, 1.0).1 != EMPTY;
                free |= u64::from(!hit) << i;
            }
        }
        for (i, b) in blocked.iter_mut().enumerate() {
            *b = free >> i & 1 == 0;
        }
    }
}

/// Moves bit k of `bits` to the k-th set bit of `mask`.
#[inline(always)]
fn spread(mut bits: u64, mut mask: u64) -> u64 {
    if mask & mask.wrapping_add(1) == 0 {
        return bits;
    }
    let mut out = 0;
    while mask != 0 {
        let lowest = mask & mask.wrapping_neg();
        out |= lowest * (bits & 1);
        bits >>= 1;
        mask ^= lowest;
    }
    out
}

/// Returns masks of the rays that are usable (by the single ray's rule), and of those with their
/// largest component on +x, −x, +y, −y, +z, −z. Bits from `count` on are arbitrary.
#[inline(always)]
fn classes<W: Lanes>(o: Vec3, d: &[Column; 3], count: usize) -> (u64, [u64; 6]) {
    let zero = W::splat(0.0);
    let (most, least) = (W::splat(f32::MAX), W::splat(f32::MIN));
    let sum = W::splat(o.x + o.y + o.z);
    let (mut usable, mut classes) = (0, [0u64; 6]);
    for k in (0..count).step_by(W::N) {
        let (x, y, z) = (
            W::load(&d[0][k..]),
            W::load(&d[1][k..]),
            W::load(&d[2][k..]),
        );
        let sum = sum.add(x).add(y).add(z);
        let dot = x.mul(x).add(y.mul(y)).add(z.mul(z));
        let good = sum.le(most) & least.le(sum) & dot.gt(zero);
        usable |= u64::from(good) << k;
        let ax = x.max(zero.sub(x));
        let ay = y.max(zero.sub(y));
        let az = z.max(zero.sub(z));
        let on_z = ax.le(az) & ay.le(az);
        let on_y = ax.le(ay) & !on_z;
        let on_x = !on_z & !on_y & (u32::MAX >> (32 - W::N));
        let (nx, ny, nz) = (zero.gt(x), zero.gt(y), zero.gt(z));
        classes[0] |= u64::from(on_x & !nx) << k;
        classes[1] |= u64::from(on_x & nx) << k;
        classes[2] |= u64::from(on_y & !ny) << k;
        classes[3] |= u64::from(on_y & ny) << k;
        classes[4] |= u64::from(on_z & !nz) << k;
        classes[5] |= u64::from(on_z & nz) << k;
    }
    (usable, classes)
}

impl Rays {
    /// Copies the rays of `mask`, all of one class.
    #[inline(always)]
    fn take(&mut self, o: Vec3, all: &[Column; 3], mask: u64, class: usize) {
        let kz = class / 2;
        self.o = o;
        self.negative = class % 2 == 1;
        self.axes = [(kz + 1) % 3, (kz + 2) % 3, kz];
        if self.negative {
            self.axes.swap(0, 1);
        }
        self.count = mask.count_ones() as usize;
        if mask & mask.wrapping_add(1) == 0 {
            for (d, all) in self.d.iter_mut().zip(all) {
                d.copy_from_slice(all);
            }
        } else {
            let mut rest = mask;
            for k in 0..self.count {
                let i = rest.trailing_zeros() as usize & (MOST - 1);
                rest &= rest - 1;
                self.d[0][k] = all[0][i];
                self.d[1][k] = all[1][i];
                self.d[2][k] = all[2][i];
            }
        }
    }

    /// Computes slopes and shears, and the pyramid. Returns `None` if the numbers are so large or
    /// small that the pyramid's margins are not valid.
    #[inline(always)]
    fn prepare<W: Lanes>(&mut self) -> Option<Pyramid> {
        let padded = self.count.next_multiple_of(W::N);
        for d in &mut self.d {
            let first = d[0];
            d[self.count..padded].fill(first);
        }
        let [kx, ky, kz] = self.axes;
        for k in (0..padded).step_by(W::N) {
            for (out, d) in self.inverse.iter_mut().zip(&self.d) {
                for (out, d) in out[k..k + W::N].iter_mut().zip(&d[k..k + W::N]) {
                    *out = inverse(*d);
                }
            }
            let z = W::load(&self.d[kz][k..]);
            W::load(&self.d[kx][k..])
                .div(z)
                .store(&mut self.shear[0][k..]);
            W::load(&self.d[ky][k..])
                .div(z)
                .store(&mut self.shear[1][k..]);
            W::splat(1.0).div(z).store(&mut self.shear[2][k..]);
        }
        Pyramid::around::<W>(self, padded)
    }
}

/// Returns a mask of the unblocked rays.
#[inline(always)]
fn trace<E: Lanes, W: Lanes>(
    rays: &Rays,
    pyramid: &Pyramid,
    bvh: &Bvh,
    (stack, masks): (&mut [(u32, f32)], &mut [u64]),
) -> u64 {
    let mut free = u64::MAX >> (MOST - rays.count);
    let mut live = free;
    let (mut current, mut depth) = (0u32, 0);
    loop {
        let node = &bvh.nodes[current as usize];
        let mut mask = pyramid.children::<E>(node);
        while mask != 0 {
            let i = mask.trailing_zeros() as usize & 7;
            mask &= mask - 1;
            let child = node.child[i];
            let inner = child & LEAF == 0;
            // The root's children are so large that all rays rarely miss one.
            let met = if inner && current == 0 {
                live
            } else {
                rays.meet::<W>(&node.bounds, i, live & free)
            };
            if met == 0 {
                continue;
            }
            if inner {
                bvh.prefetch::<E>(child);
                (stack[depth].0, masks[depth]) = (child, met);
                depth += 1;
                continue;
            }
            free &= !rays.leaf::<E, W>(bvh, child, met);
            if free == 0 {
                return 0;
            }
        }
        loop {
            if depth == 0 {
                return free;
            }
            depth -= 1;
            (current, live) = (stack[depth].0, masks[depth] & free);
            if live.count_ones() > LAST {
                break;
            }
            while live != 0 {
                let k = live.trailing_zeros() as usize & (MOST - 1);
                live &= live - 1;
                let d = Vec3::new(rays.d[0][k], rays.d[1][k], rays.d[2][k]);
                let (_, hit) =
                    traverse::<E, true>(bvh, &mut stack[depth..], current, rays.o, d, 1.0);
                free &= !(u64::from(hit != EMPTY) << k);
            }
        }
    }
}
