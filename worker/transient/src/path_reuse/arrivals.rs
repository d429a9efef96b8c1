//! What arrives at the shared vertices.

use std::f32::consts::PI;

use super::{ArrivalSink, Effort, Guide, ROUGH_SPOTS, Sharing};
use crate::{
    film::Film,
    lobes::Seen,
    rng::Rng,
    sink::{Place, Sink, Way},
    spectra::{Light, ONES, times},
    vertex::{Sight, Vertex},
    walk::{Scratch, Walk},
    world::{Hit, lift},
};

/// Which spots' light is carried on from a vertex. A rough one weighs each arrival for each pixel, so that of many spots
/// some are drawn by contribution (systematic sampling), each with its share of the sum.
struct Carry {
    /// Weight between two draws; 0 where all are carried as they are.
    step: f32,
    sum: f32,
    next: f32,
}

impl Carry {
    fn new(rough: bool, lit: &[usize], weights: &[f32], rng: &mut Rng) -> Self {
        let total: f32 = lit.iter().map(|&spot| weights[spot]).sum();
        let step = total / ROUGH_SPOTS as f32;
        let drawn = rough && lit.len() > ROUGH_SPOTS && step > 1e-30 && step.is_finite();
        Self {
            step: if drawn { step } else { 0.0 },
            sum: 0.0,
            next: if drawn { rng.uniform() * step } else { 0.0 },
        }
    }

    /// What is carried of the next spot, whose weight is `w`.
    fn share(&mut self, w: f32) -> f32 {
        if self.step == 0.0 {
            return w;
        }
        self.sum += w;
        let mut share = 0.0;
        while self.next < self.sum {
            share += self.step;
            self.next += self.step;
        }
        share
    }
}

impl Sharing {
    /// Optical path to the nearest gather point, metres: where arrivals' lengths are counted from.
    fn nearest_m(&self) -> f64 {
        let lengths = self.gathers.iter().map(|(v, _)| v.length_m);
        lengths.fold(f64::INFINITY, f64::min)
    }

    /// Fewest bounces up to a gather point.
    pub(super) fn lowest(&self) -> u32 {
        let bounces = self.gathers.iter().map(|(v, _)| v.bounce);
        bounces.min().unwrap_or(1)
    }

