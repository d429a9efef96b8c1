//! What must hold for captures whose calibration is known.

use std::sync::OnceLock;

use picofarm_calibrate::{Checked, Fault, Measurement, Verdict, check};

use crate::common::{self, Capturing, GATE, Room};

const SIDE: u32 = 48;
const PHOTONS: f64 = 100.0;

/// A furnished room, rendered once.
fn room() -> &'static Room {
    static ROOM: OnceLock<Room> = OnceLock::new();
    ROOM.get_or_init(|| Room::new(7, SIDE, 0))
}

fn checked(capture: &Capturing, masks: Option<&[u8]>) -> Checked {
    check(&Measurement {
        capture: capture.capture(),
        per_spot: Some(&capture.per_spot),
        masks,
        pulses: None,
    })
    .expect("a capture")
}

fn named(checked: &Checked) -> Vec<Fault> {
    checked.report.causes.iter().map(|c| c.fault).collect()
}

#[test]
fn an_undisturbed_capture_is_good_in_any_room_and_with_a_mirror() {
    for (seed, mirrors, photons) in [(7, 0, 100.0), (8, 0, 30.0), (11, 0, 400.0), (9, 1, 100.0)] {
        let room = Room::new(seed, SIDE, mirrors);
        let found = checked(&room.measure(photons, seed, |_| {}), Some(&room.visibility));
        assert_eq!(found.report.causes, [], "seed {seed}");
        assert_eq!(found.report.verdict, Verdict::Good);
        assert_eq!(found.corrected.laser, room.laser);
        assert_eq!(found.corrected.gate, GATE);
    }
}

#[test]
fn every_fault_is_named_and_nothing_else() {
    let expected = |name: &str| -> &[Fault] {
        match name {
            "nothing" | "only directions" => &[],
            "t0 1 bin late" | "t0 5 bins early" | "only directions, t0 1 bin late" => {
                &[Fault::TimeZero]
            }
            "laser 1 cm right" | "laser 10 cm right" | "only directions, laser 1 cm right" => {
                &[Fault::Laser]
            }
            "laser 1 cm right, t0 1 bin late" => &[Fault::TimeZero, Fault::Laser],
            "two spots swapped" | "spots shifted by one" => &[Fault::SpotOrder],
            "spot 5 moved 10 cm" => &[Fault::Spot],
            "mirrored in x" | "mirrored in y" | "transposed" => &[Fault::Image],
            "one way for there and back" => &[Fault::TimeScale],
            "bins 2 % too wide" => &[Fault::BinWidth],
            "view 80 instead of 90 degrees" => &[Fault::FieldOfView],
            "half of the pixels dead" => &[Fault::DeadPixels],
            "20 hot pixels" => &[Fault::HotPixels],
            "counts clipped at 127" => &[Fault::Clipped],
            "masks shifted by one" => &[Fault::MaskOrder],
            "background of 4 counts a bin" => &[Fault::Background],
            "pile-up" => &[Fault::PileUp],
            other => panic!("a fault without an expectation: {other}"),
        }
    };
    let plain = room().measure(PHOTONS, 1, |_| {});
    for (name, capture, masks) in common::faults(room(), &plain, |_| true) {
        let found = checked(&capture, Some(&masks));
        assert_eq!(named(&found), expected(name), "{name}");
    }
}

#[test]
fn a_bin_of_t0_and_a_centimetre_of_the_laser_are_corrected_to_a_tenth() {
    for seed in [7, 8, 12] {
        let room = Room::new(seed, SIDE, 0);
        let plain = room.measure(PHOTONS, 1, |_| {});
        let wanted = |name: &str| {
            let small = name.contains("t0 1 bin") || name.contains("laser 1 cm");
            small && !name.contains("directions")
        };
        for (name, capture, _) in common::faults(&room, &plain, wanted) {
            let found = checked(&capture, None).corrected;
            let late = (found.gate.start_m - GATE.start_m) / GATE.bin_width_m;
            let off = (found.laser - room.laser).length();
            assert!(
                late.abs() < 0.1,
                "seed {seed}, {name}: t0 is {late} bins off"
            );
            assert!(off < 0.001, "seed {seed}, {name}: the laser is {off} m off");
        }
    }
}

#[test]
fn a_corrected_mirrored_capture_equals_the_undisturbed_one() {
    let plain = room().measure(PHOTONS, 1, |_| {});
    let wanted = ["mirrored in x", "transposed"];
    let faults = common::faults(room(), &plain, |name| wanted.contains(&name));
    assert_eq!(faults.len(), 2);
    for (name, capture, _) in faults {
        let found = checked(&capture, None).corrected;
        let same = found.histograms(&capture.per_spot) == plain.per_spot;
        assert!(same, "{name}");
    }
}

