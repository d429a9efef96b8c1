//! Carrying light: what arrives at the shared vertices, and what of it reaches each pixel.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use super::{ArrivalSink, Effort, Guide, ROUGH_SPOTS, Sharing};
use crate::{
    emitter::Columns,
    film::Film,
    lanes::{self, SIDE, Wide, widest},
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

    /// Weighs every pair of shared vertex and gather point.
    pub(super) fn connect(
        &mut self,
        (walk, film): (&Walk, &Film),
        drawn: u32,
        scratch: &mut Scratch,
    ) {
        let count = self.gathers.len();
        self.weight.clear();
        self.offset.clear();
        self.weight.resize(count * self.shared.len(), 0.0);
        self.offset.resize(count * self.shared.len(), 0.0);
        let share = drawn as f32 / count as f32;
        self.lengths.lay((walk, film), &self.gathers);
        let rows = self
            .weight
            .chunks_mut(count)
            .zip(self.offset.chunks_mut(count));
        for (y, (weight, offset)) in self.shared.iter().zip(rows) {
            if walk.window.is_some() && y.first == y.end {
                continue;
            }
            let h = &y.hit;
            self.columns.irradiance(h.p, h.n, weight);
            for &i in &self.glossy {
                let x = &self.gathers[i].0.hit;
                let to = x.p - h.p;
                let seen = h.n.dot(to) > 0.0 && x.n.dot(to) < 0.0;
                weight[i] = if seen { 1.0 } else { 0.0 };
            }
            self.ends.clear();
            self.ends_of.clear();
            for (i, (w, (v, _))) in weight.iter().zip(&self.gathers).enumerate() {
                if *w > 0.0 {
                    self.ends.push(lift(v.hit.p, v.hit.n));
                    self.ends_of.push(i);
                }
            }
            self.blocked.resize(self.ends.len(), false);
            walk.world.bvh.occluded_bundle(
                &mut scratch.stack,
                lift(h.p, h.n),
                &self.ends,
                &mut self.blocked,
            );
            for (&i, &blocked) in self.ends_of.iter().zip(&self.blocked) {
                if blocked {
                    weight[i] = 0.0;
                }
            }
            let mut density = 0.0;
            self.apart.clear();
            self.scattered.resize(self.glossy.len(), 0.0);
            self.drawn.resize(self.glossy.len(), 0.0);
            let (scattered, drawn) = (&mut self.scattered, &mut self.drawn);
            self.lobes.toward((h.p, h.n), scattered, drawn);
            for ((&i, &value), &pdf) in self.glossy.iter().zip(&*scattered).zip(&*drawn) {
                if weight[i] == 0.0 {
                    continue;
                }
                let v = &self.gathers[i].0;
                let x = &v.hit;
                let (mut value, mut pdf) = (value, pdf);
                if !x.surface.ggx() {
                    let to = h.p - x.p;
                    let d2 = to.dot(to);
                    let w_in = to / d2.sqrt();
                    let cos = h.n.dot(w_in).abs() / d2;
                    pdf = x.surface.pdf(x.n, v.wo, w_in) * cos;
                    value = x.surface.scatter(x.n, v.wo, w_in) * cos;
                }
                density += pdf;
                self.apart.push((i, v.beta * value));
                weight[i] = 0.0;
            }
            density += self.lengths.weigh(&self.columns, h.p, weight, offset);
            for &(i, value) in &self.apart {
                weight[i] = value;
            }
            let density = density * share + y.light;
            let inverse = if density > 0.0 { 1.0 / density } else { 0.0 };
            for w in weight.iter_mut() {
                *w *= inverse;
            }
            if walk.world.has_glass() {
                let from = lift(h.p, h.n);
                for (&i, &to) in self.ends_of.iter().zip(&self.ends) {
                    if weight[i] > 0.0 {
                        weight[i] *= walk.world.glass(&mut scratch.stack, from, to);
                    }
                }
            }
        }
    }

    /// Carries the arrivals to the pixels.
    pub(super) fn spread(&self, (walk, film): (&Walk, &Film), pixels: &mut [f32]) {
        if film.spectral {
            return self.spread_spectral((walk, film), pixels);
        }
        widest(Spread {
            sharing: self,
            walk,
            film,
            pixels,
        });
    }

    #[inline(always)]
    fn spread_wide(&self, (walk, film): (&Walk, &Film), pixels: &mut [f32]) {
        let count = self.gathers.len();
        let size = film.pixel();
        let last = film.slots as f32 - 1.0;
        let lowest = self.lowest();
        let bounded = walk.max_bounces < u32::MAX;
        // Every second arrival is summed here: a sum that waits for the one just before it in the same slot takes several
        // times as long.
        let mut second = vec![0.0f32; film.slots];
        let mut sent = vec![];
        for (i, (v, k)) in self.gathers.iter().enumerate() {
            let pixel = &mut pixels[k * size..(k + 1) * size];
            let deeper = v.bounce - lowest;
            for (y, row) in self
                .shared
                .iter()
                .zip(self.weight.chunks(count).zip(self.offset.chunks(count)))
            {
                let (weight, offset) = (row.0[i], row.1[i] + 1.0);
                if weight == 0.0 {
                    continue;
                }
                let range = y.first..y.end;
                let a = &self.arrivals;
                let bins = &a.bins[range.clone()];
                let values = match &y.rough {
                    None => &a.value[range.clone()],
                    Some(surface) => {
                        let to = (v.hit.p - y.hit.p).normalized();
                        self.gloss.send(y, surface, to, &mut sent);
                        &sent
                    }
                };
                if film.channels == 1 && !bounded {
                    let first = &mut pixel[..film.slots];
                    let (many, few) = bins.as_chunks::<SIDE>();
                    let (values, last_values) = values.as_chunks::<SIDE>();
                    // Slots and values side by side.
                    for (bins, values) in many.iter().zip(values) {
                        let (mut slots, mut found) = ([0u32; SIDE], [0.0f32; SIDE]);
                        for (slot, b) in slots.iter_mut().zip(bins) {
                            *slot = floor(b + offset, last);
                        }
                        for (found, v) in found.iter_mut().zip(values) {
                            *found = weight * v;
                        }
                        for k in (0..SIDE).step_by(2) {
                            first[slots[k] as usize] += found[k];
                            second[slots[k + 1] as usize] += found[k + 1];
                        }
                    }
                    for (k, (b, v)) in few.iter().zip(last_values).enumerate() {
                        let sums = if k % 2 == 0 { &mut *first } else { &mut second };
                        sums[floor(b + offset, last) as usize] += weight * v;
                    }
                    continue;
                }
                let rest = a.spot[range.clone()].iter().zip(&a.bounces[range]);
                let each = bins.iter().zip(values).zip(rest);
                // In the same order as above: groups of spots change no bit.
                for (k, ((&b, &value), (&spot, &bounces))) in each.enumerate() {
                    if u32::from(bounces) + deeper > walk.max_bounces {
                        continue;
                    }
                    let slot = floor(b + offset, last) as usize;
                    let light = Light {
                        value: weight * value,
                        ratios: ONES,
                    };
                    let first = if k % 2 == 0 {
                        &mut pixel[slot]
                    } else {
                        &mut second[slot]
                    };
                    *first += light.value;
                    film.add_to_groups(pixel, slot, &light, usize::from(spot));
                }
            }
            for (sum, second) in pixel.iter_mut().zip(&mut second) {
                *sum += std::mem::take(second);
            }
        }
    }
}

