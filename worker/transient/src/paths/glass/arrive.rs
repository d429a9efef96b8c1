//! Follows a leg to the next surface point of a path.

use crate::{
    numeric::rng::Rng,
    paths::glass::{
        images::Images,
        point::{Carried, Point},
        ray::{Ray, follow},
    },
    scene::{bvh::tree::Stack, panes::Crossing, world::World},
};

/// Follows a ray to the next point of a path.
pub(crate) fn arrive(
    (world, images): (&World, &Images),
    path: &Carried,
    (ray, seek): (Ray, f32),
    rng: &mut Rng,
    tools: (&mut Stack, &mut Vec<Crossing>),
) -> Option<Point> {
    let (ray, hit) = follow(world, ray, seek, rng, tools)?;
    let once = ray.last.filter(|_| ray.turns == 1);
    Some(Point {
        hit,
        back: -ray.w,
        path: Carried {
            weight: path.weight * ray.weight,
            length_m: path.length_m + ray.length_m,
            bounces: path.bounces + 1 + ray.reflections,
        },
        medium: ray.medium,
        turns: ray.turns,
        imaged: once.is_some_and(|pane| images.has(pane)),
        shows: once.is_some_and(|pane| images.shows(pane)),
    })
}
