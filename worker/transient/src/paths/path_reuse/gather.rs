//! Gather points: the first surface points along camera paths that are not near-mirrors.

use picofarm_scene::Vec3;

use crate::{
    film::sink::PixelSink,
    numeric::rng::Rng,
    paths::{
        scratch::Scratch,
        tracer::{ALL, Lights, Walk},
        vertex::{Sight, Vertex},
    },
};

/// Like `BEYOND`, for a near-mirror that the camera sees. One in `SHOWING` of a pixel's camera
/// paths is connected.
const SHOWN: u32 = 2;

/// The maximum number of light vertices in zones that a near-mirror is connected to.
const BESIDE: u32 = 2;

/// The fraction of the light of near-mirrors that one of a pixel's camera paths accounts for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Share {
    /// The fraction of light from the spots and their zones.
    pub spots: f32,
    /// The fraction of light from points beyond other near-mirrors; 0 if it is not sampled.
    pub beyond: f32,
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
pub(crate) fn gather_point(
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
pub(crate) fn only_mirrors(
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
