//! Small objects on tops: they are placed where rays from above hit flat, free support.

use std::f32::consts::TAU;

use crate::{Vec3, rng::Rng, trace::Model};

use super::{
    RoomType,
    plan::{CONTACT_GAP, Plan, half_of},
};

/// The greatest difference of support heights under one object, metres.
const FLATNESS_M: f32 = 0.01;

/// Taller objects are placed on the floor, metres.
const TALLEST_M: f32 = 0.75;

/// The categories that support small objects.
pub(super) const TOPS: [&str; 12] = [
    "table",
    "coffee_table",
    "desk",
    "nightstand",
    "dresser",
    "cabinet",
    "tv_stand",
    "shelf",
    "piano",
    "bookcase",
    "fireplace",
    "kitchen_appliance",
];

/// Returns the categories of objects on the tops of a room.
fn things(kind: RoomType) -> &'static [&'static str] {
    match kind {
        RoomType::Living => &[
            "cup", "bottle", "bowl", "book", "plant", "vase", "lamp", "clock", "speaker", "food",
            "phone", "book",
        ],
        RoomType::Bedroom => &[
            "book", "lamp", "clock", "phone", "cup", "plant", "toy", "vase", "laptop", "box",
            "bag", "book",
        ],
        RoomType::Office => &[
            "laptop", "computer", "keyboard", "book", "cup", "lamp", "phone", "plant", "speaker",
            "box", "book", "clock",
        ],
        RoomType::Kitchen => &[
            "plate",
            "bowl",
            "cup",
            "bottle",
            "food",
            "small_appliance",
            "small_appliance",
            "vase",
            "plate",
            "box",
            "cup",
            "basket",
        ],
    }
}

/// Places objects on tables and cases.
pub(super) fn drop_things(rng: &mut Rng, plan: &mut Plan<'_>, kind: RoomType) {
    for support in 0..plan.placed.len() {
        let label = plan.placed[support].label;
        if !TOPS.contains(&label) {
            continue;
        }
        if label == "tv_stand" {
            drop_one(rng, plan, support, "tv");
        }
        for _ in 0..1 + rng.below(5) {
            let thing = *rng.pick(things(kind));
            drop_one(rng, plan, support, thing);
        }
    }
}

fn drop_one(rng: &mut Rng, plan: &mut Plan<'_>, support: usize, label: &str) {
    let (base, model) = (
        plan.placed[support].clone(),
        plan.placed[support].model.clone(),
    );
    let room_above = plan.room.height - 0.1 - (base.at[1] + model.size()[1]);
    let widest = if label == "tv" { 1.4 } else { 0.5 };
    let fits = |[w, h, d]: [f32; 3], elevation: f32| {
        w.max(d) < widest && w.max(d) > 0.03 && h < room_above.min(TALLEST_M) && elevation < 0.01
    };
    let Some((asset, thing)) = plan.assets.draw(rng, label, fits) else {
        return;
    };
    let faces_front = matches!(
        label,
        "tv" | "computer" | "laptop" | "keyboard" | "speaker" | "clock"
    );
    let half = half_of(&thing);
    for _ in 0..12 {
        let turn = if faces_front {
            rng.range(-0.3, 0.3)
        } else {
            rng.range(0.0, TAU)
        };
        let (s, c) = (libm::sinf(turn), libm::cosf(turn));
        // Half extents of the turned rectangle along the support's own axes.
        let reach = [
            half[0] * c.abs() + half[1] * s.abs(),
            half[0] * s.abs() + half[1] * c.abs(),
        ];
        let free = [half_of(&model)[0] - reach[0], half_of(&model)[1] - reach[1]];
        if free[0] <= 0.0 || free[1] <= 0.0 {
            continue;
        }
        let local = [rng.range(-free[0], free[0]), rng.range(-free[1], free[1])];
        let corners =
            [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]].map(|[i, j]: [f32; 2]| {
                [
                    i * half[0] * c + j * half[1] * s,
                    j * half[1] * c - i * half[0] * s,
                ]
            });
        let Some(height) = flat_height(&model, local, &corners) else {
            continue;
        };
        let p = base
            .to_world()
            .point(Vec3::new(local[0], height + CONTACT_GAP, local[1]));
        if plan.try_place_asset((asset, &thing), p.into(), base.yaw + turn, Some(support)) {
            return;
        }
    }
}

/// Returns the height of the support under a rectangle, if nine rays from above (its middle, its
/// corners, and half way) agree on it.
fn flat_height(support: &Model, at: [f32; 2], corners: &[[f32; 2]; 4]) -> Option<f32> {
    let start = support.size()[1] + 0.5;
    let down = Vec3::new(0.0, -1.0, 0.0);
    let probe = |dx: f32, dz: f32| {
        let from = Vec3::new(at[0] + dx, start, at[1] + dz);
        support
            .closest(from, down, f32::MAX)
            .map(|(t, _)| start - t)
    };
    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
    for scale in [0.0, 0.5, 0.97] {
        for [x, z] in corners {
            let y = probe(x * scale, z * scale)?;
            (low, high) = (low.min(y), high.max(y));
            if scale == 0.0 {
                break;
            }
        }
    }
    // The highest point is used, so that the object rests on the support and does not sink into it.
    (high - low <= FLATNESS_M && high > 0.2).then_some(high)
}
