//! What must hold where times are known in closed form.

use crate::common;

use common::{Plate, Room, grid, scattered};
use picofarm_demultiplex::{Demultiplexed, Ground, Settings, demultiplex, shadows_at};
use picofarm_scene::Vec3;
use picofarm_settings::Gate;

const SIDE: u32 = 48;

fn apart(room: &Room, known: bool) -> Demultiplexed {
    let beams = room.beams(known);
    demultiplex(&room.capture(&beams), &Settings::default()).expect("a room")
}

/// Median and 95th percentile of the errors of depth, metres.
fn errors(room: &Room, found: &Demultiplexed) -> [f32; 2] {
    let mut all: Vec<f32> = room
        .depth
        .iter()
        .zip(&found.depth_m)
        .map(|(z, f)| (z - f).abs())
        .collect();
    all.sort_by(f32::total_cmp);
    [all[all.len() / 2], all[all.len() * 19 / 20]]
}

#[test]
fn a_box_room_comes_back_to_a_tenth_of_a_bin() {
    let room = Room::new(SIDE, &grid(5), None);
    let [median, most] = errors(&room, &apart(&room, true));
    let tenth = 0.1 * room.gate.bin_width_m as f32;
    assert!(median < tenth, "median {median} m, a tenth is {tenth} m");
    assert!(most < 10.0 * tenth, "95th percentile {most} m");
}

#[test]
fn spots_need_no_grid_and_any_number_of_them_will_do() {
    for (places, bound) in [
        (grid(2), 0.02),
        (grid(4), 0.006),
        (scattered(16), 0.006),
        (grid(10), 0.006),
    ] {
        let room = Room::new(SIDE, &places, None);
        let [median, _] = errors(&room, &apart(&room, true));
        assert!(median < bound, "{} spots: median {median} m", places.len());
    }
}

#[test]
fn bins_may_be_finer_or_coarser() {
    for (width, bins) in [(0.0096, 1900), (0.0288, 640), (0.0768, 240), (0.15, 120)] {
        let gate = Gate {
            start_m: 1.0,
            bin_width_m: width,
            bins,
        };
        let room = Room::with(SIDE, &grid(5), None, gate, Vec3::ZERO, |_, _| true);
        let [median, _] = errors(&room, &apart(&room, true));
        let bound = (0.06 * width as f32).max(0.004);
        assert!(median < bound, "bins of {width} m: median {median} m");
    }
}

#[test]
fn places_of_spots_follow_from_their_own_returns_and_a_laser_may_stand_aside() {
    let gate = Gate {
        start_m: 1.0,
        bin_width_m: 0.0384,
        bins: 480,
    };
    for laser in [Vec3::ZERO, Vec3::new(0.15, -0.1, 0.0)] {
        let room = Room::with(SIDE, &grid(5), None, gate, laser, |_, _| true);
        let found = apart(&room, false);
        for (place, truth) in found.places.iter().zip(&room.spots) {
            let place = place.expect("its return is in the gate");
            let off = (place.point - truth.point).length();
            assert!(off < 0.5 * gate.bin_width_m as f32, "{place:?}, {truth:?}");
        }
        let [median, _] = errors(&room, &found);
        assert!(median < 0.01, "median {median} m");
    }
}

fn occluded(side: u32) -> Room {
    let plate = Plate {
        x: -0.3,
        sides: [-0.5, 1.4, 1.2, 2.3],
    };
    Room::new(side, &grid(5), Some(plate))
}

#[test]
fn masks_of_a_single_occluder_are_right_away_from_their_edges() {
    let room = occluded(96);
    let beams = room.beams(true);
    let found = shadows_at(&room.capture(&beams), &room.depth, &Settings::default()).unwrap();
    let pixels = room.depth.len();
    let (mut judged, mut dark, mut wrong) = (0, 0, 0);
    for k in 0..beams.len() {
        let mask = &room.lit[k * pixels..][..pixels];
        for p in 0..pixels {
            let q = k * pixels + p;
            if !room.faces[q] || found.ground[q] != Ground::Light || !room.inner(mask, p, 2) {
                continue;
            }
            judged += 1;
            dark += u32::from(mask[p] == 0);
            wrong += u32::from((found.lit[q] >= 0.5) != (mask[p] != 0));
        }
    }
    assert!(
        judged > 50_000 && dark > 2_000,
        "{judged} pairs, {dark} in shadow"
    );
    let share = f64::from(wrong) / f64::from(judged);
    assert!(
        share < 0.01,
        "{wrong} of {judged} pairs are wrong, {dark} are in shadow"
    );
}

#[test]
fn two_spots_that_collide_everywhere_are_mostly_reported_as_ambiguous() {
    let mut places = grid(4);
    places.push(places[5]);
    let gate = Gate {
        start_m: 1.0,
        bin_width_m: 0.0384,
        bins: 480,
    };
    // Only one of the two sends light; which, nobody can know.
    let room = Room::with(SIDE, &places, None, gate, Vec3::ZERO, |k, _| k != 16);
    let beams = room.beams(true);
    let found = shadows_at(&room.capture(&beams), &room.depth, &Settings::default()).unwrap();
    let pixels = room.depth.len();
    let (mut all, mut said) = (0, 0);
    for p in 0..pixels {
        for k in [5, 16] {
            let q = k * pixels + p;
            let seen = !matches!(found.ground[q], Ground::Geometry | Ground::Faint);
            if room.faces[q] && seen {
                all += 1;
                said += u32::from(found.ground[q] == Ground::Ambiguous);
            }
        }
    }
    assert!(
        all > 2_000 && 2 * said > all,
        "{said} of {all} pairs are ambiguous"
    );
}

#[test]
fn threads_change_no_byte() {
    let room = occluded(SIDE);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build().unwrap().install(|| apart(&room, true))
    };
    assert_eq!(on(1), on(4));
}
