//! Weights and path lengths of Lambertian gather points.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    film::slots::Film,
    light::columns::Columns,
    numeric::lanes::{self, Wide, widest},
    paths::{tracer::Walk, vertex::Vertex},
};

/// How the gather points weigh light from a direction, as columns.
#[derive(Debug, Default)]
pub(crate) struct Lengths {
    /// Albedo/π times the weight of the camera path; unspecified for surfaces that are not
    /// Lambertian.
    pub factor: Vec<f32>,
    /// Optical path length from the camera, minus the gate's start, in bins.
    pub bins: Vec<f64>,
    /// Bins per render unit.
    pub per_unit: f64,
}

impl Lengths {
    pub fn lay(&mut self, (walk, film): (&Walk, &Film), gathers: &[(Vertex, usize)]) {
        let per_metre = 1.0 / film.gate.bin_width_m;
        self.per_unit = walk.world.metres(1.0) * per_metre;
        self.factor.clear();
        self.bins.clear();
        for (v, _) in gathers {
            self.factor.push(v.beta * v.hit.surface.lambertian());
            self.bins.push((v.length_m - film.gate.start_m) * per_metre);
        }
    }

    /// Converts the irradiances that a shared vertex at `y` casts on Lambertian gather points into
    /// the light that they send to the camera, and computes the optical path lengths via `y`, in
    /// bins. Returns the density of drawing the vertex from them. The loop has no branches, and its
    /// sums are independent, so the compiler can vectorise it.
    pub fn weigh(&self, columns: &Columns, y: Vec3, weight: &mut [f32], offset: &mut [f32]) -> f32 {
        widest(Weigh {
            lengths: self,
            columns,
            y,
            weight,
            offset,
        })
    }

    #[inline(always)]
    pub fn weigh_wide(
        &self,
        columns: &Columns,
        y: Vec3,
        weight: &mut [f32],
        offset: &mut [f32],
    ) -> f32 {
        let count = weight.len();
        let (px, py, pz) = (
            &columns.px[..count],
            &columns.py[..count],
            &columns.pz[..count],
        );
        let (factor, bins) = (&self.factor[..count], &self.bins[..count]);
        let sum = lanes::sum(weight);
        let offset = &mut offset[..count];
        for i in 0..count {
            let (dx, dy, dz) = (y.x - px[i], y.y - py[i], y.z - pz[i]);
            let d = (dx * dx + dy * dy + dz * dz).sqrt();
            offset[i] = (bins[i] + f64::from(d) * self.per_unit) as f32;
            weight[i] *= factor[i];
        }
        sum / PI
    }
}

/// Arguments of [`Lengths::weigh`].
struct Weigh<'a> {
    lengths: &'a Lengths,
    columns: &'a Columns,
    y: Vec3,
    weight: &'a mut [f32],
    offset: &'a mut [f32],
}

impl Wide for Weigh<'_> {
    type Output = f32;

    #[inline(always)]
    fn run(self) -> f32 {
        let Self {
            lengths,
            columns,
            y,
            weight,
            offset,
        } = self;
        lengths.weigh_wide(columns, y, weight, offset)
    }
}