#[test]
fn swapped_spots_come_back_in_the_order_of_the_histograms() {
    let mut capture = room().measure(PHOTONS, 1, |_| {});
    let right = capture.spots.clone();
    capture.spots.swap(2, 13);
    assert_eq!(checked(&capture, None).corrected.spots, right);
}

#[test]
fn a_dead_pixel_takes_the_histogram_of_its_nearest_neighbour() {
    let mut capture = room().measure(PHOTONS, 1, |_| {});
    let bins = GATE.bins as usize;
    let cells = capture.per_spot.len() / 16;
    for h in capture.per_spot.chunks_mut(cells) {
        h[100 * bins..101 * bins].fill(0.0);
    }
    capture.add_up();
    let found = checked(&capture, None);
    assert_eq!(named(&found), [Fault::DeadPixels]);
    let sum = found.corrected.histograms(&capture.sum);
    let of_pixel = |p: usize| &sum[p * bins..(p + 1) * bins];
    assert_eq!(of_pixel(100), of_pixel(100 - SIDE as usize));
}

#[test]
fn any_number_of_threads_gives_the_same_report() {
    let capture = room().measure(PHOTONS, 1, |_| {});
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("a pool");
        pool.install(|| checked(&capture, Some(&room().visibility)))
    };
    let (one, three) = (on(1), on(3));
    assert_eq!(one.report, three.report);
    assert_eq!(one.corrected, three.corrected);
}

#[test]
fn the_pulse_is_that_of_the_sensor() {
    let found = checked(&room().measure(PHOTONS, 1, |_| {}), None);
    let fwhm = found.report.pulse.expect("returns").fwhm_ps;
    // A pulse of 128 ps and jitter of 50 ps.
    assert!((130.0..175.0).contains(&fwhm), "{fwhm} ps");
}

#[test]
fn a_capture_of_all_spots_at_once_is_judged_as_well() {
    let plain = room().measure(PHOTONS, 1, |_| {});
    let expected = |name: &str| match name {
        "nothing" => Some((Verdict::Good, vec![])),
        "t0 1 bin late" => Some((Verdict::Usable, vec![Fault::TimeZero])),
        "laser 10 cm right" => Some((Verdict::Wrong, vec![Fault::Laser])),
        "mirrored in y" => Some((Verdict::Wrong, vec![Fault::Unexplained])),
        _ => None,
    };
    let faults = common::faults(room(), &plain, |name| expected(name).is_some());
    assert_eq!(faults.len(), 4);
    for (name, capture, _) in faults {
        let found = check(&Measurement {
            capture: capture.capture(),
            per_spot: None,
            masks: None,
            pulses: None,
        });
        let found = found.expect("a capture");
        let found = (found.report.verdict, named(&found));
        assert_eq!(Some(found), expected(name), "{name}");
    }
}

#[test]
fn bad_input_is_named() {
    let capture = room().measure(PHOTONS, 1, |_| {});
    let plain = Measurement {
        capture: capture.capture(),
        per_spot: Some(&capture.per_spot),
        masks: None,
        pulses: None,
    };
    let said = |m: Measurement| check(&m).expect_err("bad input").to_string();
    let short = &capture.per_spot[1..];
    let words = said(Measurement {
        per_spot: Some(short),
        ..plain
    });
    assert!(words.starts_with("per_spot: has "), "{words}");
    let words = said(Measurement {
        masks: Some(&[1]),
        ..plain
    });
    assert!(words.starts_with("masks: has 1 values"), "{words}");
    let words = said(Measurement {
        pulses: Some(0),
        ..plain
    });
    assert!(words.starts_with("pulses: is 0"), "{words}");
}

