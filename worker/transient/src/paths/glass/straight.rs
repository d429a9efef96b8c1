//! Straight legs from a camera path via glass to the spots.

use crate::{
    film::{
        class::{Place, Way},
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
            contribution::{Found, add},
            point::Point,
        },
        tracer::{ALL, Walk},
        vertex::{Sight, Vertex},
    },
};

/// Largest number of spots that a vertex after the first is connected to, and of light vertices
/// that any vertex is connected to.
const SPOTS: u32 = 6;

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
pub(crate) fn straight(
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
    walk.run(
        rng,
        (vertex, crate::paths::tracer::SPOTS),
        scratch,
        &mut sink,
    );
}
