//! Three bounces and more: camera paths whose vertices connect to the spots, with two helpers where the
//! scene needs them, both weighed against plain paths by multiple importance sampling (balance
//! heuristic, Veach and Guibas 1995):
//! - *image lobes*: spot → planar mirror → surface, aimed at the spots' mirror images;
//! - *light vertices*: spots that lie on a mirror send their narrow lobe to a surface, which is connected.

use picofarm_scene::Vec3;

use crate::{
    api::Gate,
    emitter::Emitters,
    lobe::{Mirrors, pick},
    rng::Rng,
    two::Scratch,
    world::{Hit, World, lift},
};

/// What camera paths are traced in.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Walk<'a> {
    pub world: &'a World,
    pub emitters: &'a Emitters,
    pub mirrors: &'a Mirrors,
    pub gate: &'a Gate,
    /// Longest path in bounces.
    pub max_bounces: u32,
    /// Shortest path from the laser to a spot, metres.
    pub shortest_m: f64,
}

/// A vertex of a camera path.
#[derive(Debug, Clone, Copy)]
struct Vertex {
    hit: Hit,
    /// Unit direction back along the path.
    wo: Vec3,
    /// Product of scattering and sampling weights up to here.
    beta: f32,
    /// Optical path from the camera, metres.
    length_m: f64,
}

/// How a vertex was reached, for MIS.
#[derive(Debug, Clone, Copy)]
struct Step {
    p: Vec3,
    n: Vec3,
    /// Density per steradian of the direction taken.
    pdf: f32,
    /// Sum of the image weights at `p` (0 = none aimed).
    aimed: f32,
}

