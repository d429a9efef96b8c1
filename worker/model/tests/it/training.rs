//! Trainings: they learn, resume anywhere with the same bits, and report errors.

use crate::common;

use std::sync::Arc;

use burn::tensor::Device;
use common::{plan, scene, scenes, sources};
use picofarm_model::{
    ModelError,
    baseline::Baseline,
    input::{ShadowVariant, Target},
    scene::Scene,
    train::{Control, Ended, Event, Plan, Sources, Trained, Training, epochs_at},
};
use proptest::prelude::*;

const ALL: [(Target, ShadowVariant); 7] = [
    (Target::Tof, ShadowVariant::Concat),
    (Target::Specular, ShadowVariant::Concat),
    (Target::Shadow, ShadowVariant::Concat),
    (Target::Shadow, ShadowVariant::Difference),
    (Target::Shadow, ShadowVariant::Index),
    (Target::Shadow, ShadowVariant::All),
    (Target::Shadow, ShadowVariant::Evidence),
];

fn whole(plan: &Plan, sources: Sources) -> Trained {
    let mut training = Training::start(plan.clone(), None, sources, &Device::flex()).unwrap();
    let ended = training.run(&mut |_, _| Control::Continue).unwrap();
    assert_eq!(ended, Ended::Finished);
    training.finish()
}

/// Returns the result of a training that is stopped after each of `stops` steps and resumed from a
/// checkpoint.
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
        training =
            Training::resume(plan.clone(), &[checkpoint.as_slice()], sources(), &device).unwrap();
        assert_eq!(
            training.checkpoint(),
            checkpoint,
            "a checkpoint says all there is"
        );
    }
    training.run(&mut |_, _| Control::Continue).unwrap();
    training.finish()
}

/// Returns weights without the plan in their metadata.
fn plain(weights: &[u8]) -> Vec<(String, Vec<u8>)> {
    let tensors = safetensors::SafeTensors::deserialize(weights).unwrap();
    let named = tensors
        .iter()
        .map(|(name, view)| (name.to_owned(), view.data().to_vec()));
    let mut named: Vec<_> = named.collect();
    named.sort();
    named
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 8, ..ProptestConfig::default() })]

    #[test]
    fn a_training_stopped_anywhere_gives_the_weights_of_one_that_was_not(which in 0..ALL.len(), stops in prop::collection::vec(1..6u64, 1..4)) {
        let (target, variant) = ALL[which];
        let plan = plan(target, variant);
        let mut stops = stops;
        stops.sort_unstable();
        let (a, b) = (whole(&plan, sources()), stopped(&plan, &stops));
        prop_assert!(a.weights == b.weights, "stopped after {stops:?}");
        prop_assert_eq!(a.history, b.history);
    }
}

#[test]
fn any_number_of_threads_gives_the_same_weights() {
    let plan = plan(Target::Shadow, ShadowVariant::Concat);
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
    for (target, variant) in ALL {
        let plan = Plan {
            epochs: 80,
            augment: false,
            ..plan(target, variant)
        };
        let trained = whole(&plan, sources());
        let (first, last) = (trained.history[0], trained.history[79]);
        assert!(
            last.loss < 0.8 * first.loss,
            "{target:?} {variant:?}: {first:?} {last:?}"
        );
    }
}

/// Stops a training after the given number of epochs. Returns its weights and history.
fn after(plan: &Plan, epochs: u64) -> (Vec<u8>, Vec<picofarm_model::train::Line>) {
    let mut training = Training::start(plan.clone(), None, sources(), &Device::flex()).unwrap();
    let mut history = Vec::new();
    training
        .run(&mut |_, event| match event {
            Event::Epoch(line) => {
                history.push(*line);
                if line.epoch == epochs {
                    Control::Stop
                } else {
                    Control::Continue
                }
            }
            Event::Step { .. } | Event::Validated(_) => Control::Continue,
        })
        .unwrap();
    (training.finish().weights, history)
}

#[test]
fn it_ends_early_where_validation_no_longer_improves() {
    let plan = Plan {
        epochs: 1_000,
        early_stop: 3,
        learning_rate: 1e-9,
        ..plan(Target::Tof, ShadowVariant::Concat)
    };
    let trained = whole(&plan, sources());
    assert!(trained.stopped_early && trained.history.len() < 1_000);
}

