//! Furniture on the floor: anchors with their backs to the wall, tables with chairs, and clutter.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use crate::rng::Rng;

use super::{
    RoomType,
    plan::{CONTACT_GAP, Plan, half_of},
};

/// The distance of anchors from the wall, metres.
const WALL_GAP: f32 = 0.01;
/// The number of positions to try for an anchor or a table.
const TRIES: u32 = 40;

/// Returns the categories of furniture along the walls, most important first.
fn anchors_of(kind: RoomType) -> &'static [&'static str] {
    match kind {
        RoomType::Living => &[
            "sofa",
            "tv_stand",
            "bookcase",
            "armchair",
            "piano",
            "radiator",
            "fireplace",
            "cabinet",
            "lamp",
            "plant",
            "shelf",
        ],
        RoomType::Bedroom => &[
            "bed",
            "wardrobe",
            "nightstand",
            "dresser",
            "desk",
            "nightstand",
            "radiator",
            "chair",
            "plant",
            "basket",
            "toy",
        ],
        RoomType::Office => &[
            "desk", "bookcase", "desk", "shelf", "cabinet", "bookcase", "radiator", "armchair",
            "plant", "basket",
        ],
        RoomType::Kitchen => &[
            "kitchen_appliance",
            "cabinet",
            "sink",
            "kitchen_appliance",
            "cabinet",
            "cabinet",
            "kitchen_appliance",
            "shelf",
            "radiator",
            "plant",
        ],
    }
}

/// Places the room type's furniture against the walls.
pub(super) fn anchors(rng: &mut Rng, plan: &mut Plan<'_>, kind: RoomType) {
    let (room, assets) = (plan.room, plan.assets);
    for (rank, label) in anchors_of(kind).iter().enumerate() {
        // The first two define the room type; any of the others may be missing.
        if rank >= 2 && rng.chance(0.15) {
            continue;
        }
        let fits = |[w, h, d]: [f32; 3], elevation: f32| {
            w.max(d) <= 2.6 && w.max(d) >= 0.2 && elevation + h < room.height - 0.1
        };
        let Some((asset, model)) = assets.draw(rng, label, fits) else {
            continue;
        };
        for _ in 0..TRIES {
            let along = rng.range(-1.0, 1.0);
            let (at, yaw) = room.against_wall(rng.below(4), along, half_of(&model), WALL_GAP);
            let y = asset.elevation.max(CONTACT_GAP);
            if plan.try_place_asset((asset, &model), [at[0], y, at[1]], yaw, None) {
                break;
            }
        }
    }
}

/// Places a rug, and tables in the room with seats that face them.
pub(super) fn groups(rng: &mut Rng, plan: &mut Plan<'_>, kind: RoomType) {
    let (room, assets) = (plan.room, plan.assets);
    let on_floor = |elevation: f32| elevation < 0.01;
    if rng.chance(0.7) {
        let fits = |[w, h, d]: [f32; 3], elevation: f32| {
            w.max(d) < 2.4 && w.min(d) > 0.5 && h < 0.03 && on_floor(elevation)
        };
        if let Some((asset, model)) = assets.draw(rng, "rug", fits) {
            let at = [
                rng.range(-0.25, 0.25),
                CONTACT_GAP * 0.5,
                rng.range(-0.25, 0.25),
            ];
            plan.lay((asset, &model), at, 0.0);
        }
    }
    let (table, seat) = match kind {
        RoomType::Living => ("coffee_table", "armchair"),
        _ => ("table", "chair"),
    };
    let tables = if kind == RoomType::Bedroom {
        1
    } else {
        1 + rng.below(2)
    };
    for _ in 0..tables {
        let fits = |[w, h, d]: [f32; 3], elevation: f32| {
            w.max(d) < 1.8 && w.min(d) > 0.35 && h < 1.1 && on_floor(elevation)
        };
        let Some((asset, model)) = assets.draw(rng, table, fits) else {
            continue;
        };
        for _ in 0..TRIES {
            let yaw = rng.below(4) as f32 * FRAC_PI_2 + rng.range(-0.15, 0.15);
            let x = rng.range(-0.35, 0.35) * room.width;
            let z = rng.range(-0.35, 0.35) * room.depth;
            if plan.try_place_asset((asset, &model), [x, CONTACT_GAP, z], yaw, None) {
                seats(rng, plan, seat, [x, z], yaw, half_of(&model));
                break;
            }
        }
    }
    for desk in 0..plan.placed.len() {
        if plan.placed[desk].label == "desk" {
            desk_chair(rng, plan, desk);
        }
    }
}

