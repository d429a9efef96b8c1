//! Unusable input is refused by name; input with little information gives a defined result; there
//! is never NaN.

use burn::tensor::Device;
use picofarm_reconstruct::{Measured, Unwatched};

use super::{room, small};
use crate::{
    Settings, ShadowLoss, Training,
    loss::Stage,
    rays::Pool,
    training::{State, gradients},
};

fn refused(measured: Measured, settings: Settings) -> String {
    Training::begin(measured, settings).unwrap_err().to_string()
}

/// Runs a fit and returns its notes.
fn fits(measured: Measured, settings: Settings) -> Vec<String> {
    let mut training = Training::begin(measured, settings).unwrap();
    assert!(training.run(&Unwatched).unwrap());
    let state = training.state();
    assert!(state.loss.is_finite());
    assert!(state.weights.iter().flatten().all(|w| w.is_finite()));
    training.notes()
}

#[test]
fn settings_out_of_range_are_named() {
    let s = small();
    assert!(refused(room(), Settings { width: 0, ..s }).starts_with("width: is 0"));
    assert!(refused(room(), Settings { coarse: 2, ..s }).starts_with("coarse: is 2"));
    assert!(refused(room(), Settings { batch: 0, ..s }).starts_with("batch: is 0"));
    assert!(refused(room(), s.with_steps(0)).starts_with("steps: is 0"));
    assert!(refused(room(), Settings { near_m: 7.0, ..s }).starts_with("near_m: is 7 m"));
    assert!(
        refused(
            room(),
            Settings {
                scale_m: f32::NAN,
                ..s
            }
        )
        .starts_with("scale_m: is NaN")
    );
}

#[test]
fn no_lit_ray_is_refused() {
    let mut dark = room();
    dark.lit.fill(0);
    assert!(refused(dark, small()).contains("no pixel is lit"));
}

#[test]
fn masks_without_shadow_and_one_spot_give_a_note_and_no_nan() {
    for shadow_loss in [ShadowLoss::Squares, ShadowLoss::CrossEntropy] {
        let settings = Settings {
            shadow_loss,
            ..small()
        };
        let mut bright = room();
        for (q, lit) in bright.lit.iter_mut().enumerate() {
            if *lit == 0 {
                (*lit, bright.tau[q]) = (1, 5.0);
            }
        }
        assert!(fits(bright, settings)[0].contains("no pixel is in shadow"));
        let mut one = room();
        one.spots.truncate(1);
        for values in [&mut one.lit, &mut one.used] {
            values.truncate(256);
        }
        one.tau.truncate(256);
        assert!(fits(one, settings)[0].contains("one spot"));
    }
}

#[test]
fn a_batch_without_lit_or_without_shadowed_rays_has_a_finite_gradient() {
    let (pool, _) = Pool::new(room()).unwrap();
    for of_lit in [1.0, 0.0] {
        let mut batch = pool.batch(false, 0, 0, 40);
        batch.lit.fill(of_lit);
        let weights = State::begin(&small(), 0).weights;
        let device = Device::flex();
        let found = gradients(
            &small(),
            Stage::Shadow,
            &weights,
            &batch,
            0,
            &device,
            &|_| true,
        );
        let (loss, gradient) = found.unwrap();
        assert!(loss.is_finite() && gradient.iter().flatten().all(|g| g.is_finite()));
    }
}

#[test]
fn a_dead_start_is_drawn_anew() {
    // Some seeds start with a network that has no density on any ray.
    let drawn = (0..12).map(|seed| {
        let settings = Settings {
            seed,
            distance_steps: 1,
            shadow_steps: 0,
            ..small()
        };
        let mut training = Training::begin(room(), settings).unwrap();
        assert!(training.run(&Unwatched).unwrap());
        let dead = |m: &picofarm_reconstruct::saved::Moments| m.first.iter().all(|g| *g == 0.0);
        assert!(
            !training.state().moments.iter().any(dead),
            "seed {seed} learns"
        );
        let draw = training.state().draw;
        assert_eq!(
            draw > 0,
            training.notes().iter().any(|n| n.contains("drawn anew"))
        );
        draw
    });
    let drawn: Vec<u32> = drawn.collect();
    assert!(
        drawn.iter().any(|d| *d > 0) && drawn.contains(&0),
        "{drawn:?}"
    );
}
