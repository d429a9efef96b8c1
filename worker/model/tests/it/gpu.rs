//! Networks on graphics processors compared with the kernels of the CPU. Every device that drivers
//! list is tested, software devices included: Debian's mesa-vulkan-drivers provide one, so the
//! tests run on machines without a card.
#![cfg(any(feature = "cuda", feature = "wgpu"))]

use crate::common;

use std::collections::BTreeMap;

use common::{plan, scene, sources};
use picofarm_model::{
    Model, ModelError, answers, cpu,
    device::{OpenGpu, gpus},
    input::{ShadowVariant, Target},
    net::{Architecture, NetSpec, Precision, StemForm, Swin, TimeProjection},
    train::{Control, Ended, Event, Gradients, Learner, Plan, Trained, Training, group::Part},
    trial::Trial,
    weights,
};

/// The number of AdamW steps that are compared.
const STEPS: usize = 6;

/// Returns all devices that can be opened. Prints a note if there are none.
fn opened() -> Vec<OpenGpu> {
    let listed = gpus();
    if listed.is_empty() {
        eprintln!("SKIPPED graphics processors: no driver lists any (Debian: mesa-vulkan-drivers)");
    }
    listed.iter().map(|gpu| gpu.open().unwrap()).collect()
}

/// Returns a trial for each architecture and number of inputs, and one for each loss.
fn networks() -> impl Iterator<Item = Trial> {
    let all = [
        Architecture::Unet2d,
        Architecture::Unet25d,
        Architecture::Swinir,
        Architecture::Embeddings,
        Architecture::Nlost,
    ];
    let targets = [
        (Target::Tof, &all[..]),
        // A software device is slow, so two architectures represent the one-hot input.
        (Target::Shadow, &all[..2]),
        // Its network is that of `Tof`, with another loss.
        (Target::Specular, &all[..1]),
    ];
    let trials: Vec<_> = targets
        .into_iter()
        .flat_map(|(target, some)| some.iter().map(move |net| (target, *net)))
        .collect();
    trials.into_iter().map(|(target, architecture)| {
        Trial {
            target,
            net: NetSpec {
                architecture,
                dense: 24,
                one_hot: if target == Target::Shadow { 24 } else { 0 },
                outputs: 1,
                width: 8,
                levels: 3,
                stem: 0,
                stem_form: StemForm::Block,
                time: 8,
                time_projection: TimeProjection::Shared,
                swin: Swin {
                    groups: 2,
                    depth: 2,
                    heads: 2,
                    window: 8,
                },
                added: false,
                frozen: false,
                precision: Precision::F32,
            },
            batch: 3,
            // Windows of 16² in a volume of half the image's size.
            side: if architecture == Architecture::Nlost {
                32
            } else {
                16
            },
            learning_rate: 2e-4,
            decay: 1e-3,
            seed: 1,
        }
    })
}

type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Returns the greatest difference of tensors with names that begin with `part`, relative to the
/// greatest value of each.
fn apart(a: &Tensors, b: &Tensors, part: &str) -> f64 {
    let named = a.iter().filter(|(name, _)| name.starts_with(part));
    let mut worst = 0.0;
    for (name, (shape, values)) in named {
        let (other, others) = &b[name];
        assert_eq!(shape, other, "{name}");
        let scale = values.iter().fold(0.0f32, |m, x| m.max(x.abs()));
        for (x, y) in values.iter().zip(others) {
            assert!(x.is_finite() && y.is_finite(), "{name}: {x} and {y}");
            worst = f64::max(worst, f64::from((x - y).abs() / scale.max(1e-6)));
        }
    }
    worst
}

#[test]
fn networks_answer_and_learn_as_on_the_cpu() {
    for gpu in opened() {
        for trial in networks() {
            // A software device takes seconds for a step of NLOST.
            let steps = match trial.net.architecture {
                Architecture::Nlost => 3,
                _ => STEPS,
            };
            let record = |device| {
                weights::read(&trial.record(steps, device).unwrap())
                    .unwrap()
                    .0
            };
            let (ours, theirs) = (record(&cpu()), record(&gpu.device));
            let part = |name: &str| {
                let worst = apart(&ours, &theirs, name);
                println!(
                    "{gpu} {:?} {:?} {name}: {worst:.1e}",
                    trial.target, trial.net.architecture
                );
                worst
            };
            // Cards that round factors (TF32) deviate correspondingly more.
            let coarse = f64::from(gpu.apart / 1e-6).max(1.0);
            assert_eq!(part("weights"), 0.0);
            assert!(part("evaluated") < 1e-4 * coarse);
            assert!(part("output") < 1e-4 * coarse);
            // The gradients of the scales of NLOST's group norms are sums of cancelling terms.
            let least = match trial.net.architecture {
                Architecture::Nlost => 1e-2,
                _ => 2e-3,
            };
            assert!(part("gradient") < least * coarse);
            assert!(part("after") < 1e-4 * coarse);
            // A weight with an almost zero gradient may move in either direction.
            assert!(part("losses") < 1e-2 * coarse.min(10.0));
            let losses = &theirs["losses"].1;
            assert!(
                losses[steps - 1] < losses[0],
                "{gpu} learns nothing: {losses:?}"
            );
        }
    }
}

