//! Optional parts of an optimiser step: limited gradients, an average of the weights, cycles.

use crate::common;

use burn::tensor::Device;
use common::{plan, scenes, sources};
use picofarm_model::{
    Model,
    baseline::Baseline,
    evaluate,
    input::{ShadowVariant, Target},
    parameters::Named,
    train::{Control, Ended, Event, Plan, Schedule, Trained, Training, left_by},
    weights,
};

fn steady() -> Plan {
    Plan {
        schedule: Schedule::Constant,
        decay: 0.0,
        ..plan(Target::Tof, ShadowVariant::Concat)
    }
}

fn begun(plan: &Plan) -> Training {
    Training::start(plan.clone(), None, sources(), &Device::flex()).unwrap()
}

/// Returns a training, stopped after the given number of steps.
fn stopped_after(plan: &Plan, steps: u64) -> Training {
    let mut training = begun(plan);
    let ended = training.run(&mut |_, event| match event {
        Event::Step { step, .. } if *step >= steps => Control::Stop,
        _ => Control::Continue,
    });
    assert_eq!(ended.unwrap(), Ended::Stopped);
    training
}

fn whole(plan: &Plan) -> Trained {
    let mut training = begun(plan);
    training.run(&mut |_, _| Control::Continue).unwrap();
    training.finish()
}

/// Returns the norm of the first step's gradient over all parameters, computed from AdamW's first
/// moment, which is a tenth of it.
fn norm_of_first_step(plan: &Plan) -> f64 {
    let checkpoint = stopped_after(plan, 1).checkpoint();
    let (tensors, _) = weights::read(&checkpoint).unwrap();
    let moments = tensors
        .iter()
        .filter(|(name, _)| name.starts_with("adamw.m/"));
    let squares = moments.flat_map(|(_, (_, values))| values);
    let squares: f64 = squares.map(|m| (f64::from(*m) / 0.1).powi(2)).sum();
    squares.sqrt()
}

#[test]
fn gradients_are_shortened_to_the_norm_and_shorter_ones_stay_to_the_bit() {
    let free = steady();
    let norm = norm_of_first_step(&free);
    for share in [0.01, 0.5, 0.99] {
        let clipped = Plan {
            clip_norm: Some(share * norm),
            ..free.clone()
        };
        let found = norm_of_first_step(&clipped);
        assert!(
            (found / (share * norm) - 1.0).abs() < 1e-5,
            "{found} of {norm}"
        );
    }
    let loose = Plan {
        clip_norm: Some(100.0 * norm),
        ..free.clone()
    };
    let numbers = |plan: &Plan| stopped_after(plan, 5).learner().parameters().to_named();
    assert_eq!(numbers(&free), numbers(&loose));
}

#[test]
fn an_average_follows_the_weights_is_judged_and_kept_and_goes_on_to_the_same_bits() {
    let averaged = Plan {
        epochs: 4,
        ema: Some(0.8),
        ..steady()
    };
    let mut numbers: Vec<Named> = vec![begun(&averaged).learner().parameters().to_named()];
    let mut training = begun(&averaged);
    training
        .run(&mut |training, event| {
            if let Event::Step { .. } = event {
                numbers.push(training.learner().parameters().to_named());
            }
            Control::Continue
        })
        .unwrap();
    let expected = numbers.iter().enumerate().skip(1).fold(
        numbers[0].clone(),
        |mut average, (step, numbers)| {
            let step = step as f64;
            let decay = f64::min(0.8, (1.0 + step) / (10.0 + step)) as f32;
            for (name, (_, values)) in &mut average {
                for (value, new) in values.iter_mut().zip(&numbers[name].1) {
                    *value = *value * decay + *new * (1.0 - decay);
                }
            }
            average
        },
    );
    let last = numbers.last().unwrap();
    let kept = training.learner().kept().to_named();
    let mut apart = 0.0f32;
    for (name, (_, values)) in &kept {
        for (i, value) in values.iter().enumerate() {
            let expected = expected[name].1[i];
            assert!(
                (value - expected).abs() <= 1e-5 * expected.abs().max(1e-2),
                "{name}"
            );
            apart = apart.max((value - last[name].1[i]).abs());
        }
    }
    assert!(apart > 1e-4, "the average is the last weights");
    let trained = training.finish();
    // The last epoch's validation metrics are those of the stored weights.
    let scenes = scenes(100, 3);
    let model = Model::read(&trained.weights, &Device::flex()).unwrap();
    let baseline =
        Baseline::fit(&plan(Target::Tof, ShadowVariant::All).question, &scenes, 3).unwrap();
    let found = evaluate(&model, &baseline, &scenes, &mut |_, _| true);
    let found = found.unwrap().unwrap().metrics.loss();
    let said = trained.history[3].validation.unwrap().loss();
    assert!((found - said).abs() < 1e-6, "{found} {said}");
    // The training is stopped in the middle.
    let checkpoint = stopped_after(&averaged, 3).checkpoint();
    let mut again = Training::resume(
        averaged,
        &[checkpoint.as_slice()],
        sources(),
        &Device::flex(),
    )
    .unwrap();
    assert_eq!(again.checkpoint(), checkpoint);
    again.run(&mut |_, _| Control::Continue).unwrap();
    let (left, _) = left_by(&[again.checkpoint()]).unwrap();
    let again = again.finish();
    assert!(again.weights == trained.weights && left == trained.weights);
    assert_eq!(again.history, trained.history);
}

#[test]
fn rates_begin_again_after_each_cycle() {
    let cycles = Plan {
        epochs: 7,
        schedule: Schedule::Restarts,
        restarts: Some((1, 2)),
        ..steady()
    };
    // With two steps an epoch, the cycles have 2, 4 and 8 steps. A line contains the rate of its
    // epoch's last step.
    let rates: Vec<f64> = whole(&cycles)
        .history
        .iter()
        .map(|line| line.learning_rate / cycles.learning_rate)
        .collect();
    let half = |at: f64, of: f64| (1.0 + (std::f64::consts::PI * at / of).cos()) / 2.0;
    let expected = [
        half(1.0, 2.0),
        half(1.0, 4.0),
        half(3.0, 4.0),
        half(1.0, 8.0),
        half(3.0, 8.0),
        half(5.0, 8.0),
        half(7.0, 8.0),
    ];
    for (rate, expected) in rates.iter().zip(expected) {
        assert!((rate - expected).abs() < 1e-12, "{rates:?}");
    }
}

#[test]
fn values_that_no_run_can_have_are_named() {
    for (plan, field) in [
        (
            Plan {
                clip_norm: Some(-1.0),
                ..steady()
            },
            "optimise.clip_norm",
        ),
        (
            Plan {
                ema: Some(1.0),
                ..steady()
            },
            "optimise.ema",
        ),
        (
            Plan {
                schedule: Schedule::Restarts,
                ..steady()
            },
            "optimise.restarts",
        ),
        (
            Plan {
                restarts: Some((1, 2)),
                ..steady()
            },
            "optimise.restarts",
        ),
    ] {
        let error = Training::start(plan, None, sources(), &Device::flex());
        let error = error.err().unwrap().to_string();
        assert!(error.contains(field), "{error}");
    }
}
