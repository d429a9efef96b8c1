//! The pyramid around a bundle: a volume that contains every segment, and a box test against it.
//!
//! It is bounded by the slopes of the rays on both sides of their main axis, by the box around all
//! segments, and by a plane through the targets. The targets are usually on one surface, so the
//! plane excludes the leaves of that surface. The test must pass every box that passes the slab
//! test of some ray. The error of that test is less than 9 units of 2⁻²³ relative to each
//! coordinate of the point where the ray hits the box. The margins here are about twice as large,
//! and the test itself adds less than 4 units.

use crate::scene::bvh::{lanes::Lanes, nodes::Node, rays::Rays};

/// Relative margin: 17 units of 2⁻²³.
const MARGIN: f32 = 2e-6;

/// Absolute margin for numbers that underflow.
const TINY: f32 = 1e-30;

/// Twice the value by which the slab test replaces smaller components of a direction.
const LEAST: f32 = 2e-18;

/// All values are relative to the rays' origin. z is the main axis; its sign is flipped so that
/// rays go to +z.
#[derive(Debug)]
pub(crate) struct Pyramid {
    axes: [usize; 3],
    origin: [f32; 3],
    negative: bool,
    /// Least and greatest x/z and y/z.
    slope: [(f32, f32); 2],
    /// The box: its extent in x and y, and the greatest z.
    sides: [(f32, f32); 2],
    depth: f32,
    /// A plane n·p ≤ bound.
    n: [f32; 3],
    bound: f32,
}

#[inline(always)]
fn wider((low, high): (f32, f32), least: f32) -> (f32, f32) {
    (
        low - (low.abs() * MARGIN + least),
        high + (high.abs() * MARGIN + least),
    )
}

/// Returns the least and the greatest of the first `padded` numbers, a multiple of the lanes.
#[inline(always)]
fn range<W: Lanes>(a: &[f32], padded: usize) -> (f32, f32) {
    let (mut low, mut high) = (W::load(a), W::load(a));
    let mut k = W::N;
    while k < padded {
        low = low.min(W::load(&a[k..]));
        high = high.max(W::load(&a[k..]));
        k += W::N;
    }
    (low.least(), high.greatest())
}

impl Pyramid {
    /// Returns `None` if the numbers are so large or small that the margins are not valid.
    #[inline(always)]
    pub(crate) fn around<W: Lanes>(rays: &Rays, padded: usize) -> Option<Self> {
        let [kx, ky, kz] = rays.axes;
        let turn = |(low, high): (f32, f32)| {
            if rays.negative {
                (-high, -low)
            } else {
                (low, high)
            }
        };
        let o = rays.o;
        let (near, far) = turn(range::<W>(&rays.d[kz], padded));
        let widest = o.x.abs().max(o.y.abs()).max(o.z.abs()).max(far);
        if !(near > 1e-9 && widest < 1e9) {
            return None;
        }
        let slope = [
            wider(turn(range::<W>(&rays.shear[0], padded)), LEAST / near),
            wider(turn(range::<W>(&rays.shear[1], padded)), LEAST / near),
        ];
        let side = |(low, high): (f32, f32)| wider((low.min(0.0), high.max(0.0)), LEAST);
        let sides = [
            side(range::<W>(&rays.d[kx], padded)),
            side(range::<W>(&rays.d[ky], padded)),
        ];
        let depth = far + far * MARGIN;

        let sign = if rays.negative { -1.0 } else { 1.0 };
        let at = |i: usize| [rays.d[kx][i], rays.d[ky][i], rays.d[kz][i] * sign];
        let (a, b, c) = (
            at(0),
            at(rays.count / 2 - 1 + rays.count % 2),
            at(rays.count - 1),
        );
        let e = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
        let f = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
        let mut n = [
            e[1] * f[2] - e[2] * f[1],
            e[2] * f[0] - e[0] * f[2],
            e[0] * f[1] - e[1] * f[0],
        ];
        if n[0] * a[0] + n[1] * a[1] + n[2] * a[2] < 0.0 {
            n = [-n[0], -n[1], -n[2]];
        }
        let (nx, ny, nz) = (W::splat(n[0]), W::splat(n[1]), W::splat(n[2] * sign));
        let mut bound = W::splat(0.0);
        for k in (0..padded).step_by(W::N) {
            let x = nx.mul(W::load(&rays.d[kx][k..]));
            let y = ny.mul(W::load(&rays.d[ky][k..]));
            let z = nz.mul(W::load(&rays.d[kz][k..]));
            bound = bound.max(x.add(y).add(z));
        }
        let reach = |n: f32, (low, high): (f32, f32)| n.abs() * high.max(-low);
        let size = reach(n[0], sides[0]) + reach(n[1], sides[1]) + reach(n[2], (0.0, depth));
        Some(Self {
            axes: rays.axes,
            origin: o.into(),
            negative: rays.negative,
            slope,
            sides,
            depth,
            n,
            bound: bound.greatest() + (size * MARGIN + TINY),
        })
    }

    /// Returns a mask of a node's children that the rays may hit. `E` has eight lanes.
    #[inline(always)]
    pub(crate) fn children<E: Lanes>(&self, node: &Node) -> u32 {
        let [kx, ky, kz] = self.axes;
        let plane = |k: usize, a: usize| E::load(&node.bounds[k]).sub(E::splat(self.origin[a]));
        let (zero, tiny) = (E::splat(0.0), E::splat(TINY));
        let (z0, z1) = (plane(kz, kz), plane(3 + kz, kz));
        let (z0, z1) = if self.negative {
            (zero.sub(z1), zero.sub(z0))
        } else {
            (z0, z1)
        };
        let deepest = E::splat(self.depth);
        let mut mask = z0.le(deepest) & zero.sub(tiny).le(z1);
        let (z0, z1) = (z0.max(zero), z1.min(deepest));
        let nz = E::splat(self.n[2]);
        let mut least = nz.mul(z0).min(nz.mul(z1));
        let mut i = 0;
        while i < 2 {
            let a = if i == 0 { kx } else { ky };
            let (low, high) = (E::splat(self.sides[i].0), E::splat(self.sides[i].1));
            let (x0, x1) = (plane(a, a).max(low), plane(3 + a, a).min(high));
            let (low, high) = (E::splat(self.slope[i].0), E::splat(self.slope[i].1));
            let low = z0.mul(low).min(z1.mul(low)).sub(tiny);
            let high = z0.mul(high).max(z1.mul(high)).add(tiny);
            mask &= x0.le(x1) & x0.le(high) & low.le(x1);
            let n = E::splat(self.n[i]);
            least = least.add(n.mul(x0).min(n.mul(x1)));
            i += 1;
        }
        mask & least.le(E::splat(self.bound))
    }
}
