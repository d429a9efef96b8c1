//! Choosing shared vertices among candidates.
//!
//! A candidate costs a ray. A shared vertex costs a bundle of rays to the spots, one to the gather
//! points, and walks: tens of times as much. So several candidates are drawn for each shared
//! vertex, and selected in proportion to their expected contribution (Talbot, Cline and Egbert,
//! EGSR 2005, with systematic sampling). The estimate of the contribution is cheap: no shadow rays,
//! some gather points, and the spots' direct light. It affects the variance of the sums but not
//! their expectation, because a selected vertex counts for the rejected ones as well.

use std::f32::consts::PI;

use super::{Shared, Sharing};
use crate::{
    bsdf::Surface,
    emitter::Columns,
    lobes::{Lobes, Seen},
    rng::Rng,
    vertex::Vertex,
    walk::{Scratch, Walk, draw},
};

/// The maximum number of gather points that estimates use. An estimate over all of them would
/// predict the direct light of vertices close to one of them better: the variance of direct light
/// from vertices, summed over all pixels, would be 0.4 of that without candidates, instead of 0.7.
/// Medians and times are the same.
const POINTS: usize = 64;
/// The number of gather points that light at a rough vertex is estimated for.
const LOOKS: u32 = 2;
/// The constant added to the direct light of a candidate, in means of that light over all
/// candidates, because the light of walks is not predicted. 0.3 and 2 give the same medians.
const REST: f32 = 1.0;

/// Buffers, and the gather points that estimates use.
#[derive(Debug, Default)]
pub(super) struct Candidates {
    columns: Columns,
    /// Albedo/π times the weight of the camera path; unspecified for surfaces that are not
    /// Lambertian.
    factor: Vec<f32>,
    /// Indices of the gather points that are not Lambertian, and how they scatter to the camera.
    glossy: Vec<usize>,
    lobes: Lobes,
    /// Index of each among all gather points.
    of: Vec<usize>,
    weight: Vec<f32>,
    scattered: Vec<f32>,
    drawn: Vec<f32>,
    /// Light from the spots.
    lit: Vec<f32>,
    /// By candidate: its expected contribution, and the number of candidates it counts for if it is
    /// selected.
    worth: Vec<f32>,
    counts: Vec<f32>,
}

impl Candidates {
    /// Lays out some of the gather points.
    fn look_at(&mut self, gathers: &[(Vertex, usize)]) {
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
    fn weigh(&mut self, y: &Shared, gathers: &[(Vertex, usize)]) -> f32 {
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
    fn square(
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
    fn direct(
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

impl Sharing {
    /// Selects `kept` of the candidates. `drawn` are the numbers of candidates drawn from the
    /// gather points and from the spots.
    pub(super) fn choose(
        &mut self,
        walk: &Walk,
        (kept, drawn): (u32, (u32, u32)),
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        if self.shared.len() <= kept as usize {
            return;
        }
        let c = &mut self.candidates;
        c.look_at(&self.gathers);
        c.lit.resize(walk.emitters.list.len(), 0.0);
        c.worth.clear();
        for y in &self.shared {
            let worth = c.direct(walk, y, (&self.gathers, drawn), rng, scratch);
            c.worth.push(worth);
        }
        let mean = c.worth.iter().sum::<f32>() / c.worth.len() as f32;
        let rest = if mean > 0.0 { REST * mean } else { 1.0 };
        for w in &mut c.worth {
            *w += rest;
        }
        count(&c.worth, (kept, rng.uniform()), &mut c.counts);
        let mut counts = c.counts.iter();
        self.shared.retain_mut(|y| {
            y.counts = counts.next().copied().unwrap_or(0.0);
            y.counts > 0.0
        });
    }
}

/// Selects `kept` candidates in proportion to their worth, and writes the number of candidates that
/// each counts for, 0 for rejected ones. If the worths have no usable sum, all are selected,
/// because a rejected candidate must be compensated for.
fn count(worth: &[f32], (kept, u): (u32, f32), counts: &mut Vec<f32>) {
    counts.clear();
    counts.resize(worth.len(), 0.0);
    let mut any = false;
    draw(worth, kept, u, |k, share| {
        counts[k] = share / worth[k];
        any = true;
    });
    if !any {
        counts.fill(1.0);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::count;

    proptest! {
        #[test]
        fn every_candidate_counts_for_one_on_average(
            worth in prop::collection::vec(0.01f32..10.0, 2..60), kept in 1u32..20,
        ) {
            const STEPS: usize = 4000;
            let (mut sums, mut counts) = (vec![0.0f64; worth.len()], vec![]);
            for k in 0..STEPS {
                count(&worth, (kept, (k as f32 + 0.5) / STEPS as f32), &mut counts);
                prop_assert!(counts.iter().filter(|&&c| c > 0.0).count() <= kept as usize + 1);
                for (sum, c) in sums.iter_mut().zip(&counts) {
                    *sum += f64::from(*c) / STEPS as f64;
                }
            }
            // A count is a step of the sum over the candidate's own part of it. The average over
            // STEPS is no more precise than that.
            let step = worth.iter().sum::<f32>() / kept as f32;
            for (sum, w) in sums.iter().zip(&worth) {
                let grain = 2.0 * f64::from(step / w) / STEPS as f64 + 1e-3;
                prop_assert!((sum - 1.0).abs() < grain, "{sum} of {w}");
            }
        }
    }

    #[test]
    fn none_is_dropped_where_worths_have_no_sum() {
        for worth in [
            [0.0; 3],
            [1e-35; 3],
            [f32::MAX; 3],
            [f32::INFINITY, 1.0, 1.0],
        ] {
            let mut counts = vec![];
            count(&worth, (2, 0.5), &mut counts);
            assert_eq!(counts, [1.0; 3], "{worth:?}");
        }
    }
}
