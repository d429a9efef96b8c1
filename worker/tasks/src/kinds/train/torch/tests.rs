//! Trainings by PyTorch, compared with those of the embedded runtime. They need an interpreter with
//! PyTorch, which `PICOFARM_TORCH` names, and are skipped without one.

use std::{path::PathBuf, sync::Arc};

use picofarm_model::{
    ModelError, Random, cpu,
    input::{Normalise, Question, ShadowVariant, Target},
    net::{Architecture, NetSpec, Precision, StemForm, Swin, TimeProjection},
    scene::Scene,
    train::{Control, Ended, Event, Plan, Schedule, Sources, Trained, Training},
};

use super::{Torch, TorchEngine};
use crate::interpreter::Interpreter;

const SIDE: usize = 16;
const BINS: usize = 16;

/// Returns the interpreter for these tests.
fn interpreter() -> Option<Interpreter> {
    let Some(path) = std::env::var_os("PICOFARM_TORCH") else {
        println!("skipped: PICOFARM_TORCH names no Python with PyTorch");
        return None;
    };
    let found = Interpreter::find(&PathBuf::from(path)).unwrap();
    assert!(super::has_torch(&found), "PICOFARM_TORCH has PyTorch");
    Some(found)
}

/// Returns a slanted wall, one half of which each of two spots lights.
fn scene(seed: u64, side: usize) -> Arc<Scene> {
    let pixels = side * side;
    let mut random = Random::new(seed, &[9]);
    let (near, slope) = (1.0 + 2.0 * random.unit(), random.unit() / 16.0);
    let mut scene = Scene {
        height: side,
        width: side,
        bins: BINS,
        first_m: 1.0,
        bin_width_m: 0.75,
        specular: (0..pixels).map(|p| u8::from(p % side < 3)).collect(),
        spots: vec![[-0.3, 0.0, near], [0.3, 0.0, near]],
        beams_m: vec![(0.09 + near * near).sqrt(); 2],
        lit: (0..2 * pixels)
            .map(|p| u8::from((p % side < side / 2) == (p < pixels)))
            .collect(),
        intrinsics: [8.0; 4],
        depth_m: (0..pixels)
            .map(|p| near + slope * (p % side) as f32)
            .collect(),
        ..Scene::default()
    };
    let mut histogram: Vec<f32> = (0..pixels * BINS).map(|_| 0.05 * random.unit()).collect();
    for spot in 0..2 {
        for (p, path) in scene.tof(spot).iter().enumerate() {
            let bin = (f64::from(*path) - scene.first_m) / scene.bin_width_m;
            let lit = f32::from(scene.lit[spot * pixels + p]);
            histogram[p * BINS + (bin as usize).min(BINS - 1)] += 0.1 + lit;
        }
    }
    scene.histogram = histogram;
    Arc::new(scene)
}

fn sources(plan: &Plan) -> Sources {
    let side = SIDE.max(plan.net.multiple());
    let scenes = |from: u64, count: u64| {
        let scenes = (from..from + count).map(|seed| scene(seed, side));
        scenes.collect::<Vec<_>>()
    };
    Sources {
        train: Arc::new(scenes(0, 9)),
        validation: Arc::new(scenes(100, 3)),
    }
}

/// Returns a plan of three epochs with four steps each.
fn plan(target: Target, architecture: Architecture) -> Plan {
    let question = Question {
        target,
        variant: ShadowVariant::Concat,
        normalise: Normalise::MinMax,
        bins: BINS,
        intensity_only: false,
        spots: 2,
        depth_scale_m: 4.5,
        evidence: None,
    };
    let (dense, one_hot, outputs) = question.channels();
    let (width, time) = match architecture {
        Architecture::Unet2d | Architecture::Embeddings => (4, 0),
        Architecture::Unet25d => (2, 8),
        Architecture::Swinir | Architecture::Nlost => (8, 0),
    };
    let swin = Swin {
        groups: 1,
        depth: 2,
        heads: 2,
        window: 4,
    };
    Plan {
        question,
        net: NetSpec {
            architecture,
            dense,
            one_hot,
            outputs,
            width,
            levels: 3,
            stem: 0,
            stem_form: StemForm::Block,
            time,
            time_projection: TimeProjection::Shared,
            swin,
            added: false,
            frozen: false,
            precision: Precision::F32,
        },
        epochs: 3,
        batch: 1,
        accumulate: 2,
        learning_rate: 1e-3,
        decay: 1e-3,
        schedule: Schedule::Onecycle,
        restarts: None,
        clip_norm: None,
        ema: None,
        augment: true,
        early_stop: 0,
        validate_every: 0,
        seed: 5,
    }
}

fn engine(python: &Interpreter, plan: &Plan, processes: usize) -> TorchEngine {
    let torch = Torch {
        python,
        processes,
        gpus: false,
        compile: false,
        batch_bytes: 1 << 20,
    };
    torch.start(plan).unwrap()
}

fn begun(plan: &Plan) -> Training {
    Training::start(plan.clone(), None, sources(plan), &cpu()).unwrap()
}