#[test]
fn faults_that_no_correction_covers_are_wrong_and_nothing_is_corrected() {
    let plain = room().measure(PHOTONS, 1, |_| {});
    let disturbed = |change: &dyn Fn(&mut Capturing)| {
        let mut made = plain.clone();
        change(&mut made);
        made
    };
    let camera = plain.camera;
    let side = SIDE as f32;
    let behind = disturbed(&|c| {
        for place in c.spots.iter_mut().filter_map(|s| s.place.as_mut()) {
            let ahead = (place.point - camera.origin).dot(camera.forward);
            place.point = place.point - camera.forward * (2.0 * ahead);
            place.path_m = (place.point - c.laser).length();
        }
    });
    let radians = disturbed(&|c| {
        c.camera.intrinsics = picofarm_scene::Intrinsics::from_fov(1.57, SIDE, SIDE);
    });
    let shifted = disturbed(&|c| {
        c.camera.intrinsics.cx = 0.2 * side;
        c.camera.intrinsics.cy = 0.7 * side;
    });
    let late = disturbed(&|c| c.gate.start_m -= 20_000.0 / picofarm_sensor::PS_PER_M);
    let cases = [
        ("spots behind the camera", behind),
        ("fov in radians", radians),
        ("another principal point", shifted),
        ("t0 20 ns late", late),
    ];
    for (name, capture) in cases {
        let found = checked(&capture, None);
        eprintln!(
            "{name}: {:#?} {:?} {:?}",
            found.report.causes, found.report.stated, found.report.corrected
        );
        assert_eq!(found.report.verdict, Verdict::Wrong, "{name}");
        assert!(found.report.unexplained(), "{name}");
        assert!(found.report.guesses.iter().all(|g| !g.corrected), "{name}");
        assert_eq!(found.corrected.gate, capture.gate, "{name}");
        assert_eq!(found.corrected.laser, capture.laser, "{name}");
        assert_eq!(found.corrected.camera, capture.camera, "{name}");
        assert_eq!(found.corrected.spots, capture.spots, "{name}");
    }
}

#[test]
fn impossible_geometry_is_named_before_any_light_is_read() {
    let plain = room().measure(PHOTONS, 1, |_| {});
    let said = |change: &dyn Fn(&mut Capturing)| {
        let mut made = plain.clone();
        change(&mut made);
        let causes = picofarm_calibrate::geometry(&made.capture());
        let all: Vec<_> = causes
            .into_iter()
            .map(|c| (c.fault, c.severity, c.finding))
            .collect();
        all
    };
    assert_eq!(said(&|_| {}), []);
    let millimetres = said(&|c| {
        for place in c.spots.iter_mut().filter_map(|s| s.place.as_mut()) {
            place.point = c.laser + (place.point - c.laser) * 1000.0;
            place.path_m *= 1000.0;
        }
    });
    assert!(
        millimetres.iter().any(|(fault, severity, what)| {
            *fault == Fault::Spots && *severity == Verdict::Wrong && what.contains("16 of 16 spots")
        }),
        "{millimetres:?}"
    );
    let narrow = said(&|c| {
        c.camera.intrinsics = picofarm_scene::Intrinsics::from_fov(1.57, SIDE, SIDE);
    });
    assert!(narrow[0].2.contains("1.57 degrees wide"), "{narrow:?}");
    let outside = said(&|c| c.camera.intrinsics.cx = 500.0);
    assert!(outside[0].2.contains("column 500.0"), "{outside:?}");
}

#[test]
fn pixels_in_shadow_and_padding_are_not_dead() {
    let lit = room().measure(PHOTONS, 1, |s| s.dark_per_bin = 0.2);
    let bins = GATE.bins as usize;
    let cells = lit.per_spot.len() / 16;
    let dark_of = |h: &[f32]| -> Vec<f32> { h[..20].iter().cycle().take(bins).copied().collect() };
    let mut shadow = lit.clone();
    for h in shadow.per_spot.chunks_mut(cells) {
        let own = dark_of(&h[700 * bins..701 * bins]);
        h[700 * bins..701 * bins].copy_from_slice(&own);
        h[900 * bins..901 * bins].fill(0.0);
    }
    shadow.add_up();
    let found = checked(&shadow, None);
    let dead: Vec<f64> = found
        .report
        .causes
        .iter()
        .filter(|c| c.fault == Fault::DeadPixels)
        .map(|c| c.value)
        .collect();
    assert_eq!(dead, [1.0]);
    assert_eq!(found.corrected.source[700], Some(700));
    assert_ne!(found.corrected.source[900], Some(900));
    let mut padded = lit;
    for h in padded.per_spot.chunks_mut(cells) {
        h[..3 * SIDE as usize * bins].fill(0.0);
    }
    padded.add_up();
    let found = checked(&padded, None);
    assert!(!named(&found).contains(&Fault::DeadPixels));
    let note = format!("{} pixels at the edges", 3 * SIDE);
    assert!(
        found.report.notes.iter().any(|n| n.starts_with(&note)),
        "{:?}",
        found.report.notes
    );
}
