//! Choosing shared vertices among candidates.
//!
//! A candidate costs a ray. A shared vertex costs a bundle of rays to the spots, one to the gather
//! points, and walks: tens of times as much. So several candidates are drawn for each shared
//! vertex, and selected in proportion to their expected contribution (Talbot, Cline and Egbert,
//! EGSR 2005, with systematic sampling). The estimate of the contribution is cheap: no shadow rays,
//! some gather points, and the spots' direct light. It affects the variance of the sums but not
//! their expectation, because a selected vertex counts for the rejected ones as well.

use std::f32::consts::PI;

use crate::{
    light::columns::Columns,
    numeric::{rng::Rng, systematic::draw},
    paths::{path_reuse::shared::Shared, scratch::Scratch, tracer::Walk, vertex::Vertex},
    scene::{
        lobes::{Lobes, Seen},
        surface::Surface,
    },
};

/// The maximum number of gather points that estimates use. An estimate over all of them would
/// predict the direct light of vertices close to one of them better: the variance of direct light
/// from vertices, summed over all pixels, would be 0.4 of that without candidates, instead of 0.7.
/// Medians and times are the same.
const POINTS: usize = 64;

/// The number of gather points that light at a rough vertex is estimated for.
const LOOKS: u32 = 2;

/// Buffers, and the gather points that estimates use.
#[derive(Debug, Default)]
pub(crate) struct Candidates {
    pub columns: Columns,
    /// Albedo/π times the weight of the camera path; unspecified for surfaces that are not
    /// Lambertian.
    pub factor: Vec<f32>,
    /// Indices of the gather points that are not Lambertian, and how they scatter to the camera.
    pub glossy: Vec<usize>,
    pub lobes: Lobes,
    /// Index of each among all gather points.
    pub of: Vec<usize>,
    pub weight: Vec<f32>,
    pub scattered: Vec<f32>,
    pub drawn: Vec<f32>,
    /// Light from the spots.
    pub lit: Vec<f32>,
    /// By candidate: its expected contribution, and the number of candidates it counts for if it is
    /// selected.
    pub worth: Vec<f32>,
    pub counts: Vec<f32>,
}

impl Candidates {
    /// Lays out some of the gather points.
    pub fn look_at(&mut self, gathers: &[(Vertex, usize)]) {
        self.columns.clear();
        self.factor.clear();
        self.glossy.clear();
        self.lobes.clear();
        self.of.clear();
        let some = gathers.len().min(POINTS);
        for k in 0..some {
            let i = k * gathers.len() / some;
            let v = &gathers[i].0;
            let (h, diffuse) = (&v.hit, v.hit.surface.diffuse());
            if !diffuse {
                self.glossy.push(k);
                self.lobes.push(&Seen::of(h, v.wo), &h.surface);
            }
            self.columns.push(h.p, h.n, if diffuse { 1.0 } else { 0.0 });
            self.factor.push(v.beta * h.surface.lambertian());
            self.of.push(i);
        }
        self.weight.resize(some, 0.0);
        self.scattered.resize(self.glossy.len(), 0.0);
        self.drawn.resize(self.glossy.len(), 0.0);
    }

    /// Writes the weight of each gather point for light that a vertex sends to it, unshadowed.
    /// Returns the average density of drawing the vertex from one of them.
    pub fn weigh(&mut self, y: &Shared, gathers: &[(Vertex, usize)]) -> f32 {
        let h = &y.hit;
        self.columns.irradiance(h.p, h.n, &mut self.weight);
        let mut density = self.weight.iter().sum::<f32>() / PI;
        for (w, factor) in self.weight.iter_mut().zip(&self.factor) {
            *w *= factor;
        }
        let (scattered, drawn) = (&mut self.scattered, &mut self.drawn);
        self.lobes.toward((h.p, h.n), scattered, drawn);
        for ((&k, &value), &pdf) in self.glossy.iter().zip(&*scattered).zip(&*drawn) {
            let v = &gathers[self.of[k]].0;
            if value > 0.0 && h.n.dot(v.hit.p - h.p) > 0.0 {
                self.weight[k] = v.beta * value;
                density += pdf;
            } else {
                self.weight[k] = 0.0;
            }
        }
        density / self.of.len() as f32
    }

    /// Returns the sum over the spots of the squared light that a vertex sends in direction `to`,
    /// unshadowed: the light of each spot falls into a bin of its own.
    pub fn square(
        &mut self,
        walk: &Walk,
        of: (Seen, &Surface),
        y: &Shared,
        plain: &mut Vec<f32>,
    ) -> f32 {
        walk.emitters.weights(of, plain, &mut self.lit);
        walk.leave_to_zones(&y.hit, &mut self.lit);
        self.lit.iter().map(|w| w * w).sum()
    }

    /// Returns the expected contribution of a candidate: the square root of the sum of squares of
    /// its direct light in all pixels. `drawn` are the numbers of candidates drawn from the gather
    /// points and from the spots.
    pub fn direct(
        &mut self,
        walk: &Walk,
        y: &Shared,
        (gathers, drawn): (&[(Vertex, usize)], (u32, u32)),
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) -> f32 {
        let h = &y.hit;
        let emitters = walk.emitters;
        let mut density = drawn.0 as f32 * self.weigh(y, gathers);
        let seen: f32 = self.weight.iter().map(|w| w * w).sum();
        if !(seen > 0.0 && density > 0.0) {
            return 0.0;
        }
        let white = h.surface.white();
        let of = (Seen::of(h, h.n), &white);
        emitters.weights(of, &mut scratch.plain, &mut self.lit);
        // A spot scatters its albedo times the density of drawing a direction.
        let from_spots = self.lit.iter().zip(&emitters.list);
        let from_spots = from_spots.filter(|(w, _)| **w > 0.0);
        density += from_spots
            .map(|(w, e)| w * PI / e.surface.albedo())
            .sum::<f32>()
            * drawn.1 as f32
            / emitters.list.len() as f32;
        let square = match y.rough {
            None => seen * self.square(walk, (Seen::of(h, h.n), &h.surface), y, &mut scratch.plain),
            Some(surface) => {
                let squares: Vec<f32> = self.weight.iter().map(|w| w * w).collect();
                let mut sum = 0.0;
                draw(&squares, LOOKS, rng.uniform(), |k, share| {
                    let to = (gathers[self.of[k]].0.hit.p - h.p).normalized();
                    let of = (Seen::of(h, to), &surface);
                    sum += share * self.square(walk, of, y, &mut scratch.plain);
                });
                sum
            }
        };
        let direct = square.sqrt() / density;
        if direct.is_finite() { direct } else { 0.0 }
    }
}
