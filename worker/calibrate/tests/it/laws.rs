//! What must hold for captures whose calibration is known.

use std::sync::OnceLock;

use picofarm_calibrate::{Checked, Fault, Measurement, Verdict, check};

use crate::common::{self, Capturing, GATE, Room};

pub const SIDE: u32 = 48;
pub const PHOTONS: f64 = 100.0;

/// A furnished room, rendered once.
pub fn room() -> &'static Room {
    static ROOM: OnceLock<Room> = OnceLock::new();
    ROOM.get_or_init(|| Room::new(7, SIDE, 0))
}

pub fn checked(capture: &Capturing, masks: Option<&[u8]>) -> Checked {
    check(&Measurement {
        capture: capture.capture(),
        per_spot: Some(&capture.per_spot),
        masks,
        pulses: None,
    })
    .expect("a capture")
}

pub fn named(checked: &Checked) -> Vec<Fault> {
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
            let made = checked(&capture, None);
            let (found, causes) = (made.corrected, made.report.causes);
            let late = (found.gate.start_m - GATE.start_m) / GATE.bin_width_m;
            let off = (found.laser - room.laser).length();
            assert!(
                late.abs() < 0.1,
                "seed {seed}, {name}: t0 is {late} bins off: {causes:?}"
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
