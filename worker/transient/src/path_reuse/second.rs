//! Second vertices: what the shared vertices of a tile share in turn.
//!
//! A walk from a shared vertex knows one direction from which light arrives there, and a rough vertex sends light of one direction
//! to few pixels. So where walks from the shared vertices, and light paths from the spots, end on surfaces that can be shared,
//! they make *second vertices*, and every shared vertex is connected to every second vertex, as every gather point is to every
//! shared vertex (Bekaert, Sbert and Halton, EGWR 2002, once more). All ways of drawing one are joined by the balance heuristic
//! with visibility in the densities, given the shared vertices. Of what all second vertices send to a shared one some is drawn by
//! contribution, and carried to the pixels.

use super::{
    ArrivalSink, Arrivals, Effort, Shared, Sharing,
    arrivals::{Look, from_spots},
    gloss::Gloss,
    segments::Segments,
};
use crate::{
    film::Film,
    lobes::{Lobes, Seen},
    rng::Rng,
    sink::{Place, Sink},
    spectra::{ONES, Ratios, times},
    vertex::Vertex,
    walk::{SPOTS, Scratch, Walk, draw},
    world::{Hit, lift},
};

/// Buffers, and the vertices of a pass.
#[derive(Debug, Default)]
pub(super) struct Second {
    /// Walks make second vertices.
    pub on: bool,
    /// Which shared vertices look for light, how, and how many walks begin at each on average.
    of: Vec<usize>,
    looks: Vec<Look>,
    often: Vec<f32>,
    lobes: Lobes,
    list: Vec<Shared>,
    arrivals: Arrivals,
    gloss: Gloss,
    segments: Segments,
    /// `[second][shared]`: what the shared vertex takes of light that the second one sends to it, over the density of drawing it.
    weight: Vec<f32>,
    /// The same times the light that is sent.
    light: Vec<f32>,
    /// Of one second vertex.
    drawn: Vec<f32>,
    sent: Vec<f32>,
    /// Of one shared vertex.
    taken: Vec<f32>,
}

impl Second {
    pub fn clear(&mut self) {
        self.of.clear();
        self.looks.clear();
        self.often.clear();
        self.lobes.clear();
        self.list.clear();
        self.arrivals.clear();
    }

    /// Begins the walks from shared vertex `at`, `often` on average. Where they end on surfaces that can be shared they make second
    /// vertices; others go on for this vertex alone.
    pub fn begin(
        &mut self,
        walk: &Walk,
        (at, look, vertex): (usize, Look, Vertex),
        often: f32,
        sink: &mut ArrivalSink,
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        if !walk.goes_on(&vertex) {
            return;
        }
        self.of.push(at);
        self.looks.push(look);
        self.often.push(often);
        let place = Seen::of(&vertex.hit, vertex.wo);
        self.lobes.push(&place, &look.surface);
        sink.factor = 1.0 / often;
        for _ in 0..(often + rng.uniform()) as u32 {
            sink.left = false;
            sink.at(Place::Walk);
            let next = walk.begin(rng, &vertex, scratch, sink);
            let Some((step, next)) = next else { continue };
            if next.hit.surface.is_black() {
                continue;
            }
            match next.hit.surface.is_shared() {
                true => self.list.extend(Shared::new(next.hit)),
                false => {
                    walk.connect(rng, &next, Some(&step), SPOTS, scratch, sink);
                    walk.run(rng, next, scratch, sink);
                }
            }
        }
    }
}

impl Sharing {
    /// Finds what second vertices send to the shared ones, and adds some of it to what arrives at these.
    pub(super) fn connect_second(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let from_light = (effort.second * self.second.of.len() as f32).round() as u32;
        let mut list = std::mem::take(&mut self.second.list);
        Self::draw_from_spots(walk, from_light, rng, scratch, &mut list);
        self.second.list = list;
        self.weigh_second((walk, film, effort), from_light, rng, scratch);
        let Self {
            second,
            shared,
            arrivals,
            ..
        } = self;
        second.gloss.lay(&second.list, &second.arrivals);
        second.shine(shared);
        let per_metre = 1.0 / film.gate.bin_width_m;
        let mut all = Arrivals::default();
        let mut looking = 0;
        for (at, y) in shared.iter_mut().enumerate() {
            let first = all.bins.len();
            all.extend(arrivals, y.first..y.end);
            if second.of.get(looking) == Some(&at) {
                second.send((walk, film), (looking, y), per_metre, effort, rng, &mut all);
                looking += 1;
            }
            (y.first, y.end) = (first, all.bins.len());
        }
        *arrivals = all;
    }

