//! Depth where the histogram says too little: from the nearest pixel that knows its surface, along
//! ways of alike intensity.

use std::{
    cmp::{Ordering, Reverse},
    collections::BinaryHeap,
};

use crate::{
    Settings,
    geometry::{Rays, Source, depth_of},
    planes::Slants,
};

/// Cost of a step to a neighbour, in addition to the change of log intensity.
const STEP: f32 = 0.02;
/// Cost of a step to a pixel where the surface is too far away for its first light.
const LATE: f32 = 0.1;
/// Least score of a pixel that a spot answers for.
const SURE: f32 = 1.0;

#[derive(PartialEq)]
struct Cost(f32);

impl Eq for Cost {}

impl PartialOrd for Cost {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Cost {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.total_cmp(&other.0)
    }
}

/// Sets pixels of a spot to the spot's depth, which its one-bounce return states, and gives every
/// pixel with a weak score the plane of the nearest other one that is not too far away for its
/// first light; where there is none, a surface a little before the farthest possible range.
pub fn fill(
    rays: &Rays,
    log: &[f32],
    sources: &[Source],
    bound: &[f32],
    settings: &Settings,
    slants: &mut Slants,
) {
    let weak = settings.weak_score;
    for s in sources {
        let Some(p) = rays.pixel_of(s.point) else {
            continue;
        };
        let z = slants.depth(rays, p);
        if slants.score[p] < weak || (z - s.point.z).abs() > 0.05 * s.point.z {
            slants.plane[p] = [0.0, 0.0, 1.0 / s.point.z];
        }
        slants.score[p] = slants.score[p].max(SURE);
    }
    let mut from: Vec<usize> = (0..rays.len()).collect();
    let mut cost = vec![f32::INFINITY; rays.len()];
    let mut heap = BinaryHeap::new();
    for (p, cost) in cost.iter_mut().enumerate() {
        if slants.score[p] >= weak {
            *cost = 0.0;
            heap.push(Reverse((Cost(0.0), p)));
        }
    }
    while let Some(Reverse((Cost(c), p))) = heap.pop() {
        if c > cost[p] {
            continue;
        }
        let (column, row) = (p % rays.width, p / rays.width);
        let near = [
            (column > 0).then(|| p - 1),
            (column + 1 < rays.width).then(|| p + 1),
            (row > 0).then(|| p - rays.width),
            (row + 1 < rays.height).then(|| p + rays.width),
        ];
        for q in near.into_iter().flatten() {
            let z = depth_of(&slants.plane[from[p]], rays.film(q));
            let beyond = z * rays.slant[q] - bound[q];
            let late = LATE * (beyond / settings.early_slack_m).clamp(0.0, 1.0);
            let next = c + STEP + (log[q] - log[p]).abs() + late;
            if slants.score[q] < weak && next < cost[q] {
                cost[q] = next;
                from[q] = from[p];
                heap.push(Reverse((Cost(next), q)));
            }
        }
    }
    let planes: Vec<_> = from.iter().map(|p| slants.plane[*p]).collect();
    slants.plane = planes;
    for (p, from) in from.iter().enumerate() {
        let range = slants.depth(rays, p) * rays.slant[p];
        if *from != p && range > bound[p] + 0.5 * settings.early_slack_m {
            let range = (bound[p] - settings.early_gap_m).max(settings.nearest_m);
            slants.plane[p] = [0.0, 0.0, rays.slant[p] / range];
        }
    }
}
