//! Captures that no correction covers, impossible geometry, shadows, padding and wide pulses.

use picofarm_calibrate::{Fault, Measurement, Verdict, check};
use picofarm_scene::Intrinsics;
use picofarm_settings::{Gate, Pulse};

use crate::{
    common::{self, Capturing, GATE, Room},
    laws::{PHOTONS, SIDE, checked, named, room},
};

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
        c.camera.intrinsics = Intrinsics::from_fov(1.57, SIDE, SIDE);
    });
    let shifted = disturbed(&|c| {
        c.camera.intrinsics.cx = 0.2 * side;
        c.camera.intrinsics.cy = 0.7 * side;
    });
    let corner = disturbed(&|c| {
        c.camera.intrinsics.cx -= 0.7;
        c.camera.intrinsics.cy -= 0.7;
        c.gate.start_m += GATE.bin_width_m;
    });
    let late = disturbed(&|c| c.gate.start_m -= 20_000.0 / picofarm_sensor::PS_PER_M);
    let cases = [
        ("spots behind the camera", behind),
        ("fov in radians", radians),
        ("another principal point", shifted),
        ("pixels counted from their corners", corner),
        ("t0 20 ns late", late),
    ];
    for (name, capture) in cases {
        let found = checked(&capture, None);
        assert_eq!(found.report.verdict, Verdict::Wrong, "{name}");
        assert!(found.report.unexplained(), "{name}");
        assert!(found.report.guesses.iter().all(|g| !g.corrected), "{name}");
        assert_eq!(found.corrected.gate, capture.gate, "{name}");
        assert_eq!(found.corrected.laser, capture.laser, "{name}");
        assert_eq!(found.corrected.camera, capture.camera, "{name}");
        assert_eq!(found.corrected.spots, capture.spots, "{name}");
    }
}

/// Verdicts on all [`common::doubts`] of a room of 32×32 pixels: name, verdict, whether the
/// calibration is right.
fn verdicts(
    spots: u32,
    rebin: u32,
    photons: f64,
    apart: bool,
) -> Vec<(String, Verdict, Option<bool>)> {
    let fine = Gate {
        start_m: 1.0,
        bin_width_m: 0.012,
        bins: 1024,
    };
    let room = Room::in_gate(7, 32, 0, spots, fine);
    let plain = room.measure_in(rebin, photons, 1, |_| {});
    let verdict = |(name, capture, right): (&str, Capturing, Option<bool>)| {
        let found = check(&Measurement {
            capture: capture.capture(),
            per_spot: apart.then_some(&capture.per_spot),
            masks: None,
            pulses: None,
        });
        let report = found.expect("a capture").report;
        let what = format!("{spots} spots, {rebin} bins, {photons} photons, {name}: {report:?}");
        (what, report.verdict, right)
    };
    common::doubts(&plain, apart)
        .into_iter()
        .map(verdict)
        .collect()
}

#[test]
fn right_calibrations_are_never_wrong_and_wrong_ones_never_good_however_little_is_seen() {
    for spots in [1, 4, 16] {
        for (rebin, photons) in [(1, 100.0), (3, 3.0), (8, 100.0)] {
            for apart in [true, false] {
                for (what, verdict, right) in verdicts(spots, rebin, photons, apart) {
                    match right {
                        Some(true) => assert_ne!(verdict, Verdict::Wrong, "{what}"),
                        Some(false) => assert_ne!(verdict, Verdict::Good, "{what}"),
                        None => assert_eq!(verdict, Verdict::CannotTell, "{what}"),
                    }
                }
            }
        }
    }
}

#[test]
fn what_is_missing_is_named_with_its_figure() {
    let room = Room::in_gate(7, 32, 0, 4, GATE);
    let found = checked(&room.measure_in(1, PHOTONS, 1, |_| {}), None);
    assert_eq!(found.report.verdict, Verdict::CannotTell);
    assert_eq!(named(&found), [Fault::Evidence]);
    let finding = &found.report.causes[0].finding;
    assert!(
        finding.contains("4 spots") && finding.contains("at least 9"),
        "{finding}"
    );
    assert!(found.report.unexplained());
}

