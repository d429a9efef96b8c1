//! Tests of furnished rooms: objects do not overlap, and none floats.

use super::{FurnishedSettings, furnish, plan::Plan, tops::TOPS};
use crate::{AssetLibrary, Vec3, rng::Rng};
use picofarm_settings::FloorPlan;

fn for_each_room(check: impl Fn(u64, &Plan<'_>)) {
    for_each_room_of(FloorPlan::Box, &check);
    for_each_room_of(FloorPlan::Varied, &check);
}

fn for_each_room_of(floor_plan: FloorPlan, check: impl Fn(u64, &Plan<'_>)) {
    let assets = AssetLibrary::parametric();
    let settings = FurnishedSettings {
        floor_plan,
        ..FurnishedSettings::default()
    };
    for seed in 0..30 {
        let (plan, _) = furnish(&mut Rng::new(seed, 0), &settings, &assets);
        check(seed, &plan);
    }
}

#[test]
fn furniture_boxes_overlap_only_where_one_stands_on_the_other() {
    for_each_room(|seed, plan| {
        for (j, b) in plan.placed.iter().enumerate() {
            let Some(foot) = &b.foot else { continue };
            assert!(
                plan.room.holds(foot),
                "seed {seed}: {} leaves the room",
                b.name
            );
            for a in &plan.placed[..j] {
                let overlaps = a.foot.as_ref().is_some_and(|f| f.overlaps(foot));
                let stands_on = TOPS.contains(&a.label) && b.at[1] > a.at[1] + 0.2;
                assert!(
                    !overlaps || stands_on,
                    "seed {seed}: {} runs into {}",
                    b.name,
                    a.name
                );
            }
        }
    });
}

#[test]
fn everything_rests_on_the_floor_on_something_or_hangs_on_a_wall() {
    for_each_room(|seed, plan| {
        let world = plan.world();
        for p in plan.placed.iter().filter(|p| p.foot.is_some()) {
            if matches!(p.label, "mirror" | "picture" | "window") {
                // Its back is within a centimetre of a wall: a ray goes backwards from its middle.
                let back = p.to_world().direction(Vec3::new(0.0, 0.0, -1.0));
                let from =
                    p.to_world()
                        .point(Vec3::new(0.0, p.model.hi.y * 0.5, p.model.lo.z - 1e-5));
                let wall = world.closest(from, back).expect("rooms are closed");
                assert!(
                    wall.t < 0.01,
                    "seed {seed}: {} hangs {} m off the wall",
                    p.name,
                    wall.t
                );
                continue;
            }
            let from = Vec3::new(p.at[0], p.at[1] - 1e-5, p.at[2]);
            let below = world
                .closest(from, Vec3::new(0.0, -1.0, 0.0))
                .expect("rooms are closed");
            assert!(
                below.t < 0.011,
                "seed {seed}: {} floats by {} m",
                p.name,
                below.t
            );
        }
    });
}

#[test]
fn rooms_are_furnished_and_differ() {
    let kinds = std::cell::RefCell::new(std::collections::BTreeSet::new());
    for_each_room(|seed, plan| {
        let count = plan.placed.iter().filter(|p| p.foot.is_some()).count();
        assert!(count >= 15, "seed {seed} has only {count} pieces");
        kinds
            .borrow_mut()
            .extend(plan.placed.iter().map(|p| p.label));
    });
    assert!(kinds.borrow().len() >= 40, "{:?}", kinds.borrow());
}

#[test]
fn varied_rooms_are_closed_and_furniture_stays_out_of_the_missing_corner() {
    let (mut l_shaped, mut open, mut glazed) = (0, 0, 0);
    let is_glass = |p: &super::plan::Placed| {
        let bsdf = p.model.mesh.materials[0].bsdf;
        matches!(bsdf, crate::Bsdf::ThinDielectric { .. })
    };
    let assets = AssetLibrary::parametric();
    let settings = FurnishedSettings {
        floor_plan: FloorPlan::Varied,
        ..FurnishedSettings::default()
    };
    for seed in 0..60 {
        let (plan, _) = furnish(&mut Rng::new(seed, 0), &settings, &assets);
        let world = plan.world();
        // Rays from the air of the room, in every direction: none leaves, through no gap.
        let mut rng = Rng::new(seed, 99);
        let mut rays = 0;
        while rays < 2000 {
            let [w, d, h] = [plan.room.width, plan.room.depth, plan.room.height];
            let from = Vec3::new(
                rng.range(-0.49, 0.49) * w,
                rng.range(0.01, 0.99) * h,
                rng.range(-0.49, 0.49) * d,
            );
            if plan.solid.is_some_and(|s| s.contains(from, 0.01)) {
                continue;
            }
            rays += 1;
            let mut along = || rng.range(-1.0, 1.0);
            let direction = Vec3::new(along(), along(), along()).normalized();
            let mut at = from;
            // Glass lets light pass.
            let hit = loop {
                let hit = world.closest(at, direction);
                match hit {
                    Some(h) if is_glass(&plan.placed[h.object]) => {
                        at += direction * (h.t + 1e-4);
                    }
                    other => break other,
                }
            };
            let hit = hit.unwrap_or_else(|| panic!("seed {seed}: {from:?} {direction:?} escapes"));
            let end = at + direction * hit.t;
            let corner = plan.solid.is_some_and(|s| s.contains(end, -0.01));
            assert!(!corner, "seed {seed}: light enters the missing corner");
        }
        if let Some(solid) = &plan.solid {
            l_shaped += 1;
            let inside = |f: &crate::layout::Footprint| f.overlaps(solid);
            assert!(
                !plan
                    .placed
                    .iter()
                    .any(|p| p.foot.as_ref().is_some_and(inside))
            );
        }
        let has = |label| {
            let of_room = |p: &&super::plan::Placed| p.label == label && p.foot.is_none();
            usize::from(plan.placed.iter().any(|p| of_room(&p)))
        };
        open += has("door");
        glazed += has("window");
    }
    for (what, rooms) in [
        ("L-shaped", l_shaped),
        ("open door", open),
        ("glazed", glazed),
    ] {
        assert!((15..=50).contains(&rooms), "{what}: {rooms} of 60 rooms");
    }
}
