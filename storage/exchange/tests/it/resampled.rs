//! Laws of captures on another gate, scale and image.

use picofarm_dataset::{Gate, Intrinsics};
use picofarm_exchange::capture::{Beam, Capture, Origin, Resampling};
use proptest::{prelude::*, strategy::ValueTree};

const SPOTS: usize = 2;

fn total(h: &[f32]) -> f64 {
    h.iter().map(|x| f64::from(*x)).sum()
}

/// Captures of whole photons with at most 5x4 pixels and 12 bins.
fn captures() -> impl Strategy<Value = Capture> {
    (1u32..6, 1u32..5, 1u32..13, 0.0..9.0f64, 0.01..0.3f64).prop_flat_map(
        |(width, height, bins, start_m, bin_width_m)| {
            let len = SPOTS * (width * height * bins) as usize;
            let photons = proptest::collection::vec((0u16..50).prop_map(f32::from), len);
            (photons, 0.0..5.0f32, 0.0..4.0f32).prop_map(move |(all, cx, cy)| {
                let half = all.len() / SPOTS;
                let sum = (0..half).map(|at| all[at] + all[half + at]).collect();
                Capture {
                    name: "made".into(),
                    height,
                    width,
                    gate: Gate {
                        start_m,
                        bin_width_m,
                        bins,
                    },
                    sum,
                    per_spot: Some(all),
                    intrinsics: Intrinsics {
                        fx: 4.0,
                        fy: 4.0,
                        cx,
                        cy,
                    },
                    laser: [0.1, 0.0, 0.0],
                    beams: vec![
                        Beam::Spot {
                            position: [0.0, 0.0, 2.0],
                            path_m: 2.1,
                        },
                        Beam::Direction([0.0, 0.0, 1.0]),
                    ],
                    depth: Some(vec![2.0; (width * height) as usize]),
                    origin: Origin::default(),
                }
            })
        },
    )
}

proptest! {
    #[test]
    fn nothing_asked_changes_nothing_to_the_bit(capture in captures()) {
        prop_assert_eq!(capture.resampled(&Resampling::default()).unwrap(), capture);
    }

    #[test]
    fn photons_are_kept_or_counted_as_outside_or_cropped(
        capture in captures(), start in -1.0..10.0f64, width in 0.01..0.5f64, bins in 1u32..40,
        scale in 0.2..3.0f64, pad in 0u32..4, centre in any::<bool>(),
    ) {
        let crop = [capture.width / 3, 0, capture.width - capture.width / 3, capture.height.div_ceil(2)];
        let to = Resampling {
            start_m: Some(start), bin_width_m: Some(width), bins: Some(bins), scale,
            crop: Some(crop), pad: [pad, 0, 1, pad], centre,
        };
        let made = capture.resampled(&to).unwrap();
        let lost = made.origin.outside + made.origin.cropped;
        let (before, after) = (total(&capture.sum), total(&made.sum) + lost);
        prop_assert!((before - after).abs() <= 1e-4 * before.max(1.0), "{before} became {after}");
        prop_assert_eq!(made.sum.len(), (made.width * made.height * made.gate.bins) as usize);
        let apart = total(made.per_spot.as_deref().unwrap());
        prop_assert!((apart - total(&made.sum)).abs() <= 1e-4 * apart.max(1.0));
    }

    #[test]
    fn a_crop_alone_puts_nothing_outside_the_gate(capture in captures()) {
        let crop = Some([0, 0, capture.width, capture.height.div_ceil(2)]);
        let made = capture.resampled(&Resampling { crop, ..Resampling::default() }).unwrap();
        prop_assert_eq!(made.origin.outside, capture.origin.outside);
        let lost = made.origin.cropped - capture.origin.cropped;
        prop_assert!((total(&made.sum) + lost - total(&capture.sum)).abs() <= 1e-3);
    }

    #[test]
    fn dark_borders_cut_off_again_leave_the_capture(capture in captures(), pad in proptest::array::uniform4(0u32..5)) {
        let wide = capture.resampled(&Resampling { pad, ..Resampling::default() }).unwrap();
        prop_assert_eq!(total(&wide.sum), total(&capture.sum));
        let back = Resampling { crop: Some([pad[0], pad[1], capture.width, capture.height]), ..Resampling::default() };
        let mut back = wide.resampled(&back).unwrap();
        prop_assert_eq!((back.origin.outside, back.origin.cropped), (0.0, 0.0));
        // The principal point moved there and back in 32 bits.
        prop_assert!((back.intrinsics.cx - capture.intrinsics.cx).abs() < 1e-4);
        prop_assert!((back.intrinsics.cy - capture.intrinsics.cy).abs() < 1e-4);
        back.intrinsics = capture.intrinsics;
        back.origin = capture.origin.clone();
        prop_assert_eq!(back, capture);
    }

    #[test]
    fn a_centred_capture_has_the_axis_in_the_middle(capture in captures()) {
        let made = capture.resampled(&Resampling { centre: true, ..Resampling::default() }).unwrap();
        prop_assert!((f64::from(made.intrinsics.cx) - f64::from(made.width) / 2.0).abs() <= 0.51);
        prop_assert!((f64::from(made.intrinsics.cy) - f64::from(made.height) / 2.0).abs() <= 0.51);
        prop_assert_eq!(total(&made.sum), total(&capture.sum));
    }

    #[test]
    fn a_scale_keeps_every_bin_and_scales_every_length(capture in captures(), scale in 0.2..3.0f64) {
        let made = capture.resampled(&Resampling { scale, ..Resampling::default() }).unwrap();
        prop_assert_eq!(made.origin.conversions.last(), Some(&format!("resampled: scale {scale}")));
        prop_assert_eq!(&made.sum, &capture.sum);
        prop_assert_eq!(made.gate.bins, capture.gate.bins);
        let hundredth = made.gate.bin_width_m / 100.0;
        prop_assert!((made.gate.end_m() - capture.gate.end_m() * scale).abs() < hundredth);
        prop_assert_eq!(made.laser[0], capture.laser[0] * scale as f32);
        prop_assert_eq!(made.depth.unwrap()[0], 2.0 * scale as f32);
    }
}

#[test]
fn a_window_outside_the_image_and_an_empty_gate_are_named() {
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let capture = captures().new_tree(&mut runner).unwrap().current();
    let outside = Resampling {
        crop: Some([0, 0, capture.width + 1, 1]),
        ..Resampling::default()
    };
    let said = capture.resampled(&outside).unwrap_err().to_string();
    assert!(said.contains("crop"), "{said}");
    let late = Resampling {
        start_m: Some(1e3),
        ..Resampling::default()
    };
    let said = capture.resampled(&late).unwrap_err().to_string();
    assert!(
        said.contains("bins") && said.contains("the light is between"),
        "{said}"
    );
}
