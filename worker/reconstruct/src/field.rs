//! The density field: a logit u at the nodes of a regular grid, trilinear between them, with
//! density σ = (4/h) · sigmoid(u) in 1/m and the distance h between nodes. A logit that is linear
//! across a surface can place it anywhere between nodes.

mod skip;

use picofarm_scene::Vec3;

pub use skip::Skip;

/// The density of solid matter times the distance between nodes: half the light is absorbed after a
/// sixth of a voxel.
pub const PEAK: f32 = 4.0;
/// The change of the logit over one voxel across a surface at its start.
pub const GAIN: f32 = 6.0;
/// The logit of empty space.
pub const EMPTY: f32 = -9.0;
/// The logit of solid matter.
pub const SOLID: f32 = 9.0;

/// Returns the logit at a surface. If the logit grows by [`GAIN`] a voxel at a flat surface, half
/// the light of a ray at a right angle is absorbed exactly where the logit has this value: ∫σ =
/// (4/GAIN)·ln(1 + eᵘ) = ln 2.
pub fn surface_logit() -> f32 {
    // 2^(6/4) − 1 = 1.828…
    libm::logf(libm::powf(2.0, GAIN / PEAK) - 1.0)
}

/// Logits on a grid. Node (i, j, k) is at origin + h·(i, j, k); its index is (k·ny + j)·nx + i.
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    /// The number of nodes along x, y and z, at least two each.
    pub nodes: [usize; 3],
    /// The position of node (0, 0, 0), metres, in the scene's axes.
    pub origin: Vec3,
    /// The distance h between neighbouring nodes, metres.
    pub spacing: f32,
    /// The logits u.
    pub logit: Vec<f32>,
}

impl Field {
    /// Returns empty space over the box from `lo` to `hi`, with `nodes` nodes along its longest
    /// side.
    pub fn over(lo: Vec3, hi: Vec3, nodes: usize) -> Self {
        let size = hi - lo;
        let spacing = size.x.max(size.y).max(size.z) / (nodes.max(2) - 1) as f32;
        let along = |length: f32| ((length / spacing - 1e-3).ceil() as usize + 1).max(2);
        let nodes = [along(size.x), along(size.y), along(size.z)];
        Self {
            nodes,
            origin: lo,
            spacing,
            logit: vec![EMPTY; nodes.iter().product()],
        }
    }

    /// Returns the position of a node, metres.
    pub fn at(&self, index: usize) -> Vec3 {
        let [nx, ny, _] = self.nodes;
        let (i, j, k) = (index % nx, index / nx % ny, index / (nx * ny));
        self.origin + Vec3::new(i as f32, j as f32, k as f32) * self.spacing
    }

    /// Returns the index steps to the next node along x, y and z.
    pub fn strides(&self) -> [usize; 3] {
        [1, self.nodes[0], self.nodes[0] * self.nodes[1]]
    }

    /// Returns the density at a node, 1/m.
    pub fn density(&self, index: usize) -> f32 {
        PEAK / self.spacing * sigmoid(self.logit[index])
    }

    /// Returns the far corner of the grid.
    pub fn end(&self) -> Vec3 {
        let [x, y, z] = self.nodes.map(|n| (n - 1) as f32 * self.spacing);
        self.origin + Vec3::new(x, y, z)
    }