    /// Weighs all pairs of second and shared vertices, and lights the second ones. `drawn` of them were drawn from spots.
    fn weigh_second(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        drawn: u32,
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let Self {
            second: s,
            shared,
            nearest_m,
            lowest,
            ..
        } = self;
        let count = s.of.len();
        s.weight.clear();
        s.weight.resize(count * s.list.len(), 0.0);
        s.drawn.clear();
        s.drawn.resize(count, 0.0);
        let place = (*nearest_m, *lowest + 2);
        for (p, row) in s.list.iter_mut().zip(s.weight.chunks_mut(count.max(1))) {
            let first = s.arrivals.bins.len();
            (p.first, p.end) = (first, first);
            let h = &p.hit;
            s.lobes.toward((h.p, h.n), row, &mut s.drawn);
            s.segments.clear();
            for (k, w) in row.iter_mut().enumerate() {
                let y = &shared[s.of[k]].hit;
                if *w > 0.0 && h.n.dot(y.p - h.p) > 0.0 {
                    s.segments.push(k, lift(y.p, y.n));
                } else {
                    *w = 0.0;
                }
            }
            let from = lift(h.p, h.n);
            s.segments.trace(walk.world, &mut scratch.stack, from);
            let mut density = 0.0;
            for (k, blocked) in s.segments.found() {
                match blocked {
                    true => row[k] = 0.0,
                    false => density += s.often[k] * s.drawn[k],
                }
            }
            if walk.world.has_glass() {
                for (k, to) in s.segments.iter() {
                    if row[k] > 0.0 {
                        row[k] *= walk.world.glass(&mut scratch.stack, from, to);
                    }
                }
            }
            let mut seen_from = None;
            draw(row, 1, rng.uniform(), |k, _| seen_from = Some(k));
            let Some(seen_from) = seen_from else { continue };
            let look = Look::new(p, Some(shared[s.of[seen_from]].hit.p));
            let vertex = look.vertex(p, place);
            let of = (Seen::of(h, look.wo), &look.surface);
            walk.emitters
                .weights(of, &mut scratch.plain, &mut scratch.weights);
            walk.leave_to_zones(h, &mut scratch.weights);
            let mut sink = ArrivalSink {
                list: &mut s.arrivals,
                base_m: place.0,
                per_metre: 1.0 / film.gate.bin_width_m,
                factor: 1.0,
                film,
                place: Place::Walk,
                guide: look.guide,
                share: 1.0,
                from: h.n,
                left: false,
            };
            let into = (&mut sink, &mut s.segments);
            p.light = from_spots(walk, (&*p, &look), place, drawn, into, rng, scratch);
            density += p.light;
            let often = effort.second_walks;
            sink.factor = 1.0 / often;
            for _ in 0..(often + rng.uniform()) as u32 {
                sink.left = false;
                walk.run(rng, vertex, scratch, &mut sink);
            }
            p.end = s.arrivals.bins.len();
            let inverse = if density > 0.0 { 1.0 / density } else { 0.0 };
            for w in row {
                *w *= inverse;
            }
        }
    }
}

impl Second {
    /// Multiplies the weights by the light that is sent.
    fn shine(&mut self, shared: &[Shared]) {
        let count = self.of.len();
        self.light.clear();
        self.light.extend_from_slice(&self.weight);
        for (p, row) in self.list.iter().zip(self.light.chunks_mut(count.max(1))) {
            let all = match &p.rough {
                None => self.arrivals.value[p.first..p.end].iter().sum::<f32>(),
                Some(_) => 1.0,
            };
            for (w, &of) in row.iter_mut().zip(&self.of) {
                if *w == 0.0 {
                    continue;
                }
                *w *= match &p.rough {
                    None => all,
                    Some(surface) => {
                        let to = (shared[of].hit.p - p.hit.p).normalized();
                        self.gloss.send(p, surface, to, &mut self.sent);
                        self.sent.iter().sum()
                    }
                };
            }
        }
    }

    /// Adds what is sent to the `k`th of the shared vertices that look on, `y`.
    fn send(
        &mut self,
        (walk, film): (&Walk, &Film),
        (k, y): (usize, &Shared),
        per_metre: f64,
        effort: &Effort,
        rng: &mut Rng,
        to: &mut Arrivals,
    ) {
        let count = self.of.len();
        self.taken.clear();
        self.taken.extend(self.light.iter().skip(k).step_by(count));
        let look = &self.looks[k];
        let (u, v) = (rng.uniform(), rng);
        draw(&self.taken, effort.second_draws.0, u, |j, share| {
            let p = &self.list[j];
            let leg = p.hit.p - y.hit.p;
            let d = leg.length();
            let w = leg / d;
            let range = p.first..p.end;
            let sent = match &p.rough {
                None => &self.arrivals.value[range.clone()],
                Some(surface) => {
                    self.gloss.send(p, surface, -w, &mut self.sent);
                    &self.sent[..]
                }
            };
            let all: f32 = sent.iter().sum();
            let share = share / all * look.guide.as_ref().map_or(1.0, |g| g.share(w));
            let bins = (walk.world.metres(d) * per_metre) as f32;
            draw(sent, effort.second_draws.1, v.uniform(), |i, value| {
                let (at, value) = (range.start + i, share * value);
                let a = &self.arrivals;
                to.bins.push(a.bins[at] + bins);
                to.value.push(value);
                to.spot.push(a.spot[at]);
                to.bounces.push(a.bounces[at]);
                to.from.push(w);
                if film.spectral {
                    let there = match &p.rough {
                        None => ONES,
                        Some(surface) => {
                            let rough = Hit {
                                surface: *surface,
                                ..p.hit
                            };
                            walk.world.ratios(&rough, -w, a.from[at])
                        }
                    };
                    let ratios: Ratios = a.light[at].map(|x| x / a.value[at]);
                    let here = walk.world.ratios(&y.hit, y.hit.n, w);
                    let all = times(times(ratios, there), here);
                    to.light.push(all.map(|x| value * x));
                }
            });
        });
    }
}