fn trained(plan: &Plan, gpu: &OpenGpu, stop: Option<u64>) -> Trained {
    let device = &gpu.device;
    let mut training = Training::start(plan.clone(), None, sources(), device).unwrap();
    if let Some(stop) = stop {
        let ended = training.run(&mut |_, event| match event {
            Event::Step { step, .. } if *step >= stop => Control::Stop,
            _ => Control::Continue,
        });
        assert_eq!(ended.unwrap(), Ended::Stopped);
        let checkpoint = training.checkpoint();
        training =
            Training::resume(plan.clone(), &[checkpoint.as_slice()], sources(), device).unwrap();
    }
    training.run(&mut |_, _| Control::Continue).unwrap();
    training.finish()
}

#[test]
fn a_training_that_was_cut_off_comes_to_the_same_bits_on_the_same_device() {
    let plan = plan(Target::Shadow, ShadowVariant::Concat);
    for gpu in opened() {
        let (whole, cut) = (trained(&plan, &gpu, None), trained(&plan, &gpu, Some(3)));
        assert_eq!(whole.weights, cut.weights, "{gpu}");
        assert_eq!(whole.history, cut.history, "{gpu}");
    }
}

#[test]
fn a_network_says_on_any_device_what_it_says_on_the_cpu() {
    let plan = plan(Target::Shadow, ShadowVariant::Concat);
    for gpu in opened() {
        let weights = trained(&plan, &gpu, None).weights;
        let [ours, theirs] = [&cpu(), &gpu.device].map(|device| {
            let model = Model::read(&weights, device).unwrap();
            let mut said = Vec::new();
            answers(&model, &scene(100), &mut |logits, _| {
                said.extend_from_slice(logits)
            })
            .unwrap();
            said
        });
        let scale = ours.iter().fold(0f32, |m, x| m.max(x.abs()));
        assert!(ours.len() == 128 && scale > 0.0);
        for (a, b) in ours.iter().zip(&theirs) {
            let coarse = (gpu.apart / 1e-6).max(1.0);
            assert!((a - b).abs() <= 1e-4 * coarse * scale, "{gpu}: {a} and {b}");
        }
    }
}

/// The next batch is transferred to the device while it computes, and losses are read late.
#[test]
fn batches_that_are_brought_ahead_give_the_bits_of_one_after_another() {
    for gpu in opened() {
        let trial = |seed| Trial {
            seed,
            ..networks().next().unwrap()
        };
        let begin = |seed| trial(seed).begin(&gpu.device).unwrap();
        let (mut along, first) = begin(1);
        let (mut single, _) = begin(1);
        let batches = vec![first, begin(2).1, begin(3).1];
        let pace = trial(1).pace();
        along.steps_along(batches.clone(), pace).unwrap();
        for batch in batches.clone() {
            single.step(vec![batch], pace).unwrap();
        }
        let numbers = |learner: &Learner| learner.parameters().to_named();
        assert_eq!(numbers(&along), numbers(&single), "{gpu}");
        let before = numbers(&along);
        let mut broken = batches.clone();
        broken[1].dense[5] = f32::NAN;
        for at in [1, 2] {
            let error = along.step(broken[..=at].to_vec(), pace).unwrap_err();
            assert!(matches!(error, ModelError::NotFinite { .. }), "{error}");
            assert_eq!(numbers(&along), before, "{gpu}");
        }
    }
}

/// Also covers a batch of another process, which arrives as a part.
#[test]
fn a_loss_that_is_no_number_moves_nothing_wherever_the_batch_was() {
    let devices = opened().into_iter().map(|gpu| gpu.device);
    for device in std::iter::once(cpu()).chain(devices) {
        let trial = networks().next().unwrap();
        let (other, batch) = trial.begin(&device).unwrap();
        let (mut learner, _) = trial.begin(&device).unwrap();
        let mut parts = Vec::new();
        let batch = Some((0, other.bring(batch)));
        let mut broken = |mut part: Part| {
            part.blocks = part.blocks.map(|mut values: Vec<f32>| {
                *values.last_mut().unwrap() = f32::NAN;
                values
            });
            parts.push(part);
        };
        other
            .parts(Gradients::default(), batch, &mut broken)
            .unwrap();
        let before = learner.parameters().to_named();
        let sum = learner.gradients_of(parts, 1).unwrap();
        let error = learner.finish(sum, 1, trial.pace()).unwrap_err();
        assert!(matches!(error, ModelError::NotFinite { .. }), "{error}");
        assert_eq!(learner.parameters().to_named(), before);
    }
}

#[test]
fn a_device_is_as_far_from_the_cpu_as_it_says() {
    for gpu in opened() {
        let trial = networks().next().unwrap();
        let apart = trial.from_cpu(&gpu.device).unwrap();
        let coarse = f64::from(gpu.apart / 1e-6).max(1.0);
        assert!(apart.output < 1e-4 * coarse, "{gpu}: {apart:?}");
        assert!(apart.gradient < 2e-3 * coarse, "{gpu}: {apart:?}");
    }
}

#[test]
fn numbers_of_16_bits_are_refused_where_a_device_has_none() {
    for gpu in opened() {
        let mut plan = plan(Target::Tof, ShadowVariant::Concat);
        plan.net.precision = Precision::Bf16;
        match Training::start(plan, None, sources(), &gpu.device) {
            Ok(_) => println!("{gpu} has bfloat16"),
            Err(error) => {
                let text = error.to_string();
                assert!(
                    text.contains("net.precision") && text.contains("\"f32\""),
                    "{text}"
                );
            }
        }
    }
}