    /// Returns the t at which a ray enters and leaves the grid. If it misses the grid, the first is
    /// greater than the second.
    pub fn span(&self, origin: Vec3, direction: Vec3) -> (f32, f32) {
        let (lo, hi) = (self.origin, self.end());
        let (mut near, mut far) = (f32::NEG_INFINITY, f32::INFINITY);
        for k in 0..3 {
            let inverse = 1.0 / direction[k];
            let (a, b) = ((lo[k] - origin[k]) * inverse, (hi[k] - origin[k]) * inverse);
            // min and max drop the NaN of 0·∞ (a ray inside a slab and parallel to it).
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        (near, far)
    }

    /// Returns the logit inside a cell at the fractions `f` from its first node.
    #[inline(always)]
    pub fn interpolate(&self, cell: usize, f: [f32; 3]) -> f32 {
        let [_, y, z] = self.strides();
        let u = &self.logit;
        let row = |i: usize| u[i] + f[0] * (u[i + 1] - u[i]);
        let (a, b, c, d) = (row(cell), row(cell + y), row(cell + z), row(cell + y + z));
        let (low, high) = (a + f[1] * (b - a), c + f[1] * (d - c));
        low + f[2] * (high - low)
    }

    /// Visits the middles of steps along a ray between t = `near` and `far`, except in cells that
    /// `skip` excludes. The visitor receives t, the cell and the position in it, and returns
    /// whether to continue. The first step is shifted by `offset` steps, in [−0.5, 0.5].
    #[inline(always)]
    pub fn march(
        &self,
        skip: &Skip,
        (origin, direction): (Vec3, Vec3),
        (near, far): (f32, f32),
        (step, offset): (f32, f32),
        mut visit: impl FnMut(f32, usize, [f32; 3]) -> bool,
    ) {
        let inverse = 1.0 / self.spacing;
        let g = (origin - self.origin) * inverse;
        let e = direction * inverse;
        let slope = Vec3::new(1.0 / e.x, 1.0 / e.y, 1.0 / e.z);
        let (mut a, mut b) = (near, far);
        for k in 0..3 {
            let last = (self.nodes[k] - 1) as f32 - 1e-3;
            let (p, q) = ((1e-3 - g[k]) * slope[k], (last - g[k]) * slope[k]);
            a = a.max(p.min(q));
            b = b.min(p.max(q));
        }
        let [_, y, z] = self.strides();
        let mut t = a + step * (0.5 + offset);
        while t < b {
            let p = g + e * t;
            let (i, j, k) = (p.x as usize, p.y as usize, p.z as usize);
            if !skip.block(i, j, k) {
                let ahead = skip.leave(p, slope, (i, j, k));
                t += ((ahead / step).floor().max(0.0) + 1.0) * step;
                continue;
            }
            let cell = k * z + j * y + i;
            if skip.cell(cell) {
                let f = [p.x - i as f32, p.y - j as f32, p.z - k as f32];
                if !visit(t, cell, f) {
                    return;
                }
            }
            t += step;
        }
    }
}

/// Returns 1/(1 + e⁻ᵘ), with the same bits on every machine. The relative error is below 1e-6 for
/// |u| < 80.
#[inline(always)]
pub fn sigmoid(u: f32) -> f32 {
    1.0 / (1.0 + exp(-u))
}

/// Returns eˣ for |x| < 80 by 2ⁿ times a polynomial (Cephes' expf). Larger arguments are clamped.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let x = x.clamp(-80.0, 80.0);
    let n = (x * std::f32::consts::LOG2_E + 0.5).floor();
    let r = x - n * 0.693_359_4 + n * 2.121_944_4e-4;
    let p = 1.987_569_2e-4;
    let p = p * r + 1.398_2e-3;
    let p = p * r + 8.333_452e-3;
    let p = p * r + 4.166_579_6e-2;
    let p = p * r + 1.666_666_5e-1;
    let p = p * r + 0.5;
    let p = p * r * r + r + 1.0;
    p * f32::from_bits(((n as i32 + 127) as u32) << 23)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_and_sigmoid_are_accurate() {
        for k in -790..790 {
            let x = k as f32 * 0.1;
            let (got, want) = (f64::from(exp(x)), f64::from(x).exp());
            assert!((got / want - 1.0).abs() < 1e-6, "{x}: {got} {want}");
        }
        assert!((sigmoid(0.0) - 0.5).abs() < 1e-7);
        assert!(sigmoid(-200.0) >= 0.0 && sigmoid(200.0) <= 1.0);
    }

    #[test]
    fn a_grid_covers_its_box_and_knows_its_nodes() {
        let (lo, hi) = (Vec3::new(-1.0, 0.0, 2.0), Vec3::new(1.0, 3.0, 3.0));
        let field = Field::over(lo, hi, 31);
        assert_eq!(field.nodes, [21, 31, 11]);
        assert!((field.at(field.logit.len() - 1) - hi).length() < 1e-5);
    }
}
