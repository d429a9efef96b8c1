//! Camera paths via glass.

use picofarm_scene::Vec3;

use super::{
    Buffers, ByGlass,
    lit::Lit,
    photons::Photons,
    ray::{Carried, Point, Ray, arrive},
};
use crate::{
    caustic::Splat,
    emitter::Emitters,
    film::Film,
    rng::Rng,
    sink::{Place, Sink, Technique, Way},
    vertex::{Sight, Vertex},
    walk::{ALL, Walk, draw},
};

/// Least probability of choosing a pane's reflection before the first turn.
const SEEK: f32 = 0.5;
/// Largest number of images that the first point, and any other point, is connected to.
const IMAGES: (u32, u32) = (4, 1);
/// The same for points lit by spots.
const LIT: (u32, u32) = (2, 1);
/// Largest number of spots that a vertex after the first is connected to, and of light vertices
/// that any vertex is connected to.
const SPOTS: u32 = 6;
const LIGHTS: u32 = 1;

impl ByGlass {
    /// Traces a camera path through a point of the film. Adds the light from connections to the
    /// spots, their images and the current light vertices, and from the photons.
    pub fn look(
        &self,
        (walk, film, photons): (&Walk, &Film, &Photons),
        (pixel, ray): (u32, Vec3),
        rng: &mut Rng,
        buffers: &mut Buffers,
        out: &mut Vec<Splat>,
    ) {
        let (world, origin) = (walk.world, Vec3::ZERO);
        let chance = self.chance(pixel);
        if chance < 1.0 && rng.uniform() >= chance {
            return;
        }
        let mut left = 1.0;
        let mut ray = Ray::new(origin, origin, ray.normalized(), (self.around, true));
        let mut path = Carried {
            weight: 1.0 / chance,
            length_m: 0.0,
            bounces: 0,
        };
        // Whether any leg was turned, and whether all legs were.
        let (mut turned, mut all) = (false, true);
        loop {
            let seek = if turned { 0.0 } else { SEEK };
            let tools = (&mut buffers.scratch.stack, &mut buffers.crossings);
            let Some(point) = arrive((world, &self.images), &path, (ray, seek), rng, tools) else {
                return;
            };
            let first = path.bounces == 0;
            turned |= point.turns > 0;
            all &= point.turns > 0;
            if point.hit.surface.is_black() {
                return;
            }
            if first && turned {
                // The spots themselves are points of light if possible.
                let spots = !(point.shows && self.points_of_light());
                let limits = (walk.max_bounces, world, spots);
                photons.around(limits, &point, |found| add(film, (pixel, found), out));
            }
            let there = &point.path;
            if there.bounces + 1 > walk.max_bounces
                || there.length_m + walk.shortest_m >= walk.gate.end_m()
            {
                return;
            }
            // From here, straight legs alone lead to a spot. If a pane's reflection led here from
            // another point, the image of this point covers these paths.
            let by_image = !first && point.imaged && Lit::may_hold(walk, &point.hit);
            if point.turns > 0 && !by_image {
                straight((walk, film), (&point, pixel), first, rng, buffers, out);
            }
            if self.images.any() && there.bounces + 2 <= walk.max_bounces {
                let count = if first { IMAGES.0 } else { IMAGES.1 };
                self.images
                    .connect(walk, &point, count, rng, buffers, |found| {
                        add(film, (pixel, found), out);
                    });
                let lit = std::mem::take(&mut buffers.lit);
                let count = if first { LIT.0 } else { LIT.1 };
                let of = (walk, &lit);
                self.images
                    .connect_lit(of, &point, count, rng, buffers, |found| {
                        add(film, (pixel, found), out);
                    });
                buffers.lit = lit;
            }
            if all {
                join((walk, film), (&point, pixel), rng, buffers, out);
            }
            let on_leg = there.weight / path.weight;
            let Some(next) = point.seek(&self.aim, left * on_leg, rng) else {
                return;
            };
            (path, ray, left) = next;
        }
    }
}

