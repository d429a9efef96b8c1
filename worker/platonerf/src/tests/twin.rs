//! Agreement with PyTorch: the same weights, rays and random draws through `tests/twin/twin.py`,
//! with stored results in the same folder.
//!
//! To compute the results again (in the crate's folder; requires Python with torch and
//! safetensors):
//!
//! ```sh
//! PICOFARM_TWIN=input.safetensors cargo test --release -p picofarm-platonerf \
//!     writes_what_the_twin_reads -- --ignored
//! python tests/twin/twin.py input.safetensors tests/twin/twin.safetensors
//! ```
//!
//! The twin computes in 64 bits and prints the deviation of the same program in 32 bits. The
//! tolerances below are a few times that deviation: with frequencies of 512/m, rounding of
//! positions gives errors of 1e-4 in angles.

use std::collections::HashMap;

use burn::tensor::Device;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use super::{alive, room, small};
use crate::{
    Settings, Training,
    loss::{AllDraws, Stage},
    network::{Network, host},
    rays::{Batch, Pool},
    render::{Rays, Sampling, matrix},
    training::{draws, gradients, shape},
};

const STEPS: u32 = 100;

/// Tolerances relative to the norm. Measured errors: outputs 8e-5, gradients 6e-4, losses 2e-5,
/// weights after 100 steps 2e-3. The twin in 32 bits deviates by 1e-4, 6e-4, 1e-5 and 2e-3.
const OUTPUTS: f64 = 5e-4;
/// Gradients of the first step.
const GRADIENTS: f64 = 3e-3;
/// Losses of all steps.
const LOSSES: f64 = 1e-4;
/// Weights after the last step.
const WEIGHTS: f64 = 1e-2;

fn settings() -> Settings {
    Settings {
        width: 24,
        coarse: 16,
        fine: 32,
        batch: 32,
        distance_steps: STEPS,
        shadow_steps: STEPS,
        ..small()
    }
}

fn batch(pool: &Pool, stage: Stage, step: u32) -> Batch {
    let s = settings();
    let place = u64::from(step) * s.batch as u64;
    pool.batch(stage == Stage::Distance, s.seed, place, s.batch)
}

fn drawn(step: u32) -> AllDraws {
    draws(&settings(), step, 0, settings().batch)
}

#[test]
#[ignore = "writes the input of the Python program"]
fn writes_what_the_twin_reads() {
    let s = settings();
    let (pool, _) = Pool::new(room()).unwrap();
    let mut all: HashMap<String, (Vec<usize>, Vec<f32>)> = HashMap::new();
    let mut add = |name: String, shape: &[usize], values: &[f32]| {
        let mut shape = shape.to_vec();
        let (whole, sum) = all.entry(name).or_default();
        shape.insert(0, whole.first().map_or(0, |n: &usize| *n) + 1);
        *whole = shape;
        sum.extend_from_slice(values);
    };
    for (number, stage) in [(1, Stage::Distance), (2, Stage::Shadow)] {
        for step in 0..STEPS {
            let b = batch(&pool, stage, step);
            let n = b.rays();
            add(format!("{number}.direction"), &[n, 3], &b.direction);
            add(format!("{number}.spot"), &[n, 3], &b.spot);
            add(format!("{number}.path"), &[n], &b.path_m);
            add(format!("{number}.tau"), &[n], &b.tau_m);
            add(format!("{number}.lit"), &[n], &b.lit);
            for (time, draws) in drawn(step).iter().enumerate() {
                add(
                    format!("{number}.jitter{time}"),
                    &[n, s.coarse],
                    &draws.jitter,
                );
                add(format!("{number}.share{time}"), &[n, s.fine], &draws.share);
            }
        }
    }
    for (k, weights) in alive(&s).weights.iter().enumerate() {
        all.insert(
            format!("weights{k}"),
            (vec![weights.len()], weights.clone()),
        );
    }
    let config = serde_json::json!({
        "width": s.width, "layers": s.layers, "origin": batch(&pool, Stage::Shadow, 0).origin,
        "near": s.near_m, "far": s.far_m, "scale": s.scale_m, "weight": s.distance_weight,
        "rate": s.learning_rate, "decay": s.decay_steps, "steps": STEPS,
    });
    let views = all.iter().map(|(name, (shape, values))| {
        let bytes = bytemuck::cast_slice(values);
        (
            name,
            TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap(),
        )
    });
    let metadata = HashMap::from([("config".to_owned(), config.to_string())]);
    let bytes = safetensors::serialize(views, Some(metadata)).unwrap();
    let path = std::env::var("PICOFARM_TWIN").expect("PICOFARM_TWIN names the file to write");
    std::fs::write(path, bytes).unwrap();
}