#[test]
fn with_early_stop_the_weights_of_the_best_epoch_are_kept_and_not_the_last() {
    // With such large steps, training soon passes its best point.
    let plan = Plan {
        epochs: 60,
        early_stop: 4,
        learning_rate: 0.2,
        schedule: picofarm_model::train::Schedule::Constant,
        ..plan(Target::Tof, ShadowVariant::Concat)
    };
    let trained = whole(&plan, sources());
    let loss = |line: &picofarm_model::train::Line| line.validation.unwrap().loss();
    let best = trained
        .history
        .iter()
        .map(loss)
        .fold(f64::INFINITY, f64::min);
    let kept = trained.kept().unwrap();
    assert_eq!(loss(kept), best);
    assert!(trained.stopped_early, "{:?}", trained.history.len());
    assert_eq!(kept.epoch + 4, trained.history.len() as u64);
    // Their metrics on the validation scenes are those of that epoch.
    let model = picofarm_model::Model::read(&trained.weights, &Device::flex()).unwrap();
    let scenes = scenes(100, 3);
    let baseline = Baseline::fit(&plan.question, &scenes, 3).unwrap();
    let found = picofarm_model::evaluate(&model, &baseline, &scenes, &mut |_, _| true);
    let found = found.unwrap().unwrap().metrics.loss();
    assert!((found - best).abs() < 1e-6, "{found} {best}");
    // A training resumed from a checkpoint after the best one retains them too.
    let device = Device::flex();
    let mut training = Training::start(plan.clone(), None, sources(), &device).unwrap();
    let past = kept.epoch + 2;
    let stopped = training.run(&mut |_, event| match event {
        Event::Epoch(line) if line.epoch == past => Control::Stop,
        _ => Control::Continue,
    });
    assert_eq!(stopped.unwrap(), Ended::Stopped);
    let checkpoint = training.checkpoint();
    let mut training =
        Training::resume(plan.clone(), &[checkpoint.as_slice()], sources(), &device).unwrap();
    assert_eq!(training.checkpoint(), checkpoint);
    training.run(&mut |_, _| Control::Continue).unwrap();
    let (left, history) = picofarm_model::train::left_by(&[training.checkpoint()]).unwrap();
    let again = training.finish();
    assert!(left == again.weights && history == again.history);
    assert!(again.weights == trained.weights && again.kept_step == trained.kept_step);
    // Without early_stop, the result is the last weights.
    let (last, history) = after(
        &Plan {
            early_stop: 0,
            ..plan
        },
        past,
    );
    assert_eq!(history[..], trained.history[..past as usize]);
    assert!(last != trained.weights);
}

#[test]
fn a_validation_within_an_epoch_is_a_line_and_moves_no_bit() {
    let every = |validate_every| Plan {
        epochs: 4,
        batch: 1,
        validate_every,
        ..plan(Target::Tof, ShadowVariant::Concat)
    };
    let often = whole(&every(3), sources());
    let seldom = whole(&every(0), sources());
    assert!(plain(&often.weights) == plain(&seldom.weights));
    let per_epoch = seldom.history[0].step;
    assert!(!per_epoch.is_multiple_of(3), "{per_epoch}");
    // Every third step, and the end of each epoch.
    let due = |step: &u64| step.is_multiple_of(3) || step.is_multiple_of(per_epoch);
    let due: Vec<u64> = (1..=4 * per_epoch).filter(due).collect();
    let steps: Vec<u64> = often.history.iter().map(|line| line.step).collect();
    assert_eq!(steps, due);
    let (mut sums, mut last) = (0.0, 0);
    for line in &often.history {
        assert_eq!(line.epoch, (line.step - 1) / per_epoch + 1);
        assert_eq!(line.within, !line.step.is_multiple_of(per_epoch));
        assert!(line.validation.is_some());
        sums += line.loss * (line.step - last) as f64;
        last = line.step;
        if !line.within {
            // A whole epoch's loss is the mean over its parts, and its validation is unchanged.
            let whole = &seldom.history[line.epoch as usize - 1];
            assert!((sums / per_epoch as f64 - whole.loss).abs() < 1e-9);
            assert_eq!(line.validation, whole.validation);
            sums = 0.0;
        }
    }
    // A training interrupted anywhere, before and after a line, gives the same result.
    let cut = stopped(&every(3), &(1..4 * per_epoch).collect::<Vec<_>>());
    assert!(cut.history == often.history && cut.weights == often.weights);
    let at: Vec<f64> = epochs_at(&often.history).map(|(at, _)| at).collect();
    assert!(at.is_sorted() && at.last() == Some(&4.0), "{at:?}");
}

