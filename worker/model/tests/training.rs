//! Trainings: they learn, they go on from anywhere to the same bits, and they say what is wrong.

mod common;

use std::sync::Arc;

use burn::tensor::Device;
use common::{plan, scene, scenes, sources};
use picofarm_model::{
    ModelError,
    input::{ShadowVariant, Task},
    scene::Scene,
    train::{Control, Ended, Event, Plan, Sources, Trained, Training},
};
use proptest::prelude::*;

const ALL: [(Task, ShadowVariant); 6] = [
    (Task::Tof, ShadowVariant::Concat),
    (Task::Specular, ShadowVariant::Concat),
    (Task::Shadow, ShadowVariant::Concat),
    (Task::Shadow, ShadowVariant::Difference),
    (Task::Shadow, ShadowVariant::Index),
    (Task::Shadow, ShadowVariant::All),
];

fn whole(plan: &Plan, sources: Sources) -> Trained {
    let mut training = Training::start(plan.clone(), None, sources, &Device::flex()).unwrap();
    let ended = training.run(&mut |_, _| Control::Continue).unwrap();
    assert_eq!(ended, Ended::Finished);
    training.finish()
}

/// Stopped after each of `stops` steps, and gone on from a checkpoint in a new training.
fn stopped(plan: &Plan, stops: &[u64]) -> Trained {
    let device = Device::flex();
    let mut training = Training::start(plan.clone(), None, sources(), &device).unwrap();
    for stop in stops {
        let ended = training.run(&mut |_, event| match event {
            Event::Step { step, .. } if step >= stop => Control::Stop,
            _ => Control::Continue,
        });
        if ended.unwrap() == Ended::Finished {
            break;
        }
        let checkpoint = training.checkpoint();
        training = Training::resume(plan.clone(), &checkpoint, sources(), &device).unwrap();
        assert_eq!(
            training.checkpoint(),
            checkpoint,
            "a checkpoint says all there is"
        );
    }
    training.run(&mut |_, _| Control::Continue).unwrap();
    training.finish()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 8, ..ProptestConfig::default() })]

    #[test]
    fn a_training_stopped_anywhere_gives_the_weights_of_one_that_was_not(which in 0..ALL.len(), stops in prop::collection::vec(1..6u64, 1..4)) {
        let (task, variant) = ALL[which];
        let plan = plan(task, variant);
        let mut stops = stops;
        stops.sort_unstable();
        let (a, b) = (whole(&plan, sources()), stopped(&plan, &stops));
        prop_assert!(a.weights == b.weights, "stopped after {stops:?}");
        prop_assert_eq!(a.history, b.history);
    }
}

#[test]
fn any_number_of_threads_gives_the_same_weights() {
    let plan = plan(Task::Shadow, ShadowVariant::Concat);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| whole(&plan, sources())).weights
    };
    let one = with(1);
    assert!(with(2) == one && with(5) == one);
}

#[test]
fn every_task_is_learned_on_scenes_that_are_easy() {
    for (task, variant) in ALL {
        let plan = Plan {
            epochs: 80,
            augment: false,
            ..plan(task, variant)
        };
        let trained = whole(&plan, sources());
        let (first, last) = (trained.history[0], trained.history[79]);
        assert!(
            last.loss < 0.8 * first.loss,
            "{task:?} {variant:?}: {first:?} {last:?}"
        );
    }
}

#[test]
fn it_ends_early_where_validation_no_longer_improves() {
    let plan = Plan {
        epochs: 1_000,
        early_stop: 3,
        rate: 1e-9,
        ..plan(Task::Tof, ShadowVariant::Concat)
    };
    let trained = whole(&plan, sources());
    assert!(trained.stopped_early && trained.history.len() < 1_000);
}

#[test]
fn scenes_that_are_dark_constant_spiked_or_saturated_give_finite_losses() {
    let hard = [0.0, 1.0, f32::MAX, 1e-38].map(|value| {
        let mut scene = Scene::clone(&scene(1));
        scene.histogram.fill(value);
        if value == 0.0 {
            scene.histogram[5] = 1e9;
        }
        Arc::new(scene)
    });
    for (task, variant) in ALL {
        let sources = Sources {
            train: Arc::new(hard.to_vec()),
            ..sources()
        };
        let trained = whole(&plan(task, variant), sources);
        assert!(
            trained.history.iter().all(|line| line.loss.is_finite()),
            "{task:?}"
        );
    }
}

#[test]
fn a_rate_that_is_far_too_great_ends_with_a_report_and_not_with_nonsense() {
    let plan = Plan {
        rate: 1e38,
        ..plan(Task::Tof, ShadowVariant::Concat)
    };
    let mut training = Training::start(plan, None, sources(), &Device::flex()).unwrap();
    let error = training.run(&mut |_, _| Control::Continue).unwrap_err();
    assert!(matches!(error, ModelError::NotFinite { .. }), "{error}");
    assert!(error.to_string().contains("optimise.rate"), "{error}");
}

#[test]
fn a_decoder_learns_on_a_frozen_encoder_which_stays_as_it_was() {
    let depth = plan(Task::Tof, ShadowVariant::Concat);
    let trained = whole(&depth, sources());
    let mut mirrors = plan(Task::Specular, ShadowVariant::Concat);
    mirrors.net.frozen = true;
    let device = Device::flex();
    let without = Training::start(mirrors.clone(), None, sources(), &device).map(|_| ());
    assert!(without.unwrap_err().to_string().contains("specular.on"));
    let mut training =
        Training::start(mirrors, Some(&trained.weights), sources(), &device).unwrap();
    training.run(&mut |_, _| Control::Continue).unwrap();
    let (before, _) = picofarm_model::weights::read(&trained.weights).unwrap();
    let after = training.learner().parameters().to_named();
    for (name, value) in before {
        if name.ends_with("num_batches_tracked") {
            continue;
        }
        let same = after[&name] == value;
        assert_eq!(same, name.starts_with("encoders."), "{name}");
    }
}

#[test]
fn checkpoints_of_another_plan_or_cut_short_are_refused() {
    let device = Device::flex();
    let plan_a = plan(Task::Tof, ShadowVariant::Concat);
    let training = Training::start(plan_a.clone(), None, sources(), &device).unwrap();
    let checkpoint = training.checkpoint();
    let refused = |plan: Plan, bytes: &[u8]| {
        let training = Training::resume(plan, bytes, sources(), &device);
        training.map(|_| ()).unwrap_err().to_string()
    };
    let other = Plan {
        seed: 6,
        ..plan_a.clone()
    };
    assert!(refused(other, &checkpoint).contains("other settings"));
    let cut = &checkpoint[..checkpoint.len() - 4];
    assert!(refused(plan_a.clone(), cut).contains("no whole safetensors"));
    let weights = training.finish().weights;
    assert!(refused(plan_a, &weights).contains("only weights"));
}

#[test]
fn too_few_scenes_are_refused_with_what_to_change() {
    let plan = Plan {
        batch: 32,
        ..plan(Task::Tof, ShadowVariant::Concat)
    };
    let sources = Sources {
        train: Arc::new(scenes(0, 9)),
        ..sources()
    };
    let error = Training::start(plan, None, sources, &Device::flex())
        .map(|_| ())
        .unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("optimise.batch: a step takes 32 × 2 scenes"),
        "{error}"
    );
}
