//! Drawing gather points and the vertices that they share.

use picofarm_scene::Vec3;

use super::{ALL_ZONES, BESIDE, BEYOND, Effort, GLOSSY, SHOWN, Shared, Sharing, ZONE_PATHS};
use crate::{
    contact::Contacts,
    ellipsoid::Patches,
    film::Film,
    rng::Rng,
    sink::{PixelSink, Place, Sink, Way},
    turns::Turns,
    vertex::{Sight, Vertex},
    walk::{ALL, Lights, Scratch, Step, Walk},
    world::lift,
};

impl Sharing {
    /// Draws the light vertices of this pass: those beyond near-mirrors by `count` paths, and those
    /// in the zones of spots close to other surfaces.
    pub(crate) fn draw_lights(walk: &Walk, count: u32, rng: &mut Rng, scratch: &mut Scratch) {
        let Scratch {
            caustics: beyond,
            contacts: near,
            stack,
            ..
        } = scratch;
        beyond.clear();
        near.clear();
        let within = walk.surroundings();
        if let Some(caustics) = walk.caustics {
            caustics.fill(beyond, &within, count, rng, stack);
        }
        if let Some(contacts) = walk.contacts {
            let (least, most) = ZONE_PATHS;
            let count = (ALL_ZONES / contacts.count()).clamp(least, most);
            contacts.fill((near, beyond), &within, count, rng, stack);
        }
    }

    /// Connects the gather points to the light vertices of [`draw_lights`].
    pub(super) fn connect_lights(
        &mut self,
        (walk, film): (&Walk, &Film),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        if !scratch.caustics.list.is_empty() {
            for (v, k) in &self.gathers {
                let mut sink = PixelSink {
                    film,
                    pixel: &mut pixels[k * size..(k + 1) * size],
                    factor: 1.0,
                    place: Place::Gather,
                };
                walk.light(rng, v, Lights::Beyond, BEYOND, scratch, &mut sink);
            }
        }
        if let Some(contacts) = walk.contacts {
            self.connect_near((walk, film, contacts), scratch, pixels);
        }
    }

    /// Connects every gather point that is not near a zone to every light vertex in a zone, with
    /// one narrow bundle of rays each.
    fn connect_near(
        &mut self,
        (walk, film, contacts): (&Walk, &Film, &Contacts),
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        let Scratch {
            contacts: near,
            stack,
            ..
        } = scratch;
        let far = |v: &Vertex| !contacts.near(walk.world, &v.hit);
        let far: Vec<bool> = self.gathers.iter().map(|(v, _)| far(v)).collect();
        self.weight.clear();
        self.weight.resize(self.gathers.len(), 0.0);
        for y in &near.list {
            self.segments.clear();
            for (i, (v, _)) in self.gathers.iter().enumerate().filter(|&(i, _)| far[i]) {
                let bounces = v.bounce + y.bounces;
                let to = y.hit.p - v.hit.p;
                let d2 = to.dot(to);
                let w = to / d2.sqrt();
                let value = v.hit.surface.scatter(v.hit.n, v.wo, w)
                    * y.hit.surface.scatter(y.hit.n, y.back, -w);
                if value > 0.0 && bounces <= walk.max_bounces {
                    self.weight[i] = v.beta * y.flux * value / d2;
                    self.segments.push(i, lift(v.hit.p, v.hit.n));
                }
            }
            let from = lift(y.hit.p, y.hit.n);
            self.segments.trace(walk.world, stack, from);
            for (i, through) in self.segments.found() {
                let Some(through) = through else { continue };
                let (v, k) = &self.gathers[i];
                let leg = walk.world.metres((y.hit.p - v.hit.p).length());
                let path = v.length_m + leg + y.path_m;
                if walk.window.is_none_or(|w| w.holds(path)) {
                    let pixel = &mut pixels[k * size..(k + 1) * size];
                    let spot = film.tag(y.spot, Place::Gather, Way::Zone);
                    film.add(pixel, film.slot(path), self.weight[i] * through, spot);
                }
            }
        }
    }

