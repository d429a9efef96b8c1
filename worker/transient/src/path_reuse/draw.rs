//! Drawing: gather points, and the vertices that they share.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use super::{BEYOND, Effort, GLOSSY, Shared, Sharing};
use crate::{
    bsdf::{Surface, frame},
    ellipsoid::Patches,
    film::Film,
    rng::Rng,
    sink::PixelSink,
    vertex::Vertex,
    walk::{ALL, Lights, Scratch, Walk},
    world::lift,
};

impl Sharing {
    /// Draws light vertices beyond near-mirrors for this pass and connects the gather points to them.
    pub(super) fn beyond_mirrors(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let Some(caustics) = walk.caustics else {
            return;
        };
        let size = film.pixel();
        let count = (effort.beyond * (pixels.len() / size) as f32).max(8.0) as u32;
        let Scratch {
            caustics: vertices,
            stack,
            ..
        } = scratch;
        caustics.fill(vertices, &walk.surroundings(), count, rng, stack);
        for (v, k) in &self.gathers {
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: 1.0,
            };
            walk.light(rng, v, Lights::Beyond, BEYOND, scratch, &mut sink);
        }
    }

    /// Draws shared vertices by the scattering of gather points in turn. A vertex that cannot be shared is
    /// walked on for its own pixel.
    pub(super) fn draw_from_camera(
        &mut self,
        (walk, film): (&Walk, &Film),
        count: u32,
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        let points = self.gathers.len();
        let turns = Turns::new(count, rng);
        for j in 0..count {
            let at = turns.choice(j, points);
            let (vertex, k) = self.gathers[at];
            if !walk.goes_on(&vertex) {
                continue;
            }
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: points as f32 / count as f32,
            };
            let aims = walk.aim(rng, &vertex, 1.0, scratch, &mut sink);
            walk.light(rng, &vertex, Lights::Glossy, GLOSSY, scratch, &mut sink);
            let h = &vertex.hit;
            let Some(drawn) = turns.direction(j, &h.surface, h.n, vertex.wo, rng) else {
                continue;
            };
            let Some((step, mut next)) = walk.follow(&vertex, drawn, aims, &mut scratch.stack)
            else {
                continue;
            };
            next.hit.choose_lobe(rng);
            if next.hit.surface.is_black() {
                continue;
            }
            if next.hit.surface.diffuse() {
                self.shared.push(Shared {
                    hit: next.hit,
                    light: 0.0,
                    first: 0,
                    end: 0,
                });
            } else {
                walk.connect(rng, &next, Some(&step), ALL, scratch, &mut sink);
                walk.run(rng, next, scratch, &mut sink);
            }
        }
    }

    /// Draws shared vertices by the scattering of the spots in turn.
    pub(super) fn draw_from_spots(
        &mut self,
        walk: &Walk,
        count: u32,
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let spots = &walk.emitters.list;
        let turns = Turns::new(count, rng);
        for j in 0..count {
            let e = &spots[turns.choice(j, spots.len())];
            let Some((w, weight, _)) = turns.direction(j, &e.surface, e.n, e.back, rng) else {
                continue;
            };
            let hit = walk
                .world
                .closest(&mut scratch.stack, lift(e.p, e.n), w)
                .filter(|_| weight > 0.0);
            let Some(mut hit) = hit else { continue };
            hit.choose_lobe(rng);
            if !hit.surface.is_black() && hit.surface.diffuse() {
                self.shared.push(Shared {
                    hit,
                    light: 0.0,
                    first: 0,
                    end: 0,
                });
            }
        }
    }

    /// Draws shared vertices in the shells of a narrow gate.
    pub(super) fn draw_in_shells(
        &mut self,
        (walk, patches): (&Walk, &Patches),
        count: u32,
        rng: &mut Rng,
    ) {
        let place = (walk.world, patches);
        self.shells
            .lay((walk.world, patches, walk.gate), &self.gathers, count);
        let start = f64::from(rng.uniform());
        for j in 0..count {
            let at = (f64::from(j) + start) / f64::from(count);
            let Some(mut hit) = self.shells.draw(place, at, rng) else {
                continue;
            };
            hit.choose_lobe(rng);
            if hit.surface.diffuse() {
                self.shared.push(Shared {
                    hit,
                    light: 0.0,
                    first: 0,
                    end: 0,
                });
            }
        }
    }
}

