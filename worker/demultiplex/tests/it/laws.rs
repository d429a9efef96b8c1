//! What must hold where times are known in closed form.

use crate::common;

use common::{Plate, Room, Shape, grid, scattered};
use picofarm_demultiplex::{
    Capture, Demultiplexed, Evidence, Ground, Settings, Shading, Truth, demultiplex, residual,
    score, shadows_at, with_evidence,
};
use picofarm_scene::Vec3;
use picofarm_sensor::{Draws, poisson};
use picofarm_settings::{EvidenceForm, Gate};

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
fn peaks_agree_with_right_depths_and_not_with_wrong_ones() {
    let room = Room::new(SIDE, &grid(5), None);
    let beams = room.beams(true);
    let capture = room.capture(&beams);
    let mut found = apart(&room, true);
    let right = residual(&capture, &found).expect("pairs");
    assert!(right.peaks > 1000, "{right:?}");
    assert!(right.median_m < 0.25 * room.gate.bin_width_m, "{right:?}");
    assert!(right.control_m > 4.0 * right.median_m, "{right:?}");
    found.depth_m.iter_mut().for_each(|z| *z *= 1.1);
    let wrong = residual(&capture, &found).expect("pairs");
    assert!(wrong.median_m > 4.0 * right.median_m, "{wrong:?}");
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

fn physics() -> Settings {
    Settings {
        shadows: Shading::Physics,
        ..Settings::default()
    }
}

#[test]
fn threads_change_no_byte() {
    let room = occluded(SIDE);
    let beams = room.beams(true);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let run = || demultiplex(&room.capture(&beams), &Settings::default());
        pool.build().unwrap().install(run).expect("a room")
    };
    assert_eq!(on(1), on(4));
    assert_eq!(on(1), on(3));
}

const GATE: Gate = Gate {
    start_m: 1.0,
    bin_width_m: 0.0384,
    bins: 640,
};

#[test]
fn a_mirror_is_found_and_has_its_own_depth() {
    let shape = Shape {
        size: 1.0,
        mirror: Some([-0.9, -0.8, 0.3, 0.35]),
    };
    let places = scattered(36);
    let room = |shape| Room::shaped(64, &places, None, GATE, Vec3::ZERO, shape, |_, _| true);
    let seen = |places: &[[f32; 2]], room: &Room| -> Vec<[f32; 2]> {
        let on = |p: &&[f32; 2]| {
            let (column, row) = ((p[0] * 64.0) as usize, (p[1] * 64.0) as usize);
            room.mirror[row * 64 + column] == 0
        };
        places.iter().filter(on).copied().collect()
    };
    let off = seen(&places, &room(shape));
    let room = Room::shaped(64, &off, None, GATE, Vec3::ZERO, shape, |_, _| true);
    let found = apart(&room, true);
    let truth = Truth {
        depth_m: &room.depth,
        specular: &room.mirror,
        visibility: &[],
    };
    let iou = score::mirrors(&found, &truth).expect("there is a mirror");
    assert!(iou > 0.75, "mirrors: IoU {iou}");
    let said = found.mirror.as_ref().expect("mirrors are looked for");
    let both = |p: &usize| said[*p] != 0 && room.mirror[*p] != 0;
    for p in (0..room.depth.len()).filter(both) {
        let off = (found.depth_m[p] - room.depth[p]).abs();
        assert!(off < 0.06, "pixel {p}: {} m, {off} m off", found.depth_m[p]);
    }
}

#[test]
fn a_room_without_mirrors_has_none() {
    let room = Room::new(64, &grid(5), None);
    let found = apart(&room, true);
    assert!(found.mirror.unwrap().iter().all(|m| *m == 0));
}

#[test]
fn no_depth_is_farther_than_the_first_light_allows() {
    let room = occluded(64);
    let found = apart(&room, true);
    let bins = room.gate.bins as usize;
    let slant = |p: usize| {
        let (column, row) = ((p % 64) as f32 + 0.5, (p / 64) as f32 + 0.5);
        room.camera.ray(column, row)
    };
    let mut late = 0;
    for p in 0..room.depth.len() {
        let h = &room.histogram[p * bins..][..bins];
        let Some(first) = h.iter().position(|x| *x > 0.0) else {
            continue;
        };
        let x = slant(p) * (found.depth_m[p] / slant(p).z);
        let path = |s: &picofarm_demultiplex::Place| s.path_m + (x - s.point).length() + x.length();
        let earliest = room.spots.iter().map(path).fold(f32::INFINITY, f32::min);
        let end = room.gate.start_m as f32 + (first + 1) as f32 * room.gate.bin_width_m as f32;
        late += u32::from(earliest > end + 0.2);
    }
    assert!(late * 200 < room.depth.len() as u32, "{late} pixels");
}