    /// Draws vertices by the scattering of gather points in turn: `count` vertices, which become
    /// candidates for shared vertices if they can be shared, and `extra` more for surfaces that
    /// cannot.
    ///
    /// Vertices that cannot be shared are walked on for their own pixel. They have most of the
    /// variance and cost little compared to the shared work. They are walked on for one in `times`
    /// of the `count`; the others are only candidates for shared vertices.
    pub(super) fn draw_from_camera(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        (count, times, extra): (u32, u32, u32),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        let points = self.gathers.len();
        let alone = count / times + extra;
        let all = [Turns::new(count, rng), Turns::new(extra.max(1), rng)];
        for j in 0..count + extra {
            let shares = j < count;
            let (turns, j) = match shares {
                true => (&all[0], j),
                false => (&all[1], j - count),
            };
            let at = turns.choice(j, points);
            let whole = !shares || j % times == 0;
            let (vertex, k) = self.gathers[at];
            if !walk.goes_on(&vertex) {
                continue;
            }
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: points as f32 / alone as f32,
                place: Place::Gather,
            };
            let mut aims = 0.0;
            if whole {
                let images = (1.0, Some(&self.aiming));
                aims = walk.aim(rng, &vertex, images, scratch, &mut sink);
                walk.light(rng, &vertex, Lights::Glossy, GLOSSY, scratch, &mut sink);
            }
            let h = &vertex.hit;
            let Some(drawn) = turns.direction(j, &h.surface, h.n, vertex.wo, rng) else {
                continue;
            };
            let Some((mut step, mut next)) = walk.follow(&vertex, drawn, aims, &mut scratch.stack)
            else {
                continue;
            };
            next.hit.choose_lobe(rng);
            if next.hit.surface.is_black() {
                continue;
            }
            if next.hit.surface.is_shared() {
                if shares {
                    self.shared.extend(Shared::new(next.hit));
                }
            } else if whole {
                if next.hit.surface.specular() {
                    let plain = step.pdf;
                    step.pdf += walk.aims(Some(&self.aiming), h.p, &next.hit);
                    sink.factor *= plain / step.pdf;
                }
                go_on_alone((walk, effort), (step, next), rng, scratch, &mut sink);
            }
        }
    }

    /// Aims at near-mirrors from gather points in turn, `count` times, in addition to `alone`
    /// directions drawn by their scattering. Each vertex found is walked on for its own pixel.
    pub(super) fn draw_from_mirrors(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        (count, alone): (u32, u32),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let Some(all) = walk.reflectors.filter(|_| count > 0) else {
            return;
        };
        let size = film.pixel();
        let points = self.gathers.len();
        let turns = Turns::new(count, rng);
        // Gather points aim at images in the same way.
        let images = if walk.mirrors.list.is_empty() {
            0.0
        } else {
            1.0
        };
        for j in 0..count {
            let (vertex, k) = self.gathers[turns.choice(j, points)];
            if !walk.goes_on(&vertex) {
                continue;
            }
            let h = &vertex.hit;
            let Some((triangle, p)) = self.aiming.draw(all, rng) else {
                continue;
            };
            let w = (p - lift(h.p, h.n)).normalized();
            let (value, plain) = (
                h.surface.scatter(h.n, vertex.wo, w),
                h.surface.pdf(h.n, vertex.wo, w),
            );
            if !(value > 0.0 && plain > 0.0) {
                continue;
            }
            // The vertex as if it had been drawn by scattering. Russian roulette of its walk uses
            // this weight.
            let drawn = (w, value / plain, plain);
            let Some((mut step, mut next)) =
                walk.follow(&vertex, drawn, images, &mut scratch.stack)
            else {
                continue;
            };
            if next.hit.triangle != triangle {
                continue;
            }
            next.hit.choose_lobe(rng);
            if !next.hit.surface.specular() || next.hit.surface.is_black() {
                continue;
            }
            step.pdf += self.aiming.density(all, h.p, &next.hit);
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: points as f32 / alone as f32 * plain / step.pdf,
                place: Place::Gather,
            };
            go_on_alone((walk, effort), (step, next), rng, scratch, &mut sink);
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
            let spot = turns.choice(j, spots.len());
            let e = &spots[spot];
            let Some((w, weight, _)) = turns.direction(j, &e.surface, e.n, e.back, rng) else {
                continue;
            };
            let hit = walk
                .world
                .closest(&mut scratch.stack, lift(e.p, e.n), w)
                .filter(|_| weight > 0.0);
            let Some(mut hit) = hit else { continue };
            // The zones account for its light, and their densities do not include this technique.
            if walk.is_own(spot, &hit) {
                continue;
            }
            hit.choose_lobe(rng);
            self.shared.extend(Shared::new(hit));
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
            self.shared.extend(Shared::new(hit));
        }
    }
}