/// Returns the largest difference, and the norm of the differences relative to the norm.
fn apart(found: &[f32], wanted: &[f32]) -> (f64, f64) {
    assert_eq!(found.len(), wanted.len());
    let (mut worst, mut square, mut norm) = (0.0f64, 0.0f64, 0.0f64);
    for (a, b) in found.iter().zip(wanted) {
        let d = f64::from(a - b).abs();
        worst = worst.max(d);
        square += d * d;
        norm += f64::from(*b).powi(2);
    }
    (worst, (square / norm).sqrt())
}

/// Returns the depths, and in stage 2 the transmittances, of the first batch, in the twin's order.
fn seen(stage: Stage, weights: &[Vec<f32>; 2], b: &Batch) -> Vec<f32> {
    let (s, n, device) = (settings(), b.rays(), Device::flex());
    let networks = [0, 1].map(|k| Network::new(shape(&s), &weights[k], &device));
    let sampling = Sampling {
        near: s.near_m,
        coarse: s.coarse,
        fine: s.fine,
    };
    let origin = matrix(&b.origin.repeat(n), [n, 3], &device);
    let direction = matrix(&b.direction, [n, 3], &device);
    let spot = matrix(&b.spot, [n, 3], &device);
    let camera = Rays {
        origin: origin.clone(),
        direction: direction.clone(),
        far: matrix(&vec![s.far_m; n], [n, 1], &device),
    };
    let all = drawn(0);
    let [coarse, fine] = sampling.render(&networks, &camera, &all[0]);
    let mut out = host(coarse.depth.clone());
    out.extend(host(fine.depth.clone()));
    if stage == Stage::Shadow {
        for (depth, draws) in [(fine.depth, &all[1]), (coarse.depth, &all[2])] {
            let point = origin.clone() + direction.clone() * depth.reshape([n, 1]);
            let light = Rays::between(point, spot.clone(), s.near_m);
            for rendered in sampling.render(&networks, &light, draws) {
                out.extend(host(rendered.transmittance));
            }
        }
    }
    out
}

#[test]
fn outputs_gradients_losses_and_weights_are_those_of_pytorch() {
    let bytes = include_bytes!("../../tests/twin/twin.safetensors");
    let twin = SafeTensors::deserialize(bytes).unwrap();
    let wanted = |stage: u32, name: &str| -> Vec<f32> {
        let view = twin.tensor(&format!("{stage}.{name}")).unwrap();
        let words = view.data().as_chunks::<4>().0;
        words.iter().map(|w| f32::from_le_bytes(*w)).collect()
    };
    let (pool, _) = Pool::new(room()).unwrap();
    let device = Device::flex();
    for (number, stage) in [(1, Stage::Distance), (2, Stage::Shadow)] {
        let mut training = Training::begin(room(), settings()).unwrap();
        training.state = alive(&settings());
        let mut losses = Vec::new();
        let check = |name: &str, found: &[f32], tolerance: f64| {
            let (worst, share) = apart(found, &wanted(number, name));
            println!("stage {number} {name}: {worst:.2e} at most, {share:.2e} of the norm");
            assert!(share < tolerance, "stage {number} {name}: {share}");
        };
        for step in 0..STEPS {
            let b = batch(&pool, stage, step);
            let weights = &training.state().weights;
            let found = gradients(&settings(), stage, weights, &b, step, &device, &|_| true);
            let (loss, gradient) = found.unwrap();
            if step == 0 {
                check("seen", &seen(stage, weights, &b), OUTPUTS);
                check("gradient0", &gradient[0], GRADIENTS);
                check("gradient1", &gradient[1], GRADIENTS);
            }
            training.apply(&gradient);
            losses.push(loss);
        }
        check("losses", &losses, LOSSES);
        check("weights0", &training.state().weights[0], WEIGHTS);
        check("weights1", &training.state().weights[1], WEIGHTS);
    }
}