#[test]
fn early_stop_counts_validations_within_epochs() {
    let plan = Plan {
        epochs: 1_000,
        batch: 1,
        validate_every: 1,
        early_stop: 3,
        learning_rate: 0.2,
        schedule: picofarm_model::train::Schedule::Constant,
        ..plan(Target::Tof, ShadowVariant::Concat)
    };
    let trained = whole(&plan, sources());
    assert!(trained.stopped_early);
    let kept = trained.kept().unwrap();
    let last = trained.history.last().unwrap();
    assert_eq!(last.step, kept.step + 3);
    let best = trained
        .history
        .iter()
        .map(|line| line.validation.unwrap().loss());
    assert_eq!(
        kept.validation.unwrap().loss(),
        best.fold(f64::INFINITY, f64::min)
    );
    let cut = stopped(&plan, &(1..last.step).collect::<Vec<_>>());
    assert!(cut.history == trained.history && cut.weights == trained.weights);
    assert_eq!(cut.kept_step, trained.kept_step);
}

#[test]
fn parts_of_a_step_give_the_bits_that_they_gave_together() {
    let device = Device::flex();
    let (mut one, batch) = trial(5).begin(&device).unwrap();
    let (_, other) = trial(6).begin(&device).unwrap();
    let (mut two, _) = trial(5).begin(&device).unwrap();
    let pace = trial(5).pace();
    let loss = one.step(vec![batch.clone(), other.clone()], pace).unwrap();
    let mut sum = picofarm_model::train::Gradients::default();
    two.add(&mut sum, 0, two.bring(batch)).unwrap();
    two.add(&mut sum, 1, two.bring(other)).unwrap();
    assert_eq!(two.finish(sum, 2, pace).unwrap(), loss);
    assert_eq!(one.parameters().to_named(), two.parameters().to_named());
}

fn trial(seed: u64) -> picofarm_model::trial::Trial {
    let plan = plan(Target::Tof, ShadowVariant::Concat);
    picofarm_model::trial::Trial {
        target: Target::Tof,
        net: plan.net,
        batch: 2,
        side: 8,
        learning_rate: 1e-2,
        decay: 1e-3,
        seed,
    }
}

/// Counts the scenes that are loaded or waiting, and the greatest number at a time.
struct Watched {
    scenes: Vec<Arc<Scene>>,
    loading: std::sync::atomic::AtomicUsize,
    loaded: std::sync::atomic::AtomicUsize,
    most: std::sync::atomic::AtomicUsize,
}

impl picofarm_model::scene::Scenes for Watched {
    fn len(&self) -> usize {
        self.scenes.len()
    }

    fn load(&self, index: usize) -> Result<Arc<Scene>, picofarm_model::scene::Unreadable> {
        use std::sync::atomic::Ordering::SeqCst;
        let now = self.loading.fetch_add(1, SeqCst) + 1;
        self.most.fetch_max(now, SeqCst);
        // Other threads get a turn, and finish in another order.
        std::thread::sleep(std::time::Duration::from_millis((index as u64 * 7) % 5));
        self.loading.fetch_sub(1, SeqCst);
        self.loaded.fetch_add(1, SeqCst);
        Ok(Arc::clone(&self.scenes[index]))
    }
}

#[test]
fn scenes_are_loaded_by_several_threads_within_the_room_and_come_in_order() {
    use picofarm_model::train::Loading;
    use std::sync::atomic::Ordering::SeqCst;
    let plan = plan(Target::Tof, ShadowVariant::Concat);
    let with = |loading: Loading| {
        let watched = Arc::new(Watched {
            scenes: scenes(0, 9),
            loading: 0.into(),
            loaded: 0.into(),
            most: 0.into(),
        });
        let sources = Sources {
            train: watched.clone(),
            ..sources()
        };
        let training = Training::start(plan.clone(), None, sources, &Device::flex()).unwrap();
        let mut training = training.loading(loading);
        let mut ahead = 0;
        training
            .run(&mut |_, event| {
                if let Event::Step { step, .. } = event {
                    let used = *step as usize * 4;
                    ahead = ahead.max(watched.loaded.load(SeqCst).saturating_sub(used));
                }
                Control::Continue
            })
            .unwrap();
        (training.finish().weights, watched.most.load(SeqCst), ahead)
    };
    let room = usize::MAX;
    let (one, most, _) = with(Loading { threads: 1, room });
    assert_eq!(most, 1);
    let (four, most, ahead) = with(Loading { threads: 4, room });
    assert!((2..=4).contains(&most), "{most} at a time");
    assert!(ahead <= 2 * 2 + 4, "{ahead} ahead");
    // One scene is always in preparation, however little memory is allowed.
    let (little, most, ahead) = with(Loading {
        threads: 4,
        room: 1,
    });
    assert!(most == 1 && ahead <= 1, "{most} at a time, {ahead} ahead");
    assert!(one == four && one == little);
}