#[test]
fn ambient_light_does_not_bring_surfaces_nearer() {
    let room = Room::new(SIDE, &grid(4), None);
    let bins = room.gate.bins as usize;
    let mut peaks: Vec<f32> = room
        .histogram
        .chunks(bins)
        .map(|h| h.iter().copied().fold(0.0, f32::max))
        .collect();
    peaks.sort_by(f32::total_cmp);
    let scale = 400.0 / f64::from(peaks[peaks.len() / 2]);
    let beams = room.beams(true);
    let errors = |ambient: f64| {
        let counted: Vec<f32> = room
            .histogram
            .iter()
            .enumerate()
            .map(|(k, rate)| {
                let mut draws = Draws::new(7, 0, (k / bins) as u64, (k % bins) as u64);
                poisson(f64::from(*rate) * scale + ambient, &mut draws) as f32
            })
            .collect();
        let capture = Capture {
            histogram: &counted,
            ..room.capture(&beams)
        };
        let found = demultiplex(&capture, &Settings::default()).expect("a room");
        errors(&room, &found)
    };
    let [_, dark] = errors(0.0);
    let [median, most] = errors(2.0);
    assert!(median < 0.01, "median {median} m");
    assert!(
        most < 0.02 + 2.0 * dark,
        "95th percentile {most} m, in the dark {dark} m"
    );
}

/// 16 spots and 375 bins of 32 ps, as a laboratory's single-photon camera has them, with counted
/// photons.
#[test]
fn the_laboratorys_form_works_with_photon_noise() {
    let gate = Gate {
        start_m: 0.9,
        bin_width_m: 0.009_593_36,
        bins: 375,
    };
    let shape = Shape {
        size: 0.33,
        mirror: None,
    };
    let room = Room::shaped(SIDE, &grid(4), None, gate, Vec3::ZERO, shape, |_, _| true);
    let mut peaks: Vec<f32> = room
        .histogram
        .chunks(375)
        .map(|h| h.iter().copied().fold(0.0, f32::max))
        .collect();
    peaks.sort_by(f32::total_cmp);
    let scale = 100.0 / f64::from(peaks[peaks.len() / 2]);
    let counted: Vec<f32> = room
        .histogram
        .iter()
        .enumerate()
        .map(|(k, rate)| {
            let mut draws = Draws::new(7, 0, k as u64 / 375, k as u64 % 375);
            poisson(f64::from(*rate) * scale, &mut draws) as f32
        })
        .collect();
    let beams = room.beams(true);
    let capture = Capture {
        histogram: &counted,
        ..room.capture(&beams)
    };
    let found = demultiplex(&capture, &Settings::default()).expect("a room");
    let [median, most] = errors(&room, &found);
    assert!(median < 0.006, "median {median} m");
    assert!(most < 0.06, "95th percentile {most} m");
}

#[test]
fn a_capture_without_light_is_taken_apart_in_both_ways() {
    let mut room = Room::new(8, &grid(2), None);
    room.histogram.fill(0.0);
    let beams = room.beams(true);
    for settings in [Settings::default(), physics()] {
        let found = demultiplex(&room.capture(&beams), &settings).expect("no error");
        assert!(found.lit.iter().all(|p| (0.0..=1.0).contains(p)));
    }
}

#[test]
fn the_evidence_changes_no_answer_and_its_last_plane_has_the_sign_of_each() {
    let room = occluded(32);
    let beams = room.beams(true);
    let (capture, settings) = (room.capture(&beams), Settings::default());
    let pixels = capture.pixels();
    assert_eq!(Evidence::form().planes.len(), Evidence::PLANES);
    for depth in [None, Some(&room.depth[..])] {
        let plain = match depth {
            Some(depth) => shadows_at(&capture, depth, &settings).unwrap(),
            None => demultiplex(&capture, &settings).unwrap(),
        };
        let (found, evidence) = with_evidence(&capture, depth, &settings).unwrap();
        assert_eq!(found, plain);
        assert_eq!(
            evidence.codes.len(),
            beams.len() * Evidence::PLANES * pixels
        );
        let spots = evidence.codes.chunks_exact(Evidence::PLANES * pixels);
        for (spot, lit) in spots.zip(found.lit.chunks_exact(pixels)) {
            let odds = &spot[(Evidence::PLANES - 1) * pixels..];
            for (code, p) in odds.iter().zip(lit) {
                assert_eq!(
                    EvidenceForm::log_odds(*code) > 0.0,
                    *p >= 0.5,
                    "{code}, {p}"
                );
            }
        }
        let one = rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .unwrap();
        let again = one.install(|| with_evidence(&capture, depth, &settings).unwrap());
        assert_eq!(again, (found, evidence));
    }
}

#[test]
fn evidence_needs_the_learned_shadows() {
    let room = Room::new(16, &grid(3), None);
    let beams = room.beams(true);
    let settings = Settings {
        shadows: Shading::Physics,
        ..Settings::default()
    };
    let error = with_evidence(&room.capture(&beams), None, &settings).unwrap_err();
    assert!(error.to_string().contains("settings.shadows"), "{error}");
}
