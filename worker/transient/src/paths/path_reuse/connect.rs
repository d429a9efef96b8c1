//! The weights of the gather points for light from each shared vertex.

use crate::{
    film::slots::Film,
    numeric::rng::Rng,
    paths::{
        path_reuse::{effort::Effort, sharing::Sharing},
        scratch::Scratch,
        tracer::Walk,
    },
    scene::intersection::lift,
};

impl Sharing {
    /// Weighs every pair of shared vertex and gather point, and finds the arrivals at the vertices.
    /// `drawn` are the numbers of candidates drawn from gather points and from spots.
    ///
    /// The effort for arrivals is proportional to the light that the gather points receive. A
    /// narrow gate is different: few vertices have arrivals in its window, and only those are
    /// weighed.
    pub(crate) fn connect(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        drawn: (u32, u32),
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let count = self.gathers.len();
        self.weight.clear();
        self.offset.clear();
        self.weight.resize(count * self.shared.len(), 0.0);
        self.offset.resize(count * self.shared.len(), 0.0);
        self.lengths.lay((walk, film), &self.gathers);
        let share = drawn.0 as f32 / count as f32;
        let of = (walk, film, effort);
        for at in 0..self.shared.len() {
            let first = self.arrivals.fill_up();
            self.shared[at].first = first;
            self.shared[at].end = first;
            if walk.window.is_some() {
                self.light_up(of, (at, drawn.1, None), rng, scratch);
                if self.shared[at].end == first {
                    continue;
                }
            }
            let density = share * self.weigh(walk, at, scratch);
            let row = at * count..(at + 1) * count;
            if walk.window.is_none() {
                if self.weight[row.clone()].iter().all(|&w| w == 0.0) {
                    continue;
                }
                self.light_up(of, (at, drawn.1, Some(density)), rng, scratch);
            }
            let y = &self.shared[at];
            let density = density + y.light;
            let inverse = if density > 0.0 {
                y.counts / density
            } else {
                0.0
            };
            for w in &mut self.weight[row] {
                *w *= inverse;
            }
        }
        self.arrivals.fill_up();
    }

    /// Writes the weight of each gather point for light that a shared vertex sends to it. Returns
    /// the density of drawing the vertex from one of them.
    pub fn weigh(&mut self, walk: &Walk, at: usize, scratch: &mut Scratch) -> f32 {
        let count = self.gathers.len();
        let y = &self.shared[at];
        let weight = &mut self.weight[at * count..(at + 1) * count];
        let offset = &mut self.offset[at * count..(at + 1) * count];
        let h = &y.hit;
        self.columns.irradiance(h.p, h.n, weight);
        for &i in &self.glossy {
            let x = &self.gathers[i].0.hit;
            let to = x.p - h.p;
            let seen = h.n.dot(to) > 0.0 && x.n.dot(to) < 0.0;
            weight[i] = if seen { 1.0 } else { 0.0 };
        }
        self.segments.clear();
        for (i, (w, (v, _))) in weight.iter().zip(&self.gathers).enumerate() {
            if *w > 0.0 {
                self.segments.push(i, lift(v.hit.p, v.hit.n));
            }
        }
        let from = lift(h.p, h.n);
        self.segments.trace(walk.world, &mut scratch.stack, from);
        for (i, through) in self.segments.found() {
            if through.is_none() {
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
            density += pdf;
            self.apart.push((i, v.beta * value));
            weight[i] = 0.0;
        }
        density += self.lengths.weigh(&self.columns, h.p, weight, offset);
        for &(i, value) in &self.apart {
            weight[i] = value;
        }
        if walk.world.has_glass() {
            for (i, through) in self.segments.found() {
                weight[i] *= through.unwrap_or(0.0);
            }
        }
        density
    }
}
