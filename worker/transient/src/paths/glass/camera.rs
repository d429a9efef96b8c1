//! Camera paths via glass.

use picofarm_scene::Vec3;

use crate::{
    film::{slots::Film, splat::Splat, technique::Technique},
    numeric::{rng::Rng, systematic::draw},
    paths::{
        glass::{
            arrive::arrive,
            buffers::Buffers,
            contribution::{Contribution, add},
            lit_points::LitPoints,
            photons::Photons,
            point::{PathState, Point},
            ray::Ray,
            straight::straight,
            technique::GlassTechnique,
        },
        tracer::Tracer,
    },
};

/// A point of the film that a camera path starts at.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CameraView<'a> {
    pub film: &'a Film,
    /// Row-major pixel.
    pub pixel: u32,
    /// Direction of the ray through that point; any length.
    pub ray: Vec3,
}

impl GlassTechnique<'_> {
    /// Traces a camera path through a point of the film. Adds the light from connections to the
    /// spots, their images and the current light vertices, and from the photons.
    pub fn look(
        &self,
        view: &CameraView<'_>,
        photons: &Photons,
        rng: &mut Rng,
        buffers: &mut Buffers,
        out: &mut Vec<Splat>,
    ) {
        let CameraView { film, pixel, ray } = *view;
        let tracer = &self.tracer;
        let (world, origin) = (tracer.world, Vec3::ZERO);
        let chance = self.chance(pixel);
        if chance < 1.0 && rng.uniform() >= chance {
            return;
        }
        let mut left = 1.0;
        let mut ray = Ray::new(origin, origin, ray.normalized(), (self.around, true));
        let mut path = PathState {
            weight: 1.0 / chance,
            length_m: 0.0,
            bounces: 0,
        };
        // Whether any leg was turned, and whether all legs were.
        let (mut turned, mut all) = (false, true);
        loop {
            let seek = if turned { 0.0 } else { self.tuning.seek };
            let tools = (&mut buffers.scratch.stack, &mut buffers.crossings);
            let Some(point) = arrive(
                (world, &self.images),
                &path,
                (ray, seek),
                &self.tuning,
                rng,
                tools,
            ) else {
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
                photons.around(tracer, spots, &point, |found| {
                    add(film, (pixel, found), out)
                });
            }
            let there = &point.path;
            if there.bounces + 1 > tracer.max_bounces
                || there.length_m + tracer.shortest_m >= tracer.gate.end_m()
            {
                return;
            }
            // From here, straight legs alone lead to a spot. If a pane's reflection led here from
            // another point, the image of this point covers these paths.
            let by_image = !first && point.imaged && LitPoints::may_hold(tracer, &point.hit);
            if point.turns > 0 && !by_image {
                straight((tracer, film), (&point, pixel), first, rng, buffers, out);
            }
            if self.images.any() && there.bounces + 2 <= tracer.max_bounces {
                let count = if first {
                    self.tuning.first_images
                } else {
                    self.tuning.images
                };
                self.images
                    .connect(tracer, &point, count, rng, buffers, |found| {
                        add(film, (pixel, found), out);
                    });
                let lit = std::mem::take(&mut buffers.lit);
                let count = if first {
                    self.tuning.first_lit
                } else {
                    self.tuning.lit
                };
                let lit_scene = (tracer, &lit);
                self.images
                    .connect_lit(lit_scene, &point, count, rng, buffers, |found| {
                        add(film, (pixel, found), out);
                    });
                buffers.lit = lit;
            }
            if all {
                join((tracer, film), (&point, pixel), rng, buffers, out);
            }
            let on_leg = there.weight / path.weight;
            let Some(next) = point.seek(&self.aim, &self.tuning, left * on_leg, rng) else {
                return;
            };
            (path, ray, left) = next;
        }
    }
}

/// Connects a point of a camera path to light vertices.
fn join(
    (tracer, film): (&Tracer, &Film),
    (point, pixel): (&Point, u32),
    rng: &mut Rng,
    buffers: &mut Buffers,
    out: &mut Vec<Splat>,
) {
    let (world, h, path) = (tracer.world, &point.hit, &point.path);
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
    draw(
        lights,
        tracer.tuning.glass.light_vertices,
        rng.uniform(),
        |i, value| {
            let y = &vertices.list[i];
            let bounces = path.bounces + y.bounces;
            if bounces > tracer.max_bounces {
                return;
            }
            let free = world.free(&mut scratch.stack, h.p, h.n, y.hit.p, y.hit.n);
            if free > 0.0 {
                let to = y.hit.p - h.p;
                let leg = world.metres(to.length()) * f64::from(point.medium);
                let found = Contribution {
                    value: path.weight * value * free,
                    path_m: path.length_m + leg + y.path_m,
                    spot: y.spot,
                    bounces,
                    technique: Technique::Vertex,
                };
                add(film, (pixel, found), out);
            }
        },
    );
}