    /// Finds what arrives at every shared vertex: from all spots directly, from beyond by walks.
    pub(super) fn light_up(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        drawn: u32,
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let emitters = walk.emitters;
        let per_metre = 1.0 / film.gate.bin_width_m;
        let nearest = self.nearest_m();
        let bounce = self.lowest() + 1;
        let share = drawn as f32 / emitters.list.len() as f32;
        let gathers = &self.gathers;
        for y in &mut self.shared {
            y.first = self.arrivals.bins.len();
            y.end = y.first;
            let h = &y.hit;
            let window = walk
                .window
                .map(|w| self.shells.window(walk.world, &w, h.p, nearest));
            let walk = &Walk { window, ..*walk };
            if !walk.in_time(h.p, nearest) {
                continue;
            }
            let guide = y.rough.and_then(|surface| {
                let at = (rng.uniform() * gathers.len() as f32) as usize;
                let to = gathers[at.min(gathers.len() - 1)].0.hit.p - h.p;
                (h.n.dot(to) > 0.0).then(|| Guide {
                    surface: surface.guide(),
                    n: h.n,
                    to: to.normalized(),
                })
            });
            let (seen_as, wo) = guide.map_or((h.surface, h.n), |g| (g.surface, g.to));
            let mut sink = ArrivalSink {
                list: &mut self.arrivals,
                base_m: nearest,
                per_metre,
                factor: 1.0,
                film,
                place: Place::Shared,
                guide,
                share: 1.0,
                from: h.n,
                left: false,
            };
            let mut density = 0.0;
            let vertex = Vertex {
                hit: Hit {
                    surface: seen_as,
                    ..*h
                },
                wo,
                beta: 1.0,
                ratios: ONES,
                length_m: nearest,
                bounce,
                sight: Sight::ELSEWHERE,
            };
            let walk_on = |rng: &mut Rng, sink: &mut ArrivalSink, scratch: &mut Scratch| {
                sink.factor = 1.0 / effort.walks.max(1) as f32;
                sink.at(Place::Walk);
                for _ in 0..effort.walks {
                    sink.left = false;
                    walk.run(rng, vertex, scratch, sink);
                }
                sink.factor = 1.0;
                sink.at(Place::Shared);
                sink.left = false;
            };
            if walk.window.is_some() {
                walk_on(rng, &mut sink, scratch);
            }
            let of = (Seen::of(h, wo), &seen_as);
            emitters.weights(of, &mut scratch.plain, &mut scratch.weights);
            walk.leave_to_zones(h, &mut scratch.weights);
            if sink.list.bins.len() == y.first
                && !walk.any_in_window(h.p, nearest, &scratch.weights)
            {
                continue;
            }
            self.ends.clear();
            self.ends_of.clear();
            for (spot, &w) in scratch.weights.iter().enumerate() {
                if w > 0.0 {
                    self.ends.push(emitters.lifted[spot]);
                    self.ends_of.push(spot);
                }
            }
            self.blocked.resize(self.ends.len(), false);
            walk.world.bvh.occluded_bundle(
                &mut scratch.stack,
                lift(h.p, h.n),
                &self.ends,
                &mut self.blocked,
            );
            let mut lit = self.ends_of.iter().zip(&self.blocked);
            let lit = lit.by_ref().filter(|(_, blocked)| !**blocked);
            let lit: Vec<usize> = lit.map(|(&spot, _)| spot).collect();
            // The densities below are of what is drawn: with glass in the way as without.
            let mut through = vec![];
            if walk.world.has_glass() {
                let from = lift(h.p, h.n);
                let share = |spot: &usize| {
                    let to = emitters.lifted[*spot];
                    walk.world.glass(&mut scratch.stack, from, to)
                };
                through = lit.iter().map(share).collect();
            }
            let mut carry = Carry::new(y.rough.is_some(), &lit, &scratch.weights, rng);
            for (k, &spot) in lit.iter().enumerate() {
                let (e, w) = (&emitters.list[spot], scratch.weights[spot]);
                {
                    let to = h.p - e.p;
                    let d2 = to.dot(to);
                    let d = d2.sqrt();
                    let strength = emitters.columns.strength[spot];
                    density += if strength > 0.0 && guide.is_none() {
                        w / (strength * h.surface.lambertian() * PI)
                    } else {
                        let out = to / d;
                        e.surface.pdf(e.n, e.back, out) * h.n.dot(out).abs() / d2
                    };
                    let path = nearest + walk.world.metres(d) + e.path_m;
                    let through = through.get(k).copied().unwrap_or(1.0);
                    let carried = carry.share(w) * through;
                    if carried > 0.0 && walk.window.is_none_or(|w| w.holds(path)) {
                        let back = to * (-1.0 / d);
                        let light = Light {
                            value: carried,
                            ratios: match film.spectral {
                                false => ONES,
                                true => {
                                    let here = walk.world.ratios(h, h.n, back);
                                    times(here, e.ratios(walk.world, -back))
                                }
                            },
                        };
                        sink.toward(back);
                        sink.add(path, light, spot, bounce + 1, Way::Spot);
                    }
                }
            }
            y.light = density * share;
            if let Some(patches) = walk.patches {
                y.light += self.shells.density((walk.world, patches), h);
            }
            if walk.window.is_none() {
                walk_on(rng, &mut sink, scratch);
            }
            y.end = sink.list.bins.len();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Carry;
    use crate::rng::{Rng, Stream};

    #[test]
    fn each_spot_is_carried_with_its_own_weight_on_average() {
        const SPOTS: usize = 100;
        let weights: Vec<f32> = (0..SPOTS).map(|k| (1 + k * k % 17) as f32).collect();
        let lit: Vec<usize> = (0..SPOTS).filter(|k| k % 4 != 1).collect();
        assert!(lit.len() > super::ROUGH_SPOTS);
        let mut rng = Rng::new(1, Stream::Paths, 2, 3);
        let (mut sums, n) = ([0.0f64; SPOTS], 20_000);
        for _ in 0..n {
            let mut carry = Carry::new(true, &lit, &weights, &mut rng);
            let mut carried = 0;
            for &spot in &lit {
                let share = carry.share(weights[spot]);
                carried += u32::from(share > 0.0);
                sums[spot] += f64::from(share) / f64::from(n);
            }
            assert!(carried <= super::ROUGH_SPOTS as u32 + 1);
        }
        for &spot in &lit {
            let miss = sums[spot] / f64::from(weights[spot]) - 1.0;
            assert!(miss.abs() < 0.06, "spot {spot}: {miss}");
        }
    }
}
