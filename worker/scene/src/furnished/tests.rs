//! Tests of furnished rooms: objects do not overlap, and none floats.

use super::{FurnishedSettings, furnish, plan::Plan, tops::TOPS};
use crate::{AssetLibrary, Vec3, rng::Rng};

fn for_each_room(check: impl Fn(u64, &Plan<'_>)) {
    let assets = AssetLibrary::parametric();
    let settings = FurnishedSettings::default();
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
