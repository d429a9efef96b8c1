//! The light that arrives at the shared vertices.

use std::f32::consts::PI;

use crate::{
    film::{
        class::{Place, Way},
        sink::Sink,
        slots::Film,
    },
    numeric::{rng::Rng, systematic::draw},
    paths::{
        path_reuse::{arrivals::ArrivalSink, effort::Effort, shared::Guide, sharing::Sharing},
        scratch::Scratch,
        tracer::Walk,
        vertex::{Sight, Vertex},
    },
    scene::{hit::Hit, intersection::lift, lobes::Seen},
};

/// The maximum number of spots for which the light at a rough vertex is carried to the pixels. They
/// are drawn by contribution.
const ROUGH_SPOTS: usize = 32;

/// The minimum and maximum number of walks from a shared vertex, on average.
const WALKS: (f32, f32) = (0.2, 6.0);

/// Selects the spots that a vertex carries light from. A rough vertex weighs each arrival for each
/// pixel, so if there are many spots, some are drawn by contribution (systematic sampling), each
/// with its share of the sum.
struct Carry {
    /// Weight between two draws; 0 if all spots are carried unchanged.
    step: f32,
    sum: f32,
    next: f32,
}

impl Carry {
    /// `lit` are the visible spots, with the fraction of their light that glass transmits.
    fn new(rough: bool, lit: &[(usize, f32)], weights: &[f32], rng: &mut Rng) -> Self {
        let total: f32 = lit.iter().map(|&(spot, _)| weights[spot]).sum();
        let step = total / ROUGH_SPOTS as f32;
        let drawn = rough && lit.len() > ROUGH_SPOTS && step > 1e-30 && step.is_finite();
        Self {
            step: if drawn { step } else { 0.0 },
            sum: 0.0,
            next: if drawn { rng.uniform() * step } else { 0.0 },
        }
    }