/// A contribution of a camera path.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    /// Radiance.
    pub value: f32,
    /// Optical path, metres.
    pub path_m: f64,
    /// Emitter index.
    pub spot: usize,
    pub bounces: u32,
    pub technique: Technique,
}

/// The sink for a walk's splats. Straight legs stay in one medium, so the index of that medium
/// scales the length of the walk's legs.
struct Splats<'a> {
    film: &'a Film,
    emitters: &'a Emitters,
    pixel: u32,
    /// Optical path before the walk, metres, and the index of refraction around it.
    before_m: f64,
    medium: f64,
    out: &'a mut Vec<Splat>,
}

impl Sink for Splats<'_> {
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32, _: Way) {
        let to_spot = self.emitters.list[spot].path_m;
        let found = Found {
            value,
            path_m: self.before_m + (path_m - to_spot) * self.medium + to_spot,
            spot,
            bounces,
            technique: Technique::Straight,
        };
        add(self.film, (self.pixel, found), self.out);
    }

    fn at(&mut self, _: Place) {}
}

/// Connects a point of a camera path to the spots and continues the walk from it, with straight
/// legs alone.
fn straight(
    (walk, film): (&Walk, &Film),
    (point, pixel): (&Point, u32),
    first: bool,
    rng: &mut Rng,
    buffers: &mut Buffers,
    out: &mut Vec<Splat>,
) {
    let mut sink = Splats {
        film,
        emitters: walk.emitters,
        pixel,
        before_m: point.path.length_m,
        medium: f64::from(point.medium),
        out,
    };
    let mut hit = point.hit;
    hit.choose_lobe(rng);
    let vertex = Vertex {
        hit,
        wo: point.back,
        beta: point.path.weight,
        length_m: 0.0,
        bounce: point.path.bounces,
        sight: Sight::ELSEWHERE,
    };
    // Zones leave light near a spot to light paths, which do not cover paths via glass.
    let near = walk.contacts.is_some_and(|c| c.near(walk.world, &hit));
    let walk = Walk {
        contacts: walk.contacts.filter(|_| !near),
        // The window applies to whole paths.
        window: None,
        ..*walk
    };
    let count = if first { ALL } else { SPOTS };
    let scratch = &mut buffers.scratch;
    walk.connect(rng, &vertex, None, count, scratch, &mut sink);
    walk.run(rng, (vertex, crate::walk::SPOTS), scratch, &mut sink);
}

/// Connects a point of a camera path to light vertices.
fn join(
    (walk, film): (&Walk, &Film),
    (point, pixel): (&Point, u32),
    rng: &mut Rng,
    buffers: &mut Buffers,
    out: &mut Vec<Splat>,
) {
    let (world, h, path) = (walk.world, &point.hit, &point.path);
    let Buffers {
        scratch,
        lights,
        vertices,
        ..
    } = buffers;
    if vertices.list.is_empty() {
        return;
    }
    vertices.weights(h, point.back, (lights, &mut scratch.plain));
    draw(lights, LIGHTS, rng.uniform(), |i, value| {
        let y = &vertices.list[i];
        let bounces = path.bounces + y.bounces;
        if bounces > walk.max_bounces {
            return;
        }
        let free = world.free(&mut scratch.stack, h.p, h.n, y.hit.p, y.hit.n);
        if free > 0.0 {
            let to = y.hit.p - h.p;
            let leg = world.metres(to.length()) * f64::from(point.medium);
            let found = Found {
                value: path.weight * value * free,
                path_m: path.length_m + leg + y.path_m,
                spot: y.spot,
                bounces,
                technique: Technique::Vertex,
            };
            add(film, (pixel, found), out);
        }
    });
}

/// Adds what was found.
fn add(film: &Film, (pixel, found): (u32, Found), out: &mut Vec<Splat>) {
    out.push(Splat {
        pixel,
        slot: film.slot(found.path_m) as u32,
        spot: found.spot as u16,
        value: found.value,
        bounces: found.bounces,
        technique: found.technique,
    });
}
