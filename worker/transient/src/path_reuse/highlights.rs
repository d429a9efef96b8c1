//! Shared vertices where rough planar surfaces mirror the spots for some of the gather points. Neither gather points nor spots draw
//! many there by their own scattering, and what is sent on there is several times what is sent on elsewhere.

use super::{Effort, Shared};
use crate::{
    mirror_images::Mirrors, rng::Rng, vertex::Vertex, walk::Scratch, walk::Walk, world::Hit, world::lift,
};

/// Gather points of a pass that vertices are drawn for: their neighbours see nearly the same.
const FOR: usize = 4;

/// The gather points that such vertices are drawn for, and how many.
#[derive(Debug, Default)]
pub(super) struct Highlights {
    /// Indices of the gather points.
    of: Vec<usize>,
    /// Vertices drawn for each.
    each: f32,
    /// `[gather point][plane][spot]`: chances.
    chances: Vec<f32>,
    /// Planes times spots.
    choices: usize,
}

impl Highlights {
    /// Draws vertices for a tile of `pixels`.
    pub fn draw(
        &mut self,
        (walk, effort, pixels): (&Walk, &Effort, f32),
        gathers: &[(Vertex, usize)],
        rng: &mut Rng,
        scratch: &mut Scratch,
        shared: &mut Vec<Shared>,
    ) {
        self.of.clear();
        let wide = walk.wide_mirrors;
        if wide.list.is_empty() {
            return;
        }
        let count = FOR.min(gathers.len());
        let start = rng.uniform();
        self.choices = wide.choices();
        self.chances.clear();
        self.chances.resize(count * self.choices, 0.0);
        for (k, chances) in self.chances.chunks_mut(self.choices).enumerate() {
            let at = ((k as f32 + start) / count as f32 * gathers.len() as f32) as usize;
            let at = at.min(gathers.len() - 1);
            let v = &gathers[at].0;
            let h = &v.hit;
            wide.weights(h.p, h.n, chances);
            wide.seen_by(v, chances);
            let total: f32 = chances.iter().sum();
            let scale = if total > 1e-30 { 1.0 / total } else { 0.0 };
            chances.iter_mut().for_each(|w| *w *= scale);
            self.of.push(at);
        }
        let each = (pixels * effort.highlights / count as f32).round().max(1.0);
        self.each = each;
        for (&at, chances) in self.of.iter().zip(self.chances.chunks(self.choices)) {
            let v = &gathers[at].0;
            let h = &v.hit;
            for _ in 0..each as u32 {
                let Some(aim) = wide.aim_by(chances, 1.0, h.p, rng) else {
                    break;
                };
                let from = lift(h.p, h.n);
                if h.n.dot(aim.target - h.p) <= 0.0 {
                    continue;
                }
                let to = aim.target - from;
                let Some(mut hit) = walk.world.closest(&mut scratch.stack, from, to) else {
                    continue;
                };
                if wide.of(hit.triangle) != Some(aim.mirror) {
                    continue;
                }
                hit.choose_lobe(walk.world, rng);
                shared.extend(Shared::new(hit));
            }
        }
    }

    /// Expected number of such vertices per area at `h`, which the gather points see that have a `weight`.
    pub fn density(
        &self,
        wide: &Mirrors,
        gathers: &[(Vertex, usize)],
        h: &Hit,
        weight: &[f32],
    ) -> f32 {
        if self.of.is_empty() {
            return 0.0;
        }
        let Some(mirror) = wide.of(h.triangle) else {
            return 0.0;
        };
        let mut sum = 0.0;
        let spots = self.choices / wide.list.len();
        for (&at, chances) in self.of.iter().zip(self.chances.chunks(self.choices)) {
            if weight[at] == 0.0 {
                continue;
            }
            let x = &gathers[at].0.hit;
            let to = h.p - x.p;
            let d2 = to.dot(to);
            let turn = h.n.dot(to).abs() / (d2 * d2.sqrt());
            let chances = &chances[mirror * spots..(mirror + 1) * spots];
            sum += turn * wide.pdf_of_all(mirror, chances, x.p, h.p);
        }
        self.each * sum
    }
}
