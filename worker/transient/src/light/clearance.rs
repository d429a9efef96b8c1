//! Moves spots off edges.
//!
//! If a beam hits an edge exactly, rounding decides on which side of the other wall the spot is.
//! Such a spot is moved along its own surface ([`clear`]) until it is [`CLEARANCE`] away from the
//! other one.

use picofarm_scene::Vec3;

use crate::{
    numeric::frame::frame,
    scene::{bvh::tree::Stack, intersection::lift, world::World},
};

/// Least distance of a spot from other surfaces, render units: the lift off a surface at the far
/// end of a scene, which is 4 to 8 units wide (about 0.03 mm in a room).
const CLEARANCE: f32 = 1.0 / 32768.0;

/// Length of a beam that must be free before a spot, in units of the distance by which the spot is
/// moved.
const BEAM: f32 = 64.0;

/// Number of times that the distance is doubled to get clear.
const DOUBLINGS: u32 = 8;

/// Number of probe directions along the surface, and above it.
pub(crate) const ROUND: u32 = 24;
pub(crate) const ABOVE: u32 = 128;

/// Returns unit directions around and above a surface with normal `n`.
fn looks(n: Vec3) -> impl Iterator<Item = Vec3> {
    let (t, b) = frame(n);
    let round = (0..ROUND).map(move |k| {
        let angle = std::f32::consts::TAU * k as f32 / ROUND as f32;
        t * libm::cosf(angle) + b * libm::sinf(angle)
    });
    // Golden-angle spiral, cosine-distributed.
    let above = (0..ABOVE).map(move |k| {
        let r2 = (k as f32 + 0.5) / ABOVE as f32;
        let (angle, r) = (2.399_963_2 * k as f32, r2.sqrt());
        t * (r * libm::cosf(angle)) + b * (r * libm::sinf(angle)) + n * (1.0 - r2).sqrt()
    });
    round.chain(above)
}

/// Returns the distances from a surface point to the hits in directions around it and above it, up
/// to `reach`.
pub(crate) fn distances(
    world: &World,
    stack: &mut Stack,
    (p, n): (Vec3, Vec3),
    reach: f32,
) -> Vec<Option<f32>> {
    let from = lift(p, n);
    let closest = |w| world.bvh.closest(stack, from, w, reach).map(|(t, _)| t);
    looks(n).map(closest).collect()
}

/// Returns the place of a spot, moved along its surface if the spot is on an edge: if another
/// surface comes within [`CLEARANCE`], or cuts the spot off by rounding. The new place is still lit
/// from `back`. A spot that is already clear keeps its exact place, and so does a spot for which no
/// clear place exists.
pub(crate) fn clear(world: &World, stack: &mut Stack, p: Vec3, n: Vec3, back: Vec3) -> Vec3 {
    // The test starts on the other side of the spot, so that it hits a wall through the spot
    // itself.
    let crossed = |stack: &mut Stack, w: Vec3| {
        let (a, b) = (
            lift(p - w * (0.5 * CLEARANCE), n),
            lift(p + w * CLEARANCE, n),
        );
        world.bvh.occluded(stack, a, b - a, 1.0)
    };
    let round: Vec<Vec3> = looks(n).take(ROUND as usize).collect();
    // Under a wall that leans over the spot, the start of the rays may be behind the wall.
    let lit = |stack: &mut Stack, q: Vec3, far: f32| {
        let start = lift(q, n);
        !world.bvh.occluded(stack, start, back * far, 1.0)
    };
    if lit(stack, p, BEAM * CLEARANCE) && !round.iter().any(|&w| crossed(stack, w)) {
        return p;
    }
    for k in 0..=DOUBLINGS {
        let step = CLEARANCE * (1u32 << k) as f32;
        let mut best: Option<(f32, Vec3)> = None;
        for &w in &round {
            let q = p + w * step;
            let from = lift(q, n);
            let beneath = world
                .bvh
                .closest(stack, from, -n, 2.0 * (from - q).length());
            if beneath.is_none() || !lit(stack, q, BEAM * step) {
                continue;
            }
            let nearest = distances(world, stack, (q, n), 2.0 * step);
            let room = nearest.iter().flatten().fold(2.0 * step, |a, &t| a.min(t));
            if room > 0.5 * CLEARANCE && best.is_none_or(|(most, _)| room > most) {
                best = Some((room, q));
            }
        }
        if let Some((_, q)) = best {
            return q;
        }
    }
    p
}
