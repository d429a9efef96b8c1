//! Bundles at a leaf: tests the rays against its box and its triangles.

use picofarm_scene::Vec3;

use crate::scene::bvh::{
    lanes::Lanes,
    nodes::{Pack, last_fill, packs},
    rays::{MOST, Rays},
    tree::Bvh,
};

impl Rays {
    /// Returns a mask of the rays in `of` that hit box `i` of a node, by the single ray's slab test
    /// with a lane per ray.
    #[inline(always)]
    pub(crate) fn meet<W: Lanes>(&self, bounds: &[[f32; 8]; 6], i: usize, of: u64) -> u64 {
        let (ox, oy, oz) = (self.o.x, self.o.y, self.o.z);
        let low = [
            W::splat(bounds[0][i] - ox),
            W::splat(bounds[1][i] - oy),
            W::splat(bounds[2][i] - oz),
        ];
        let high = [
            W::splat(bounds[3][i] - ox),
            W::splat(bounds[4][i] - oy),
            W::splat(bounds[5][i] - oz),
        ];
        let slack = W::splat(1.0 + 4.0 * f32::EPSILON);
        let mut met = 0;
        for k in (0..self.count).step_by(W::N) {
            let lanes = of >> k & (u64::MAX >> (64 - W::N));
            if lanes == 0 {
                continue;
            }
            let (nx, fx) = self.planes::<W>(low[0], high[0], 0, k);
            let (ny, fy) = self.planes::<W>(low[1], high[1], 1, k);
            let (nz, fz) = self.planes::<W>(low[2], high[2], 2, k);
            let t0 = nx.max(ny).max(nz.max(W::splat(0.0)));
            let t1 = fx.min(fy).min(fz).mul(slack).min(W::splat(1.0));
            met |= (u64::from(t0.le(t1)) & lanes) << k;
        }
        met
    }

    /// Returns the entry and exit distances of rays `k..` in a slab. The sign decides which plane
    /// is nearer; min and max give the same numbers.
    #[inline(always)]
    fn planes<W: Lanes>(&self, low: W, high: W, axis: usize, k: usize) -> (W, W) {
        let inverse = W::load(&self.inverse[axis][k..]);
        let (p, q) = (low.mul(inverse), high.mul(inverse));
        (p.min(q), p.max(q))
    }

    /// Returns a mask of the rays in `of` that hit a triangle of a leaf.
    #[inline(always)]
    pub(crate) fn leaf<E: Lanes, W: Lanes>(&self, bvh: &Bvh, leaf: u32, of: u64) -> u64 {
        let range = packs(leaf);
        let last = range.end - 1;
        let mut hit = 0;
        for p in range {
            let pack = &bvh.packs[p];
            let fill = if p == last { last_fill(leaf) } else { 8 };
            let left = of & !hit;
            // Choose the cheaper order: a register of triangles per ray, or a register of rays per
            // triangle.
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
        let o = [
            E::splat(self.o[kx]),
            E::splat(self.o[ky]),
            E::splat(self.o[kz]),
        ];
        let mut vertices = [[E::splat(0.0); 3]; 3];
        for (v, vertex) in vertices.iter_mut().enumerate() {
            for (a, k) in [kx, ky, kz].into_iter().enumerate() {
                vertex[a] = E::load(&pack.vertex[3 * v + k]).sub(o[a]);
            }
        }
        let mut hit = 0;
        while of != 0 {
            let k = of.trailing_zeros() as usize & (MOST - 1);
            of &= of - 1;
            let shear = [
                E::splat(self.shear[0][k]),
                E::splat(self.shear[1][k]),
                E::splat(self.shear[2][k]),
            ];
            let (hits, crosses) = meets(&vertices, &shear);
            let mut needles = pack.needles(crosses);
            let mut met = hits & !needles != 0;
            while !met && needles != 0 {
                let lane = needles.trailing_zeros() as usize & 7;
                needles &= needles - 1;
                met = self.meets_needle(pack, lane, k);
            }
            hit |= u64::from(met) << k;
        }
        hit
    }

    /// Returns whether ray `k` hits the needle in a lane, if it passes inside the needle's edges.
    #[inline(always)]
    fn meets_needle(&self, pack: &Pack, lane: usize, k: usize) -> bool {
        let d = Vec3::new(self.d[0][k], self.d[1][k], self.d[2][k]);
        let t = pack.exactly(lane, self.o, d);
        t > 0.0 && t <= 1.0
    }

    #[inline(always)]
    fn by_triangle<W: Lanes>(&self, pack: &Pack, fill: usize, of: u64) -> u64 {
        let mut hit = 0;
        for lane in 0..fill {
            let mut vertices = [[W::splat(0.0); 3]; 3];
            for (v, vertex) in vertices.iter_mut().enumerate() {
                for (a, k) in self.axes.into_iter().enumerate() {
                    vertex[a] = W::splat(pack.vertex[3 * v + k][lane] - self.o[k]);
                }
            }
            for k in (0..self.count).step_by(W::N) {
                let lanes = (of & !hit) >> k & (u64::MAX >> (64 - W::N));
                if lanes == 0 {
                    continue;
                }
                let shear = [
                    W::load(&self.shear[0][k..]),
                    W::load(&self.shear[1][k..]),
                    W::load(&self.shear[2][k..]),
                ];
                let (mut hits, crosses) = meets(&vertices, &shear);
                if pack.is_needle(lane) {
                    hits = 0;
                    let mut rest = crosses & lanes as u32;
                    while rest != 0 {
                        let i = rest.trailing_zeros() as usize & (W::N - 1);
                        rest &= rest - 1;
                        hits |= u32::from(self.meets_needle(pack, lane, k + i)) << i;
                    }
                }
                hit |= (u64::from(hits) & lanes) << k;
            }
        }
        hit
    }
}

/// Performs the single ray's triangle test with limit 1, for vertices relative to the origin and
/// axes in the order of the shear. Returns masks of the lanes that are hit, and of those that are
/// crossed anywhere along the ray's line.
#[inline(always)]
fn meets<L: Lanes>(v: &[[L; 3]; 3], [sx, sy, sz]: &[L; 3]) -> (u32, u32) {
    let [[ax, ay, az], [bx, by, bz], [cx, cy, cz]] = *v;
    let (ax, ay) = (ax.sub(sx.mul(az)), ay.sub(sy.mul(az)));
    let (bx, by) = (bx.sub(sx.mul(bz)), by.sub(sy.mul(bz)));
    let (cx, cy) = (cx.sub(sx.mul(cz)), cy.sub(sy.mul(cz)));
    let zero = L::splat(0.0);
    let u = cx.mul(by).sub(cy.mul(bx));
    let v = ax.mul(cy).sub(ay.mul(cx));
    let w = bx.mul(ay).sub(by.mul(ax));
    let (low, high) = (u.min(v).min(w), u.max(v).max(w));
    let inside = zero.le(low) | high.le(zero);
    if inside == 0 {
        return (0, 0);
    }
    let det = u.add(v).add(w);
    let t = sz.mul(u.mul(az).add(v.mul(bz)).add(w.mul(cz))).div(det);
    let crosses = inside & det.differs(zero);
    (crosses & t.gt(zero) & t.le(L::splat(1.0)), crosses)
}