/// The fraction of the light of near-mirrors that one of a pixel's camera paths accounts for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Share {
    /// The fraction of light from the spots and their zones.
    pub spots: f32,
    /// The fraction of light from points beyond other near-mirrors; 0 if it is not sampled.
    pub beyond: f32,
}

/// Connects a vertex seen by one pixel to the spots, and walks on from it.
fn go_on_alone(
    (walk, effort): (&Walk, &Effort),
    (step, vertex): (Step, Vertex),
    rng: &mut Rng,
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) {
    sink.at(Place::Alone);
    walk.connect(rng, &vertex, Some(&step), ALL, scratch, sink);
    sink.at(Place::AloneWalk);
    walk.run(rng, (vertex, effort.spots.1), scratch, sink);
}

/// Connects a near-mirror to light vertices beyond other near-mirrors.
fn show(
    walk: &Walk,
    rng: &mut Rng,
    vertex: &Vertex,
    share: Share,
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) {
    if share.beyond > 0.0 {
        sink.factor = share.beyond;
        walk.light(rng, vertex, Lights::Beyond, SHOWN, scratch, sink);
        sink.factor = share.spots;
    }
}

/// Follows a camera ray through near-mirrors to the first other surface. Light from the spots at
/// vertices past the first goes to `sink`. Of the light at near-mirrors, this path adds the
/// fraction `share`.
pub(super) fn gather_point(
    walk: &Walk,
    rng: &mut Rng,
    ray: Vec3,
    share: Share,
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) -> Option<Vertex> {
    let mut vertex = first(walk, ray, scratch)?;
    loop {
        vertex.hit.choose_lobe(rng);
        if vertex.bounce > 1 {
            sink.factor = if vertex.hit.surface.specular() {
                share.spots
            } else {
                1.0
            };
            walk.connect(rng, &vertex, None, ALL, scratch, sink);
        }
        if !walk.goes_on(&vertex) {
            return None;
        }
        if !vertex.hit.surface.specular() {
            return Some(vertex);
        }
        sink.factor = share.spots;
        walk.light(rng, &vertex, Lights::Contact, BESIDE, scratch, sink);
        show(walk, rng, &vertex, share, scratch, sink);
        let roulette = vertex.bounce > 1;
        (_, vertex) = walk.step(rng, &vertex, 0.0, roulette, &mut scratch.stack)?;
    }
}

/// Follows a camera ray as [`gather_point`] does, for the light from the spots at near-mirrors past
/// the first vertex. The fraction `share` of it goes to `sink`.
pub(super) fn only_mirrors(
    walk: &Walk,
    rng: &mut Rng,
    ray: Vec3,
    share: Share,
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) {
    let Some(mut vertex) = first(walk, ray, scratch) else {
        return;
    };
    sink.factor = share.spots;
    loop {
        vertex.hit.choose_lobe(rng);
        if !vertex.hit.surface.specular() {
            return;
        }
        if vertex.bounce > 1 {
            walk.connect(rng, &vertex, None, ALL, scratch, sink);
        }
        if !walk.goes_on(&vertex) {
            return;
        }
        walk.light(rng, &vertex, Lights::Contact, BESIDE, scratch, sink);
        show(walk, rng, &vertex, share, scratch, sink);
        let roulette = vertex.bounce > 1;
        let Some((_, next)) = walk.step(rng, &vertex, 0.0, roulette, &mut scratch.stack) else {
            return;
        };
        vertex = next;
    }
}

/// Returns the first vertex along a camera ray.
fn first(walk: &Walk, ray: Vec3, scratch: &mut Scratch) -> Option<Vertex> {
    let world = walk.world;
    let hit = world.closest(&mut scratch.stack, Vec3::ZERO, ray)?;
    let range = hit.p.length();
    Some(Vertex {
        hit,
        wo: -hit.p / range,
        beta: hit.through,
        length_m: world.metres(range),
        bounce: 1,
        sight: Sight::FIRST,
    })
}