/// [`Sharing::spread`].
struct Spread<'a> {
    sharing: &'a Sharing,
    walk: &'a Walk<'a>,
    film: &'a Film,
    pixels: &'a mut [f32],
}

impl Wide for Spread<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let of = (self.walk, self.film);
        self.sharing.spread_wide(of, self.pixels);
    }
}

/// What the gather points do with light of a direction, side by side.
#[derive(Debug, Default)]
pub(super) struct Lengths {
    /// Albedo/π times the weight of the camera path; of surfaces that are not Lambertian anything.
    factor: Vec<f32>,
    /// Optical path from the camera less the gate's start, in bins.
    bins: Vec<f64>,
    /// Bins in a render unit.
    per_unit: f64,
}

impl Lengths {
    fn lay(&mut self, (walk, film): (&Walk, &Film), gathers: &[(Vertex, usize)]) {
        let per_metre = 1.0 / film.gate.bin_width_m;
        self.per_unit = walk.world.metres(1.0) * per_metre;
        self.factor.clear();
        self.bins.clear();
        for (v, _) in gathers {
            self.factor.push(v.beta * v.hit.surface.lambertian());
            self.bins.push((v.length_m - film.gate.start_m) * per_metre);
        }
    }

    /// Turns the irradiances that a shared vertex in `y` casts on Lambertian gather points into what they send to the
    /// camera, and finds the optical paths by way of it, in bins. Returns the density of drawing the vertex from them. No
    /// branches, and sums side by side: the compiler works on several at once.
    fn weigh(&self, columns: &Columns, y: Vec3, weight: &mut [f32], offset: &mut [f32]) -> f32 {
        widest(Weigh {
            lengths: self,
            columns,
            y,
            weight,
            offset,
        })
    }

    #[inline(always)]
    fn weigh_wide(
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

/// [`Lengths::weigh`].
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

/// ⌊x⌋ within 0..=last, for last < 2²². Half an ulp of 2²³ is ½: adding it leaves the integer in the low
/// bits, without the checks of a cast. (An x within rounding of an integer may fall to either side.)
#[inline(always)]
pub(super) fn floor(x: f32, last: f32) -> u32 {
    let half = x.max(0.5).min(last + 0.5) - 0.5;
    (half + 8_388_608.0).to_bits() & 0x007f_ffff
}

#[cfg(test)]
mod tests {
    use super::{Carry, floor};
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

    #[test]
    fn slots_are_whole_parts_within_their_range() {
        for k in 0..4000u32 {
            for part in [0.01, 0.3, 0.5, 0.7, 0.99] {
                assert_eq!(floor(k as f32 + part, 638.0), k.min(638));
            }
        }
        assert_eq!(floor(-7.5, 638.0), 0);
        assert_eq!(floor(f32::INFINITY, 638.0), 638);
        assert_eq!(floor(1_048_577.5, 1_048_577.0), 1_048_577);
    }
}
