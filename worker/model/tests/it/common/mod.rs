//! Small scenes and plans.

use std::sync::Arc;

use picofarm_model::{
    Random,
    input::{EvidenceForm, Normalise, Question, ShadowVariant, Target},
    net::{Architecture, NetSpec, StemForm, Swin, TimeProjection},
    scene::Scene,
    train::{Plan, Schedule, Sources},
};

/// Returns a slanted wall with two-bounce peaks at the times of its depth, with one mirror and half
/// of it lit.
pub fn scene(seed: u64) -> Arc<Scene> {
    sized(seed, 8)
}

/// Like [`scene`], with `side`² pixels.
pub fn sized(seed: u64, side: usize) -> Arc<Scene> {
    let (height, width, bins) = (side, side, 16);
    let mut random = Random::new(seed, &[9]);
    let (near, slope) = (1.0 + 2.0 * random.unit(), random.unit() / 8.0);
    let pixels = height * width;
    let depth_m: Vec<f32> = (0..pixels)
        .map(|p| near + slope * (p % width) as f32)
        .collect();
    let mut scene = Scene {
        height,
        width,
        bins,
        first_m: 1.0,
        bin_width_m: 0.75,
        specular: (0..pixels).map(|p| u8::from(p % width == 3)).collect(),
        spots: vec![[-0.3, 0.0, near], [0.3, 0.0, near]],
        beams_m: vec![(0.09 + near * near).sqrt(); 2],
        lit: (0..2 * pixels)
            .map(|p| u8::from((p % width < 4) == (p < pixels)))
            .collect(),
        intrinsics: [4.0, 4.0, 4.0, 4.0],
        depth_m,
        ..Scene::default()
    };
    let mut histogram = vec![0.0; pixels * bins];
    for spot in 0..2 {
        for (p, path) in scene.tof(spot).iter().enumerate() {
            let bin = (f64::from(*path) - scene.first_m) / scene.bin_width_m;
            let lit = f32::from(scene.lit[spot * pixels + p]);
            histogram[p * bins + (bin as usize).min(bins - 1)] += 0.1 + lit;
        }
    }
    scene.histogram = histogram;
    scene.evidence = evidence(&scene, &mut random);
    Arc::new(scene)
}

/// Returns planes of evidence: one that tells light from shadow, one that does not, and log odds
/// that are right for three quarters of the pairs.
fn evidence(scene: &Scene, random: &mut Random) -> Vec<u8> {
    let mut codes = Vec::new();
    for lit in scene.lit.chunks_exact(scene.pixels()) {
        codes.extend(lit.iter().map(|lit| 40 + 170 * lit));
        codes.extend(lit.iter().map(|_| random.below(256) as u8));
        codes.extend(lit.iter().map(|lit| {
            let right = random.below(4) > 0;
            EvidenceForm::code(if (*lit > 0) == right { 1.5 } else { -1.5 })
        }));
    }
    codes
}

pub fn scenes(from: u64, count: u64) -> Vec<Arc<Scene>> {
    (from..from + count).map(scene).collect()
}

pub fn sources() -> Sources {
    Sources {
        train: Arc::new(scenes(0, 9)),
        validation: Arc::new(scenes(100, 3)),
    }
}

pub fn plan(target: Target, variant: ShadowVariant) -> Plan {
    let question = Question {
        target,
        variant,
        normalise: Normalise::MinMax,
        bins: 16,
        intensity_only: false,
        spots: 2,
        depth_scale_m: 4.5,
        evidence: (variant == ShadowVariant::Evidence).then(|| EvidenceForm {
            version: "apart-1".into(),
            planes: ["near", "noise", "log odds"].map(str::to_owned).into(),
        }),
    };
    let (dense, one_hot, outputs) = question.channels();
    Plan {
        question,
        net: NetSpec {
            architecture: Architecture::Unet2d,
            dense,
            one_hot,
            outputs,
            width: 4,
            levels: 3,
            stem: 0,
            stem_form: StemForm::Block,
            time: 0,
            time_projection: TimeProjection::Shared,
            swin: Swin::default(),
            added: variant == ShadowVariant::Evidence,
            frozen: false,
            precision: picofarm_model::net::Precision::F32,
        },
        epochs: 3,
        batch: 2,
        accumulate: 2,
        learning_rate: 1e-2,
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