#[test]
fn two_spots_with_one_file_are_named() {
    let mut capture = room().measure(PHOTONS, 1, |_| {});
    let cells = capture.per_spot.len() / 16;
    capture
        .per_spot
        .copy_within(2 * cells..3 * cells, 5 * cells);
    capture.add_up();
    let found = checked(&capture, None);
    let equal = found
        .report
        .causes
        .iter()
        .find(|c| c.fault == Fault::EqualHistograms);
    let equal = equal.expect("named");
    assert!(equal.finding.contains("spots 2 and 5"), "{}", equal.finding);
    assert_eq!(found.report.verdict, Verdict::Wrong);
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
        c.camera.intrinsics = Intrinsics::from_fov(1.57, SIDE, SIDE);
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

#[test]
fn a_pulse_of_many_bins_is_measured_and_moves_nothing() {
    // A pulse of 206 ps in bins of 32 ps.
    let mut wide = room().measure(PHOTONS, 1, |s| {
        s.rebin = 1;
        s.pulse = Pulse::Analytic { fwhm_ps: 200.0 };
    });
    wide.gate.bin_width_m /= 4.0;
    wide.gate.bins *= 4;
    let found = checked(&wide, None);
    assert_eq!(named(&found), [], "{:?}", found.report.causes);
    let fwhm = found.report.pulse.expect("returns").fwhm_ps;
    assert!((190.0..250.0).contains(&fwhm), "{fwhm} ps");
    assert_eq!(found.corrected.gate, wide.gate);
    let mut late = wide;
    late.gate.start_m += 0.05;
    let corrected = checked(&late, None).corrected.gate;
    assert_eq!(corrected.bins, late.gate.bins);
    let off = corrected.start_m - GATE.start_m;
    assert!(off.abs() < 0.01, "{off} m");
}

/// Returns the first bins of a capture.
fn shortened(of: &Capturing, keep: usize) -> Capturing {
    let bins = of.gate.bins as usize;
    let mut made = of.clone();
    let kept = of.per_spot.chunks(bins).flat_map(|h| &h[..keep]);
    made.per_spot = kept.copied().collect();
    made.gate.bins = keep as u32;
    made.add_up();
    made
}

#[test]
fn a_right_calibration_in_a_gate_that_cuts_the_light_is_not_called_wrong() {
    let plain = room().measure(PHOTONS, 1, |_| {});
    let dark = room().measure(PHOTONS, 1, |s| s.dark_per_bin = 0.05);
    for (whole, keep) in [(&plain, 130), (&plain, 110), (&plain, 75), (&dark, 130)] {
        let found = checked(&shortened(whole, keep), None);
        let report = &found.report;
        assert_eq!(report.verdict, Verdict::CannotTell, "{keep}: {report:?}");
        let reason = report.causes.iter().find(|c| c.fault == Fault::Evidence);
        let reason = &reason.expect("a reason").finding;
        assert!(reason.contains("the gate cuts the light"), "{reason}");
        assert!(report.unexplained());
    }
    // Enough light tells all the same.
    let found = checked(&shortened(&plain, 250), None);
    assert_eq!(named(&found), []);
    let mut moved = shortened(&plain, 250);
    let stated = moved.laser;
    moved.laser += moved.camera.right * 0.1;
    for place in moved.spots.iter_mut().filter_map(|s| s.place.as_mut()) {
        let way = (place.point - moved.laser).length() - (place.point - stated).length();
        place.path_m += way;
    }
    assert_eq!(named(&checked(&moved, None)), [Fault::Laser]);
}

#[test]
fn a_near_object_is_not_hot_and_few_counts_can_be_clipped() {
    let plain = room().measure(PHOTONS, 1, |s| s.dark_per_bin = 0.02);
    let bins = GATE.bins as usize;
    let pixels = (SIDE * SIDE) as usize;
    let mut near = plain.clone();
    for (n, h) in near.per_spot.chunks_mut(bins).enumerate() {
        // Its light comes before that of everything else, and nothing after it.
        if (400..420).contains(&(n % pixels)) {
            h.rotate_left(60);
            h[bins - 60..].fill(0.0);
            h[8] += 60.0;
            h[9] += 30.0;
        }
    }
    near.add_up();
    assert!(!named(&checked(&near, None)).contains(&Fault::HotPixels));
    let mut clipped = plain.clone();
    clipped.per_spot.iter_mut().for_each(|x| *x = x.min(63.0));
    clipped.add_up();
    assert!(named(&checked(&clipped, None)).contains(&Fault::Clipped));
    let few = room().measure(5.0, 1, |_| {});
    assert!(!named(&checked(&few, None)).contains(&Fault::Clipped));
}

#[test]
fn pixels_that_see_nothing_are_not_dead_without_noise() {
    let mut light = room().measure(PHOTONS, 1, |s| s.poisson = false);
    let bins = GATE.bins as usize;
    for (n, h) in light.per_spot.chunks_mut(bins).enumerate() {
        let (u, v) = (n % SIDE as usize, n / SIDE as usize % SIDE as usize);
        if (5..40).contains(&u) && (8..30).contains(&v) {
            h.fill(0.0);
        }
    }
    light.add_up();
    let found = checked(&light, None);
    let dead = found.report.causes.iter();
    let dead: Vec<_> = dead.filter(|c| c.fault == Fault::DeadPixels).collect();
    assert!(
        matches!(&*dead, [c] if c.severity == Verdict::Usable),
        "{dead:?}"
    );
}