impl Walk<'_> {
    /// Traces one path through film position (x, y); contributions go to `scratch.first`.
    pub fn path(&self, rng: &mut Rng, x: f32, y: f32, scratch: &mut Scratch, images: &mut [f32]) {
        let world = self.world;
        let d = world.camera.ray(x, y);
        let Some(hit) = world.closest(&mut scratch.stack, Vec3::ZERO, d) else {
            return;
        };
        let range = hit.p.length();
        let mut vertex = Vertex {
            hit,
            wo: -hit.p / range,
            beta: 1.0,
            length_m: world.metres(range),
        };
        let mut step: Option<Step> = None;
        let mut k = 1;
        loop {
            if vertex.hit.surface.strength == 0.0 {
                return;
            }
            if k >= 2 {
                self.connect(rng, &vertex, step.as_ref(), scratch);
            }
            if k + 2 > self.max_bounces || vertex.length_m + self.shortest_m >= self.gate.end_m() {
                return;
            }
            let helped = !vertex.hit.surface.specular;
            let mut aimed = 0.0;
            if helped && !self.mirrors.list.is_empty() {
                aimed = self.aim(rng, &vertex, scratch, images);
            }
            if helped && !self.emitters.on_mirror.is_empty() {
                self.light_vertex(rng, &vertex, scratch);
            }
            let h = vertex.hit;
            let Some((w, weight, pdf)) = h.surface.sample(h.n, vertex.wo, rng) else {
                return;
            };
            let mut beta = vertex.beta * weight;
            if k >= 2 {
                // Russian roulette.
                let survive = beta.min(0.95);
                if rng.uniform() >= survive {
                    return;
                }
                beta /= survive;
            }
            let Some(hit) = world.closest(&mut scratch.stack, lift(h.p, h.n), w) else {
                return;
            };
            step = helped.then_some(Step {
                p: h.p,
                n: h.n,
                pdf,
                aimed,
            });
            vertex = Vertex {
                hit,
                wo: -w,
                beta,
                length_m: vertex.length_m + world.metres((hit.p - h.p).length()),
            };
            k += 1;
        }
    }

    /// Connects a vertex to one spot, chosen by unshadowed contribution.
    fn connect(&self, rng: &mut Rng, v: &Vertex, step: Option<&Step>, scratch: &mut Scratch) {
        let h = &v.hit;
        let weights = &mut scratch.weights;
        self.emitters.weights(h.p, h.n, v.wo, &h.surface, weights);
        let total: f32 = weights.iter().sum();
        let u = rng.uniform();
        if !(total > 0.0) {
            return;
        }
        let Some((spot, _)) = pick(weights, total * u) else {
            return;
        };
        let e = &self.emitters.list[spot];
        if !self.world.free(&mut scratch.stack, h.p, h.n, e.p, e.n) {
            return;
        }
        let share = step.map_or(1.0, |s| self.plain_share(s, h, spot));
        let path = v.length_m + self.world.metres((e.p - h.p).length()) + e.path_m;
        scratch.first.add(self.gate, path, v.beta * total * share);
    }

    /// MIS weight of reaching `h` by BSDF sampling from `step` and connecting it to `spot`.
    fn plain_share(&self, step: &Step, h: &Hit, spot: usize) -> f32 {
        let e = &self.emitters.list[spot];
        if let Some(mirror) = self.mirrors.of(h.triangle) {
            if step.aimed > 0.0 {
                let w = self.mirrors.weight(mirror, spot, step.p, step.n);
                if w > 0.0 {
                    let aimed = w / step.aimed * self.mirrors.pdf(mirror, spot, step.p, h.p);
                    return step.pdf / (step.pdf + aimed);
                }
            }
        } else if e.surface.specular && !h.surface.specular {
            let to = h.p - e.p;
            let d2 = to.dot(to);
            let w = to / d2.sqrt();
            let chance = 1.0 / self.emitters.on_mirror.len() as f32;
            let light = chance * e.surface.pdf(e.n, e.back, w) * h.n.dot(w).abs() / d2;
            let back = step.p - h.p;
            let b2 = back.dot(back);
            let plain = step.pdf * h.n.dot(back).abs() / (b2 * b2.sqrt());
            return plain / (plain + light);
        }
        1.0
    }

    /// Looks for a spot's image in a planar mirror. Returns the sum of weights for later MIS.
    fn aim(&self, rng: &mut Rng, v: &Vertex, scratch: &mut Scratch, images: &mut [f32]) -> f32 {
        let h = &v.hit;
        let (total, aim) = self.mirrors.aim(h.p, h.n, rng, images);
        let Some(aim) = aim else { return total };
        let to = aim.target - h.p;
        if h.n.dot(to) <= 0.0 {
            return total;
        }
        let from = lift(h.p, h.n);
        let Some(m) = self.world.closest(&mut scratch.stack, from, to) else {
            return total;
        };
        if self.mirrors.of(m.triangle) != Some(aim.mirror) || m.surface.strength == 0.0 {
            return total;
        }
        let leg = m.p - h.p;
        let w = leg.normalized();
        let e = &self.emitters.list[aim.spot];
        let there = self.emitters.weight(aim.spot, m.p, m.n, -w, &m.surface);
        let value = h.surface.scatter(h.n, v.wo, w) * there;
        if value == 0.0 || !self.world.free(&mut scratch.stack, m.p, m.n, e.p, e.n) {
            return total;
        }
        let aimed = aim.chance * self.mirrors.pdf(aim.mirror, aim.spot, h.p, m.p);
        let plain = h.surface.pdf(h.n, v.wo, w);
        let lengths = self.world.metres(leg.length()) + self.world.metres((e.p - m.p).length());
        let path = v.length_m + lengths + e.path_m;
        scratch
            .first
            .add(self.gate, path, v.beta * value / (aimed + plain));
        total
    }

    /// Connects to a surface that a mirror spot's lobe lights.
    fn light_vertex(&self, rng: &mut Rng, v: &Vertex, scratch: &mut Scratch) {
        let h = &v.hit;
        let spots = &self.emitters.on_mirror;
        let choice = (rng.uniform() * spots.len() as f32) as usize;
        let e = &self.emitters.list[spots[choice.min(spots.len() - 1)]];
        let Some((w, weight, pdf)) = e.surface.sample(e.n, e.back, rng) else {
            return;
        };
        let Some(y) = self.world.closest(&mut scratch.stack, lift(e.p, e.n), w) else {
            return;
        };
        if y.surface.specular || y.surface.strength == 0.0 {
            return;
        }
        let to = y.p - h.p;
        let d2 = to.dot(to);
        let d = d2.sqrt();
        let dir = to / d;
        let cos = -y.n.dot(dir);
        if !(cos > 0.0 && h.n.dot(dir) > 0.0) {
            return;
        }
        let value = h.surface.scatter(h.n, v.wo, dir) * y.surface.scatter(y.n, -w, -dir) / d2;
        if value == 0.0 || !self.world.free(&mut scratch.stack, h.p, h.n, y.p, y.n) {
            return;
        }
        let leg = y.p - e.p;
        let chance = 1.0 / spots.len() as f32;
        let light = chance * pdf * y.n.dot(w).abs() / leg.dot(leg);
        let plain = h.surface.pdf(h.n, v.wo, dir) * cos / d2;
        let share = light / (light + plain);
        let lengths = self.world.metres(d) + self.world.metres(leg.length());
        let path = v.length_m + lengths + e.path_m;
        let value = v.beta * value * weight / chance * share;
        scratch.first.add(self.gate, path, value);
    }
}