/// Returns the result of a training, and the loss of each step.
fn whole(mut training: Training) -> (Trained, Vec<f32>) {
    let mut losses = Vec::new();
    let ended = training.run(&mut |_, event| {
        if let Event::Step { loss, .. } = event {
            losses.push(*loss);
        }
        Control::Continue
    });
    assert_eq!(ended.unwrap(), Ended::Finished);
    (training.finish(), losses)
}

fn by_torch(python: &Interpreter, plan: &Plan, processes: usize) -> (Trained, Vec<f32>) {
    let engine = engine(python, plan, processes);
    whole(begun(plan).on(Box::new(engine)).unwrap())
}

/// Returns the largest distance of two results: of losses of steps, and of weights.
fn apart(one: &(Trained, Vec<f32>), other: &(Trained, Vec<f32>)) -> (f32, f32) {
    let most = |pairs: &mut dyn Iterator<Item = (f32, f32)>| {
        pairs.fold(0.0f32, |most, (a, b)| most.max((a - b).abs()))
    };
    assert_eq!(one.1.len(), other.1.len());
    let losses = most(&mut one.1.iter().copied().zip(other.1.iter().copied()));
    let weights = |trained: &Trained| picofarm_model::weights::read(&trained.weights).unwrap().0;
    let (ours, theirs) = (weights(&one.0), weights(&other.0));
    assert!(ours.keys().eq(theirs.keys()), "the same names");
    let mut weights = 0.0f32;
    for (name, (shape, values)) in &ours {
        assert_eq!(*shape, theirs[name].0, "{name}");
        let pairs = values.iter().copied().zip(theirs[name].1.iter().copied());
        let found = most(&mut { pairs });
        if found > 1e-4 {
            eprintln!("{name}: {found:.1e} apart");
        }
        weights = weights.max(found);
    }
    (losses, weights)
}

#[test]
fn pytorch_comes_to_the_losses_and_weights_of_the_embedded_runtime() {
    let Some(python) = interpreter() else { return };
    let special = |mut plan: Plan| {
        plan.clip_norm = Some(0.5);
        plan.ema = Some(0.9);
        plan.early_stop = 5;
        plan.validate_every = 3;
        plan
    };
    let plans = [
        plan(Target::Tof, Architecture::Unet2d),
        plan(Target::Shadow, Architecture::Unet2d),
        special(plan(Target::Specular, Architecture::Unet2d)),
        plan(Target::Shadow, Architecture::Unet25d),
        plan(Target::Tof, Architecture::Swinir),
        plan(Target::Tof, Architecture::Embeddings),
        plan(Target::Shadow, Architecture::Nlost),
    ];
    for plan in plans {
        let (ours, theirs) = (whole(begun(&plan)), by_torch(&python, &plan, 1));
        let (losses, weights) = apart(&ours, &theirs);
        let name = (plan.question.target, plan.net.architecture);
        println!("{name:?}: losses {losses:.1e} apart, weights {weights:.1e}");
        assert!(
            losses < 1e-4 && weights < 1e-3,
            "{name:?}: {losses} {weights}"
        );
        let lines = ours.0.history.iter().zip(&theirs.0.history);
        for (ours, theirs) in lines {
            assert_eq!((ours.step, ours.epoch), (theirs.step, theirs.epoch));
            let loss = |line: &picofarm_model::train::Line| line.validation.unwrap().loss();
            let (ours, theirs) = (loss(ours), loss(theirs));
            assert!(
                (ours - theirs).abs() < 0.01,
                "{name:?}: {ours} and {theirs}"
            );
        }
    }
}

#[test]
fn a_frozen_encoder_stays_what_it_was() {
    let Some(python) = interpreter() else { return };
    let (tof, _) = whole(begun(&plan(Target::Tof, Architecture::Unet2d)));
    for architecture in [Architecture::Unet2d, Architecture::Unet25d] {
        let (tof, _) = match architecture {
            Architecture::Unet2d => (tof.clone(), Vec::new()),
            other => whole(begun(&plan(Target::Tof, other))),
        };
        let mut plan = plan(Target::Specular, architecture);
        plan.net.frozen = true;
        let begun =
            || Training::start(plan.clone(), Some(&tof.weights), sources(&plan), &cpu()).unwrap();
        let theirs = begun().on(Box::new(engine(&python, &plan, 1))).unwrap();
        let (ours, theirs) = (whole(begun()), whole(theirs));
        // Gradients of channels that the encoder leaves dark are rounding errors, which Adam
        // enlarges: such weights of the decoder differ, and change nothing.
        let (losses, _) = apart(&ours, &theirs);
        assert!(losses < 1e-4, "{architecture:?}: {losses}");
        let read = |trained: &Trained| picofarm_model::weights::read(&trained.weights).unwrap().0;
        let (before, after) = (read(&tof), read(&theirs.0));
        let frozen = |name: &&String| name.starts_with("encoders") || name.starts_with("time_");
        let mut count = 0;
        for name in after.keys().filter(frozen) {
            assert_eq!(after[name], before[name], "{name}");
            count += 1;
        }
        assert!(count > 3, "{count}");
    }
}

