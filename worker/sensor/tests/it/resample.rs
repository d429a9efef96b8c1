//! Laws of histograms on another time axis.

use picofarm_sensor::{Resampler, resample};
use picofarm_settings::Gate;
use proptest::prelude::*;

fn gates() -> impl Strategy<Value = Gate> {
    (-2.0..20.0f64, 0.001..0.5f64, 1u32..80).prop_map(|(start_m, bin_width_m, bins)| Gate {
        start_m,
        bin_width_m,
        bins,
    })
}

/// A gate and two pixels of whole photons.
fn counts() -> impl Strategy<Value = (Gate, Vec<f32>)> {
    gates().prop_flat_map(|gate| {
        let pixel =
            proptest::collection::vec((0u32..1000).prop_map(|n| n as f32), 2 * gate.bins as usize);
        (Just(gate), pixel)
    })
}

fn sum(h: &[f32]) -> f64 {
    h.iter().map(|x| f64::from(*x)).sum()
}

proptest! {
    #[test]
    fn no_photon_is_lost_or_made((from, h) in counts(), to in gates(), scale in 0.1..5.0f64) {
        let made = resample(&h, &from, &to, scale).unwrap();
        let (before, after) = (sum(&h), sum(&made.data) + made.outside);
        prop_assert!((before - after).abs() <= 1e-5 * before.max(1.0), "{before} became {after}");
        prop_assert!(made.data.iter().all(|x| *x >= 0.0) && made.outside >= 0.0);
    }

    #[test]
    fn the_same_gate_keeps_every_bit((gate, h) in counts()) {
        let made = resample(&h, &gate, &gate, 1.0).unwrap();
        prop_assert_eq!(&made.data, &h);
        prop_assert_eq!(made.outside, 0.0);
        prop_assert!(Resampler::new(&gate, &gate, 1.0, 0.0).unwrap().is_identity());
    }

    #[test]
    fn wider_bins_are_sums_of_whole_bins((from, h) in counts(), factor in 1u32..6) {
        prop_assume!(from.bins >= factor);
        let to = Gate {
            bin_width_m: from.bin_width_m * f64::from(factor),
            bins: from.bins / factor,
            ..from
        };
        let made = resample(&h, &from, &to, 1.0).unwrap();
        let expected = picofarm_sensor::rebin(&h, from.bins as usize, factor as usize).unwrap();
        prop_assert_eq!(made.data, expected.data);
        let kept = (to.bins * factor) as usize;
        let rest: f64 = h.chunks(from.bins as usize).map(|h| sum(&h[kept..])).sum();
        prop_assert_eq!(made.outside, rest);
    }

    #[test]
    fn a_later_gate_drops_and_counts_whole_bins((from, h) in counts(), first in 0u32..80) {
        prop_assume!(first < from.bins);
        let to = Gate {
            start_m: from.start_m + f64::from(first) * from.bin_width_m,
            bins: from.bins - first,
            ..from
        };
        let made = resample(&h, &from, &to, 1.0).unwrap();
        let kept: Vec<f32> = h.chunks(from.bins as usize).flat_map(|h| h[first as usize..].to_vec()).collect();
        prop_assert_eq!(&made.data, &kept);
        prop_assert_eq!(made.outside, sum(&h) - sum(&kept));
    }

    #[test]
    fn a_scale_that_also_scales_the_gate_keeps_every_bin((from, h) in counts(), scale in 0.1..5.0f64) {
        let to = Gate {
            start_m: from.start_m * scale,
            bin_width_m: from.bin_width_m * scale,
            ..from
        };
        prop_assert_eq!(resample(&h, &from, &to, scale).unwrap().data, h);
    }

    #[test]
    fn the_mean_path_stays((from, h) in counts(), width in 0.01..1.0f64) {
        let photons = sum(&h);
        prop_assume!(photons > 0.0);
        // A gate around all of it.
        let to = Gate {
            start_m: from.start_m - 1.5 * width,
            bin_width_m: width,
            bins: (from.bin_width_m * f64::from(from.bins) / width).ceil() as u32 + 3,
        };
        let mean = |h: &[f32], gate: &Gate| {
            let bins = gate.bins as usize;
            let all = h.iter().enumerate().map(|(at, x)| {
                f64::from(*x) * (gate.start_m + ((at % bins) as f64 + 0.5) * gate.bin_width_m)
            });
            all.sum::<f64>() / sum(h)
        };
        let made = resample(&h, &from, &to, 1.0).unwrap();
        prop_assert_eq!(made.outside, 0.0);
        let off = (mean(&made.data, &to) - mean(&h, &from)).abs();
        prop_assert!(off <= 0.5 * width + 1e-6, "moved by {off} m, bins have {width} m");
    }
}

#[test]
fn unsound_gates_and_scales_are_named() {
    let gate = Gate {
        start_m: 1.0,
        bin_width_m: 0.1,
        bins: 4,
    };
    let none = Gate { bins: 0, ..gate };
    let said = resample(&[0.0; 4], &gate, &none, 1.0)
        .unwrap_err()
        .to_string();
    assert!(
        said.contains("to") && said.contains("positive width"),
        "{said}"
    );
    let said = resample(&[0.0; 4], &gate, &gate, -1.0)
        .unwrap_err()
        .to_string();
    assert!(said.contains("positive scale"), "{said}");
    let said = resample(&[0.0; 5], &gate, &gate, 1.0)
        .unwrap_err()
        .to_string();
    assert!(said.contains("whole number of pixels"), "{said}");
}
