//! Straight legs from a camera path via glass to the spots.

use crate::{
    film::{
        class::{Connection, PathPlace},
        sink::Sink,
        slots::Film,
        splat::Splat,
        technique::Technique,
    },
    light::emitters::Emitters,
    numeric::rng::Rng,
    paths::{
        glass::{
            buffers::Buffers,
            contribution::{Contribution, add},
            point::Point,
        },
        tracer::{ALL, Tracer},
        vertex::{Sight, Vertex},
    },
};

/// The sink for a walk's splats. Straight legs stay in one medium, so the index of that medium
/// scales the length of the walk's legs.
struct Splats<'a> {
    pub film: &'a Film,
    pub emitters: &'a Emitters,
    pub pixel: u32,
    /// Optical path before the walk, metres, and the index of refraction around it.
    pub before_m: f64,
    pub medium: f64,
    pub out: &'a mut Vec<Splat>,
}

impl Sink for Splats<'_> {
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32, _: Connection) {
        let to_spot = self.emitters.list[spot].path_m;
        let found = Contribution {
            value,
            path_m: self.before_m + (path_m - to_spot) * self.medium + to_spot,
            spot,
            bounces,
            technique: Technique::Straight,
        };
        add(self.film, (self.pixel, found), self.out);
    }

    fn set_place(&mut self, _: PathPlace) {}
}

/// Connects a point of a camera path to the spots and continues the walk from it, with straight
/// legs alone.
pub(crate) fn straight(
    (tracer, film): (&Tracer, &Film),
    (point, pixel): (&Point, u32),
    first: bool,
    rng: &mut Rng,
    buffers: &mut Buffers,
    out: &mut Vec<Splat>,
) {
    let mut sink = Splats {
        film,
        emitters: tracer.emitters,
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
    let near = tracer.contacts.is_some_and(|c| c.near(tracer.world, &hit));
    let tracer = Tracer {
        contacts: tracer.contacts.filter(|_| !near),
        // The window applies to whole paths.
        window: None,
        ..*tracer
    };
    let count = if first {
        ALL
    } else {
        tracer.tuning.glass.spots
    };
    let scratch = &mut buffers.scratch;
    tracer.connect(rng, &vertex, None, count, scratch, &mut sink);
    tracer.run(rng, (vertex, tracer.tuning.walk.spots), scratch, &mut sink);
}