#[test]
fn several_processes_come_to_the_weights_of_one() {
    let Some(python) = interpreter() else { return };
    let mut plan = plan(Target::Shadow, Architecture::Unet2d);
    plan.accumulate = 4;
    plan.ema = Some(0.9);
    let one = by_torch(&python, &plan, 1);
    for processes in [2, 4] {
        let several = by_torch(&python, &plan, processes);
        let (losses, weights) = apart(&one, &several);
        println!("{processes} processes: losses {losses:.1e} apart, weights {weights:.1e}");
        assert!(losses < 1e-5 && weights < 1e-4, "{losses} {weights}");
    }
}

/// Trains until a step, and returns a snapshot of it.
fn stopped_at(training: &mut Training, stop: u64) -> Vec<Vec<u8>> {
    let ended = training.run(&mut |_, event| match event {
        Event::Step { step, .. } if *step == stop => Control::Stop,
        _ => Control::Continue,
    });
    assert_eq!(ended.unwrap(), Ended::Stopped);
    training.snapshot().unwrap().pieces(1 << 12).collect()
}

fn resumed(plan: &Plan, pieces: &[Vec<u8>], engine: TorchEngine) -> Training {
    let training = Training::resume(plan.clone(), pieces, sources(plan), &cpu()).unwrap();
    training.on(Box::new(engine)).unwrap()
}

#[test]
fn a_training_goes_on_from_a_checkpoint_in_another_process() {
    let Some(python) = interpreter() else { return };
    let mut plan = plan(Target::Shadow, Architecture::Unet2d);
    plan.ema = Some(0.9);
    plan.early_stop = 9;
    let (straight, losses) = by_torch(&python, &plan, 1);
    let mut training = begun(&plan)
        .on(Box::new(engine(&python, &plan, 1)))
        .unwrap();
    let pieces = stopped_at(&mut training, 6);
    drop(training);
    let (again, rest) = whole(resumed(&plan, &pieces, engine(&python, &plan, 1)));
    let both = [(straight, losses[6..].to_vec()), (again, rest)];
    let (losses, weights) = apart(&both[0], &both[1]);
    assert!(losses < 1e-6 && weights < 1e-5, "{losses} {weights}");
    // The embedded runtime reads the same checkpoint.
    let embedded = Training::resume(plan.clone(), &pieces, sources(&plan), &cpu()).unwrap();
    let (losses, _) = apart(&both[0], &whole(embedded));
    assert!(losses < 1e-4, "{losses}");
}

/// Ends a process of a group, as the kernel does when memory runs out.
fn kill(socket: &str, rank: usize) {
    let wanted = [
        format!("PICOFARM_TORCH_SOCKET={socket}"),
        format!("RANK={rank}"),
    ];
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let found: Vec<i32> = processes
        .filter_map(|entry| {
            let pid = entry.file_name().to_str()?.parse().ok()?;
            let variables = std::fs::read_to_string(entry.path().join("environ")).ok()?;
            let all = |one: &String| variables.split('\0').any(|v| v == one);
            wanted.iter().all(all).then_some(pid)
        })
        .collect();
    assert_eq!(found.len(), 1, "{found:?}");
    let pid = rustix::process::Pid::from_raw(found[0]).unwrap();
    rustix::process::kill_process(pid, rustix::process::Signal::KILL).unwrap();
}

#[test]
fn a_group_that_lost_a_process_ends_and_another_goes_on() {
    let Some(python) = interpreter() else { return };
    let mut plan = plan(Target::Tof, Architecture::Unet2d);
    plan.accumulate = 4;
    let straight = by_torch(&python, &plan, 2);
    let group = engine(&python, &plan, 2);
    let socket = group.processes.folder().join("socket");
    let socket = socket.to_str().unwrap().to_owned();
    let mut training = begun(&plan).on(Box::new(group)).unwrap();
    let pieces = stopped_at(&mut training, 2);
    kill(&socket, 1);
    let lost = training.run(&mut |_, _| Control::Continue).unwrap_err();
    assert!(
        matches!(&lost, ModelError::Engine(why) if why.contains("PyTorch")),
        "{lost}"
    );
    drop(training);
    let (again, rest) = whole(resumed(&plan, &pieces, engine(&python, &plan, 2)));
    let straight = (straight.0, straight.1[2..].to_vec());
    let (losses, weights) = apart(&straight, &(again, rest));
    assert!(losses < 1e-5 && weights < 1e-4, "{losses} {weights}");
}

#[test]
fn a_failure_of_python_is_told_in_its_words() {
    let Some(python) = interpreter() else { return };
    let mut plan = plan(Target::Tof, Architecture::Unet2d);
    let good = engine(&python, &plan, 1);
    plan.net.width = 8;
    // The process has a network of another width.
    let error = begun(&plan).on(Box::new(good)).err().unwrap().to_string();
    assert!(error.contains("shape"), "{error}");
    plan.learning_rate = 1e30;
    let mut training = begun(&plan)
        .on(Box::new(engine(&python, &plan, 1)))
        .unwrap();
    let error = training.run(&mut |_, _| Control::Continue).unwrap_err();
    assert!(matches!(error, ModelError::NotFinite { .. }), "{error}");
}
