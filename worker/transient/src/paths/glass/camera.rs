//! Camera paths via glass.

use picofarm_scene::Vec3;

use crate::{
    film::{slots::Film, splat::Splat, technique::Technique},
    numeric::{rng::Rng, systematic::draw},
    paths::{
        glass::{
            arrive::arrive,
            buffers::Buffers,
            contribution::{Found, add},
            lit_points::Lit,
            photons::Photons,
            point::{Carried, Point},
            ray::Ray,
            straight::straight,
            technique::ByGlass,
        },
        tracer::Walk,
    },
};

/// Least probability of choosing a pane's reflection before the first turn.
const SEEK: f32 = 0.5;

/// Largest number of images that the first point, and any other point, is connected to.
const IMAGES: (u32, u32) = (4, 1);

/// The same for points lit by spots.
const LIT: (u32, u32) = (2, 1);
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