/// Evenly spread draws: choices in strict turn, directions by the R₂ sequence (Roberts 2018), both from
/// a random start. What neighbours have in common then varies less from pass to pass.
struct Turns {
    count: f32,
    start: f32,
    u: f32,
    v: f32,
}

impl Turns {
    fn new(count: u32, rng: &mut Rng) -> Self {
        Self {
            count: count as f32,
            start: rng.uniform(),
            u: rng.uniform(),
            v: rng.uniform(),
        }
    }

    /// Which of `among` draw `j` is for.
    fn choice(&self, j: u32, among: usize) -> usize {
        let at = j as f32 / self.count + self.start;
        (((at - at.floor()) * among as f32) as usize).min(among - 1)
    }

    /// The direction of draw `j`, as [`Surface::sample`] gives it.
    fn direction(
        &self,
        j: u32,
        surface: &Surface,
        n: Vec3,
        wo: Vec3,
        rng: &mut Rng,
    ) -> Option<(Vec3, f32, f32)> {
        if !surface.diffuse() {
            return surface.sample(n, wo, rng);
        }
        let turn = |start: f32, step: f64| {
            let at = f64::from(start) + f64::from(j) * step;
            (at - at.floor()) as f32
        };
        let (u, v) = (
            turn(self.u, 0.754_877_666_246_69),
            turn(self.v, 0.569_840_290_998_05),
        );
        // Cosine-distributed: uniform on the disc beneath (Malley's method).
        let angle = std::f32::consts::TAU * v;
        let (r, z) = (u.sqrt(), (1.0 - u).max(0.0).sqrt());
        let (t, b) = frame(n);
        let w = t * (r * libm::cosf(angle)) + b * (r * libm::sinf(angle)) + n * z;
        let w = w.normalized();
        let c = n.dot(w);
        (c > 0.0).then_some((w, surface.lambertian() * PI, c / PI))
    }
}

/// Follows a camera ray through near-mirrors to the first other surface. What the spots send to vertices
/// past the first goes to `sink`; to near-mirrors this path finds `share` of it.
pub(super) fn gather_point(
    walk: &Walk,
    rng: &mut Rng,
    at: (f32, f32),
    share: f32,
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) -> Option<Vertex> {
    let mut vertex = first(walk, at, scratch)?;
    loop {
        vertex.hit.choose_lobe(rng);
        if vertex.bounce > 1 {
            sink.factor = if vertex.hit.surface.specular {
                share
            } else {
                1.0
            };
            walk.connect(rng, &vertex, None, ALL, scratch, sink);
        }
        if !walk.goes_on(&vertex) {
            return None;
        }
        if !vertex.hit.surface.specular {
            return Some(vertex);
        }
        let roulette = vertex.bounce > 1;
        (_, vertex) = walk.step(rng, &vertex, 0.0, roulette, &mut scratch.stack)?;
    }
}

/// Follows a camera ray as [`gather_point`] does, for what the spots send to near-mirrors past the first vertex: `share` of
/// that goes to `sink`.
pub(super) fn only_mirrors(
    walk: &Walk,
    rng: &mut Rng,
    at: (f32, f32),
    share: f32,
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) {
    let Some(mut vertex) = first(walk, at, scratch) else {
        return;
    };
    sink.factor = share;
    loop {
        vertex.hit.choose_lobe(rng);
        if !vertex.hit.surface.specular {
            return;
        }
        if vertex.bounce > 1 {
            walk.connect(rng, &vertex, None, ALL, scratch, sink);
        }
        if !walk.goes_on(&vertex) {
            return;
        }
        let roulette = vertex.bounce > 1;
        let Some((_, next)) = walk.step(rng, &vertex, 0.0, roulette, &mut scratch.stack) else {
            return;
        };
        vertex = next;
    }
}

/// What a camera ray meets.
fn first(walk: &Walk, (x, y): (f32, f32), scratch: &mut Scratch) -> Option<Vertex> {
    let world = walk.world;
    let hit = world.closest(&mut scratch.stack, Vec3::ZERO, world.camera.ray(x, y))?;
    let range = hit.p.length();
    Some(Vertex {
        hit,
        wo: -hit.p / range,
        beta: 1.0,
        length_m: world.metres(range),
        bounce: 1,
        after_mirror: false,
        open_before: false,
    })
}