#[test]
fn a_scene_that_cannot_be_read_ends_the_training_by_its_number_and_a_panic_does_not_hang_it() {
    struct Torn(bool);
    impl picofarm_model::scene::Scenes for Torn {
        fn len(&self) -> usize {
            8
        }
        fn load(&self, index: usize) -> Result<Arc<Scene>, picofarm_model::scene::Unreadable> {
            match index {
                3 if self.0 => panic!("torn"),
                3 => Err("torn".into()),
                _ => Ok(scene(index as u64)),
            }
        }
    }
    let run = |panics| {
        let sources = Sources {
            train: Arc::new(Torn(panics)),
            ..sources()
        };
        let plan = plan(Target::Tof, ShadowVariant::Concat);
        let mut training = Training::start(plan, None, sources, &Device::flex()).unwrap();
        training.run(&mut |_, _| Control::Continue)
    };
    let error = run(false).unwrap_err();
    assert!(
        matches!(error, ModelError::Scene { scene: 3, .. }),
        "{error}"
    );
    let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| run(true)));
    assert!(panicked.is_err());
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
    for (target, variant) in ALL {
        let sources = Sources {
            train: Arc::new(hard.to_vec()),
            ..sources()
        };
        let trained = whole(&plan(target, variant), sources);
        assert!(
            trained.history.iter().all(|line| line.loss.is_finite()),
            "{target:?}"
        );
    }
}

#[test]
fn a_rate_that_is_far_too_great_ends_with_a_report_and_not_with_nonsense() {
    let plan = Plan {
        learning_rate: 1e38,
        ..plan(Target::Tof, ShadowVariant::Concat)
    };
    let mut training = Training::start(plan, None, sources(), &Device::flex()).unwrap();
    let error = training.run(&mut |_, _| Control::Continue).unwrap_err();
    assert!(matches!(error, ModelError::NotFinite { .. }), "{error}");
    assert!(
        error.to_string().contains("optimise.learning_rate"),
        "{error}"
    );
}

#[test]
fn a_decoder_learns_on_a_frozen_encoder_which_stays_as_it_was() {
    let depth = plan(Target::Tof, ShadowVariant::Concat);
    let trained = whole(&depth, sources());
    let mut mirrors = plan(Target::Specular, ShadowVariant::Concat);
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
    let plan_a = plan(Target::Tof, ShadowVariant::Concat);
    let training = Training::start(plan_a.clone(), None, sources(), &device).unwrap();
    let checkpoint = training.checkpoint();
    let refused = |plan: Plan, bytes: &[u8]| {
        let training = Training::resume(plan, &[bytes], sources(), &device);
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
fn pieces_of_a_checkpoint_are_as_small_as_asked_and_give_the_bits_of_the_whole() {
    let device = Device::flex();
    let plan = Plan {
        early_stop: 2,
        ema: Some(0.9),
        ..plan(Target::Shadow, ShadowVariant::Concat)
    };
    let mut training = Training::start(plan.clone(), None, sources(), &device).unwrap();
    let stop_at = |training: &mut Training, at: u64| {
        training.run(&mut |_, event| match event {
            Event::Step { step, .. } if *step >= at => Control::Stop,
            _ => Control::Continue,
        })
    };
    stop_at(&mut training, 2).unwrap();
    let whole = training.checkpoint();
    let snapshot = training.snapshot().unwrap();
    // The training continues before the snapshot is written, in place for tensors that are not
    // shared.
    stop_at(&mut training, 3).unwrap();
    assert!(training.checkpoint() != whole);
    let pieces: Vec<Vec<u8>> = snapshot.pieces(4_000).collect();
    assert!(pieces.len() > 3, "{}", pieces.len());
    let largest = training
        .learner()
        .net()
        .declared()
        .iter()
        .map(|d| 4 * d.len())
        .max();
    for piece in &pieces {
        let tensors = safetensors::SafeTensors::deserialize(piece).unwrap();
        let bytes: usize = tensors.iter().map(|(_, view)| view.data().len()).sum();
        assert!(bytes <= 4_000 || (tensors.len() == 1 && Some(bytes) <= largest));
    }
    let of_pieces = Training::resume(plan.clone(), &pieces, sources(), &device).unwrap();
    assert!(of_pieces.checkpoint() == whole);
    let without = Training::resume(plan, &pieces[..pieces.len() - 1], sources(), &device);
    let said = without.map(|_| ()).unwrap_err().to_string();
    assert!(said.contains("no \"") || said.contains("missing"), "{said}");
}

#[test]
fn too_few_scenes_are_refused_with_what_to_change() {
    let plan = Plan {
        batch: 32,
        ..plan(Target::Tof, ShadowVariant::Concat)
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