/// Places the same chair on up to four sides of a table, turned towards it.
fn seats(
    rng: &mut Rng,
    plan: &mut Plan<'_>,
    label: &str,
    centre: [f32; 2],
    yaw: f32,
    table: [f32; 2],
) {
    let fits = |[w, h, d]: [f32; 3], elevation: f32| {
        w.max(d) < 1.1 && w.min(d) > 0.3 && h > 0.5 && h < 1.4 && elevation < 0.01
    };
    let Some((asset, model)) = plan.assets.draw(rng, label, fits) else {
        return;
    };
    let half = half_of(&model);
    for side in 0..4 {
        let towards = yaw + side as f32 * FRAC_PI_2;
        let reach = table[usize::from(side % 2 == 0)] + half[1] + rng.range(0.02, 0.25);
        let slide = rng.range(-0.1, 0.1);
        let (s, c) = (libm::sinf(towards), libm::cosf(towards));
        let at = [
            centre[0] + s * reach + c * slide,
            CONTACT_GAP,
            centre[1] + c * reach - s * slide,
        ];
        let turn = towards + PI + rng.range(-0.25, 0.25);
        plan.try_place_asset((asset, &model), at, turn, None);
    }
}

/// Places a chair in front of a desk, its back to the room.
fn desk_chair(rng: &mut Rng, plan: &mut Plan<'_>, desk: usize) {
    let (at, yaw, half) = {
        let d = &plan.placed[desk];
        (d.at, d.yaw, half_of(&d.model))
    };
    let fits = |[w, h, d]: [f32; 3], elevation: f32| {
        w.max(d) < 0.9 && w.min(d) > 0.3 && h > 0.5 && h < 1.4 && elevation < 0.01
    };
    let Some((asset, model)) = plan.assets.draw(rng, "chair", fits) else {
        return;
    };
    for _ in 0..6 {
        let reach = half[1] + half_of(&model)[1] + rng.range(0.02, 0.2);
        let slide = rng.range(-0.25, 0.25);
        let (s, c) = (libm::sinf(yaw), libm::cosf(yaw));
        let place = [
            at[0] + s * reach + c * slide,
            CONTACT_GAP,
            at[2] + c * reach - s * slide,
        ];
        let turn = yaw + PI + rng.range(-0.5, 0.5);
        if plan.try_place_asset((asset, &model), place, turn, None) {
            break;
        }
    }
}

/// Places small objects on the floor, at random positions and angles.
pub(super) fn clutter(rng: &mut Rng, plan: &mut Plan<'_>) {
    const KINDS: [&str; 12] = [
        "box", "bag", "toy", "basket", "ball", "stool", "plant", "lamp", "exercise", "guitar",
        "speaker", "box",
    ];
    let room = plan.room;
    for _ in 0..3 + rng.below(5) {
        let label = *rng.pick(&KINDS);
        let fits = |[w, h, d]: [f32; 3], elevation: f32| {
            w.max(d) < 0.9 && w.max(d) > 0.08 && h < 1.9 && elevation < 0.01
        };
        let Some((asset, model)) = plan.assets.draw(rng, label, fits) else {
            continue;
        };
        for _ in 0..30 {
            let x = rng.range(-0.5, 0.5) * room.width;
            let z = rng.range(-0.5, 0.5) * room.depth;
            if plan.try_place_asset(
                (asset, &model),
                [x, CONTACT_GAP, z],
                rng.range(0.0, TAU),
                None,
            ) {
                break;
            }
        }
    }
}
