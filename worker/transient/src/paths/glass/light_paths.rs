//! Light paths via glass.

use crate::{
    light::light_vertices::{ALONE, LightVertex},
    numeric::rng::Rng,
    paths::{
        glass::{
            arrive::arrive,
            buffers::Buffers,
            lit_points::LitPoints,
            point::PathState,
            ray::{Ray, StraightShares, pick},
            technique::GlassTechnique,
        },
        tracer::Tracer,
    },
    scene::hit::Hit,
};

impl GlassTechnique<'_> {
    /// Draws the light vertices and lit points that camera paths are connected to. The light
    /// vertices come from `count` light paths.
    pub fn lay(&self, tracer: &Tracer, count: u32, rng: &mut Rng, buffers: &mut Buffers) {
        let mut vertices = std::mem::take(&mut buffers.vertices);
        vertices.clear();
        for l in 0..count {
            self.trace(tracer, (l, count), rng, buffers, |z, _| vertices.push(z));
        }
        buffers.vertices = vertices;
        LitPoints::prepare(tracer, rng, &mut buffers.scratch);
        if self.images.any() {
            let surfaces = (tracer, &self.areas);
            buffers.lit.lay(surfaces, rng, &mut buffers.scratch);
        }
    }

    /// Traces light path `l` of a batch of `count`. Calls `each` with every surface point on the
    /// path, and whether glass turned all legs up to there. The sum over the batch is an estimate.
    pub fn trace(
        &self,
        tracer: &Tracer,
        (l, count): (u32, u32),
        rng: &mut Rng,
        buffers: &mut Buffers,
        mut each: impl FnMut(LightVertex, bool),
    ) {
        let world = tracer.world;
        let Some(start) = self.start(tracer, (l, count), rng, buffers) else {
            return;
        };
        let (spot, imaged, mut path, mut ray) = start;
        let mut all = true;
        for vertex in 0.. {
            let tools = (&mut buffers.scratch.stack, &mut buffers.crossings);
            let Some(point) = arrive(
                (world, &self.images),
                &path,
                (ray, 0.0),
                &self.tuning,
                rng,
                tools,
            ) else {
                return;
            };
            // Camera paths cover this path by the image.
            if vertex == 0 && imaged && point.turns == 1 {
                return;
            }
            let there = &point.path;
            if point.hit.surface.is_black()
                || there.bounces > tracer.max_bounces
                || there.length_m >= tracer.gate.end_m()
            {
                return;
            }
            all &= point.turns > 0;
            let z = LightVertex {
                hit: point.hit,
                back: point.back,
                flux: there.weight,
                alpha: 0.0,
                density: ALONE,
                path_m: there.length_m,
                spot,
                bounces: there.bounces,
            };
            each(z, all);
            let survive = |weight: f32| match vertex < self.tuning.sure {
                true => 1.0,
                false => weight.min(0.95),
            };
            let Some(onward) = point.scatter(survive, rng) else {
                return;
            };
            (path, ray) = onward;
        }
    }

    /// Draws the first leg of a light path up to its first turn. Returns the emitter, whether it
    /// has an image in the pane that turned the leg, the flux, and the ray there.
    pub fn start(
        &self,
        tracer: &Tracer,
        (l, count): (u32, u32),
        rng: &mut Rng,
        buffers: &mut Buffers,
    ) -> Option<(usize, bool, PathState, Ray)> {
        let (world, emitters) = (tracer.world, tracer.emitters);
        let spots = emitters.list.len();
        let plain = if self.targets.any() { count / 4 } else { count };
        let aimed = count - plain;
        let stack = &mut buffers.scratch.stack;
        let (spot, w, target) = if l < aimed {
            let position = (f64::from(l) + f64::from(rng.uniform())) / f64::from(aimed);
            let drawn = self.targets.draw(position, || rng.uniform())?;
            let to = drawn.p - emitters.lifted[drawn.spot];
            (drawn.spot, to.normalized(), Some(drawn.target as u32))
        } else {
            let position = ((l - aimed) as f32 + rng.uniform()) / plain as f32;
            let spot = ((position * spots as f32) as usize).min(spots - 1);
            let e = &emitters.list[spot];
            (spot, e.surface.sample(e.n, e.back, rng)?.w, None)
        };
        let e = &emitters.list[spot];
        let intensity = e.intensity(w);
        if intensity.is_nan() || intensity <= 0.0 {
            return None;
        }
        let from = emitters.lifted[spot];
        let hit = world.ahead(stack, from, w, &mut buffers.crossings);
        let body = hit.as_ref().and_then(|h| world.body(h.triangle));
        // Shares of the light that are turned in this direction: by each pane, and by a body behind
        // the panes.
        let shares = StraightShares::new(&buffers.crossings, hit.as_ref());
        let straight = if body.is_some() { shares.straight } else { 0.0 };
        let total = shares.reflected + straight;
        if total <= 0.0 {
            return None;
        }
        let pane = match target {
            None => {
                let u = rng.uniform() * total;
                match u < shares.reflected {
                    true => Some(pick(&buffers.crossings, u)?),
                    false => None,
                }
            }
            Some(target) => {
                let mut panes = buffers.crossings.iter().map(|c| c.pane);
                let pane = panes.find(|&pane| self.of_pane[pane as usize] == target);
                let at_body = |h: &Hit| self.of_triangle[h.triangle as usize] == target;
                if pane.is_none() && !hit.as_ref().is_some_and(at_body) {
                    return None;
                }
                pane
            }
        };
        // The share of the light, the target index, and the point and normal of the turn.
        let (share, target, p, n) = match pane {
            None => {
                let h = hit.as_ref()?;
                (straight, self.of_triangle[h.triangle as usize], h.p, h.n)
            }
            Some(pane) => {
                let mut reach = 1.0;
                let mut share = 0.0;
                for c in &buffers.crossings {
                    if c.pane == pane {
                        share = reach * c.reflects;
                        break;
                    }
                    reach *= c.passes;
                }
                let panes = world.panes.as_ref()?;
                let (p, n) = panes.point(pane, from, w);
                (share, self.of_pane[pane as usize], p, n)
            }
        };
        let to = p - e.p;
        let turn = n.dot(w).abs() / to.dot(to);
        // Densities per area: of aiming there, and of arriving there by the spot's own scattering.
        let aims = aimed as f32 * self.targets.density(spot, target as usize);
        let comes =
            plain as f32 / spots as f32 * e.surface.pdf(e.n, e.back, w) * turn * (share / total);
        let flux = intensity * turn * share / (aims + comes);
        if !(flux > 0.0 && flux.is_finite()) {
            return None;
        }
        let medium = world.medium(stack, from, e.back);
        let mut ray = Ray::new(e.p, from, w, (medium, false));
        match (pane, hit, body) {
            (Some(pane), ..) => ray.reflect_at(world, pane),
            (None, Some(hit), Some(body)) => ray.turn_at(world, &hit, body, &self.tuning, rng),
            _ => return None,
        }
        let path = PathState {
            weight: flux,
            length_m: e.path_m,
            bounces: 1,
        };
        let imaged = pane.is_some_and(|pane| self.images.has(pane));
        Some((spot, imaged, path, ray))
    }
}