    /// Returns the carried weight of the next spot, which has weight `w`.
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
    /// Finds the light that arrives at a shared vertex: from all spots directly, from beyond by
    /// walks. `drawn` is the number of candidates drawn from spots, `density` the density of
    /// drawing this one from gather points, if they have been weighed.
    ///
    /// The number of walks is proportional to the part of their light that the gather points
    /// receive: the square root of the sum of the squared weights, normalised so that 1 is a vertex
    /// that sends its light equally to all of them. Light for a rough vertex is drawn by its
    /// scattering to a gather point drawn by the same weights.
    pub(crate) fn light_up(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        (at, drawn, density): (usize, u32, Option<f32>),
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let emitters = walk.emitters;
        let per_metre = 1.0 / film.gate.bin_width_m;
        let (count, total) = (self.gathers.len(), self.shared.len());
        let (nearest, bounce) = (self.nearest_m, self.lowest + 1);
        let row = &self.weight[at * count..(at + 1) * count];
        let y = &mut self.shared[at];
        let h = &y.hit;
        let window = walk
            .window
            .map(|w| self.shells.window(walk.world, &w, h.p, nearest));
        let walk = &Walk { window, ..*walk };
        if !walk.in_time(h.p, nearest) {
            return;
        }
        let to = y.rough.and_then(|_| {
            let u = rng.uniform();
            let mut at = (u * count as f32) as usize;
            if density.is_some() {
                draw(row, 1, u, |i, _| at = i);
            }
            let to = self.gathers[at.min(count - 1)].0.hit.p - h.p;
            (h.n.dot(to) > 0.0).then(|| to.normalized())
        });
        let guide = to.zip(y.rough).map(|(to, surface)| Guide {
            surface: surface.guide(),
            n: h.n,
            to,
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
        let mut from_spots = 0.0;
        let vertex = Vertex {
            hit: Hit {
                surface: seen_as,
                ..*h
            },
            wo,
            beta: 1.0,
            length_m: nearest,
            bounce,
            sight: Sight::ELSEWHERE,
        };
        let walk_on = |often: f32, rng: &mut Rng, sink: &mut ArrivalSink, scratch: &mut Scratch| {
            sink.factor = 1.0 / often;
            sink.at(Place::Walk);
            for _ in 0..(often + rng.uniform()) as u32 {
                sink.left = false;
                walk.run(rng, (vertex, effort.spots.0), scratch, sink);
            }
        };
        if density.is_none() {
            walk_on(1.0, rng, &mut sink, scratch);
            sink.factor = 1.0;
            sink.at(Place::Shared);
            sink.left = false;
        }
        let of = (Seen::of(h, wo), &seen_as);
        emitters.weights(of, &mut scratch.plain, &mut scratch.weights);
        walk.leave_to_zones(h, &mut scratch.weights);
        if sink.list.bins.len() == y.first && !walk.any_in_window(h.p, nearest, &scratch.weights) {
            return;
        }
        self.segments.clear();
        for (spot, &w) in scratch.weights.iter().enumerate() {
            if w > 0.0 {
                self.segments.push(spot, emitters.lifted[spot]);
            }
        }
        let from = lift(h.p, h.n);
        self.segments.trace(walk.world, &mut scratch.stack, from);
        let lit = self.segments.found();
        let lit = lit.filter_map(|(spot, through)| Some((spot, through?)));
        let lit: Vec<(usize, f32)> = lit.collect();
        let mut carry = Carry::new(y.rough.is_some(), &lit, &scratch.weights, rng);
        // The densities do not depend on glass in between.
        for (spot, through) in lit {
            let (e, w) = (&emitters.list[spot], scratch.weights[spot]);
            let to = h.p - e.p;
            let d2 = to.dot(to);
            let d = d2.sqrt();
            let strength = emitters.columns.strength[spot];
            from_spots += if strength > 0.0 && guide.is_none() {
                w / (strength * h.surface.lambertian() * PI)
            } else {
                let out = to / d;
                e.surface.pdf(e.n, e.back, out) * h.n.dot(out).abs() / d2
            };
            let path = nearest + walk.world.metres(d) + e.path_m;
            let carried = carry.share(w) * through;
            if carried > 0.0 && walk.window.is_none_or(|w| w.holds(path)) {
                let back = to * (-1.0 / d);
                sink.toward(back);
                sink.add(path, carried, spot, bounce + 1, Way::Spot);
            }
        }
        y.light = from_spots * drawn as f32 / emitters.list.len() as f32;
        if let Some(patches) = walk.patches {
            y.light += self.shells.density((walk.world, patches), h);
        }
        if let Some(density) = density {
            let square: f32 = row.iter().map(|w| w * w).sum();
            let taken = y.counts * square.sqrt() / (density + y.light);
            let often = effort.walks * taken * total as f32 / (count as f32).sqrt();
            walk_on(often.clamp(WALKS.0, WALKS.1), rng, &mut sink, scratch);
        }
        y.end = sink.list.bins.len();
    }
}

#[cfg(test)]
mod tests {
    use crate::numeric::rng::Rng;
    use crate::numeric::rng::Stream;
    use crate::paths::path_reuse::light_up::Carry;

    #[test]
    fn each_spot_is_carried_with_its_own_weight_on_average() {
        const SPOTS: usize = 100;
        let weights: Vec<f32> = (0..SPOTS).map(|k| (1 + k * k % 17) as f32).collect();
        let lit = (0..SPOTS).filter(|k| k % 4 != 1).map(|k| (k, 1.0));
        let lit: Vec<(usize, f32)> = lit.collect();
        assert!(lit.len() > crate::paths::path_reuse::light_up::ROUGH_SPOTS);
        let mut rng = Rng::new(1, Stream::Paths, 2, 3);
        let (mut sums, n) = ([0.0f64; SPOTS], 20_000);
        for _ in 0..n {
            let mut carry = Carry::new(true, &lit, &weights, &mut rng);
            let mut carried = 0;
            for &(spot, _) in &lit {
                let share = carry.share(weights[spot]);
                carried += u32::from(share > 0.0);
                sums[spot] += f64::from(share) / f64::from(n);
            }
            assert!(carried <= crate::paths::path_reuse::light_up::ROUGH_SPOTS as u32 + 1);
        }
        for &(spot, _) in &lit {
            let miss = sums[spot] / f64::from(weights[spot]) - 1.0;
            assert!(miss.abs() < 0.06, "spot {spot}: {miss}");
        }
    }
}
