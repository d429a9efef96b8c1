//! Trained networks on other scenes: they beat trivial answers, and their weights describe them.

use crate::common;

use std::sync::Arc;

use burn::tensor::Device;
use common::{plan, scenes, sources};
use picofarm_model::{
    Answered, Evaluated, Model, ModelError, Random, answered, answers,
    baseline::{Baseline, DepthBaseline, MaskBaseline},
    evaluate,
    input::{ShadowVariant, Target},
    metric::Metrics,
    net::{Architecture, Net, NetSpec, StemForm, TimeProjection},
    scene::{Scene, Scenes},
    train::{Control, Plan, Sources, Trained, Training},
    trial::Trial,
    weights,
};

fn trained(plan: &Plan, sources: Sources) -> Trained {
    let mut training = Training::start(plan.clone(), None, sources, &Device::flex()).unwrap();
    training.run(&mut |_, _| Control::Continue).unwrap();
    training.finish()
}

fn evaluated(model: &Model, scenes_before: &Vec<Arc<Scene>>) -> Evaluated {
    let baseline = Baseline::fit(model.question(), &scenes(0, 40), 40).unwrap();
    evaluate(model, &baseline, scenes_before, &mut |_, _| true)
        .unwrap()
        .unwrap()
}

#[test]
fn a_depth_network_beats_the_best_constant_and_its_shadow_network_the_mask_of_all() {
    let device = Device::flex();
    let many = || Sources {
        train: Arc::new(scenes(0, 40)),
        ..sources()
    };
    let depth = Plan {
        epochs: 25,
        ..plan(Target::Tof, ShadowVariant::Concat)
    };
    let tof = trained(&depth, many());
    let tof = Model::read(&tof.weights, &device).unwrap();
    let found = evaluated(&tof, &scenes(500, 6));
    let of = |name: &str| {
        found
            .baselines
            .iter()
            .find(|(n, _)| n == name)
            .unwrap()
            .1
            .loss()
    };
    assert!(found.metrics.loss() < 0.5 * of("constant"), "{found:?}");
    assert_eq!(found.scenes.len(), 6);

    let shadow = Plan {
        epochs: 25,
        ..plan(Target::Shadow, ShadowVariant::Concat)
    };
    let timed = |scenes: Vec<Arc<Scene>>| -> Vec<Arc<Scene>> {
        let by_network = |scene: Arc<Scene>| Scene {
            seen_depth_m: Some(tof.depth_m(&scene).unwrap()),
            ..scene.as_ref().clone()
        };
        scenes.into_iter().map(by_network).map(Arc::new).collect()
    };
    let predicted = Sources {
        train: Arc::new(timed(scenes(0, 40))),
        validation: Arc::new(timed(scenes(100, 3))),
    };
    let shadow = trained(&shadow, predicted);
    let shadow = Model::read(&shadow.weights, &device).unwrap();
    let found = evaluated(&shadow, &timed(scenes(500, 6)));
    let Metrics::Mask { iou, .. } = found.metrics else {
        panic!("a mask")
    };
    let Metrics::Mask { iou: all, .. } = found.baselines[0].1 else {
        panic!("a mask")
    };
    assert_eq!((found.examples, &*found.baselines[0].0), (12, "all"));
    assert!(iou > all + 0.1, "{iou} and {all}");
}

#[test]
fn figures_are_the_same_to_the_bit_in_however_many_parts_scenes_are_asked() {
    for (target, variant) in [
        (Target::Tof, ShadowVariant::Concat),
        (Target::Shadow, ShadowVariant::Concat),
        (Target::Shadow, ShadowVariant::All),
        (Target::Specular, ShadowVariant::Concat),
    ] {
        let plan = Plan {
            epochs: 1,
            ..plan(target, variant)
        };
        let model = trained(&plan, sources());
        let model = Model::read(&model.weights, &Device::flex()).unwrap();
        let baseline = Baseline::fit(model.question(), &scenes(0, 8), 8).unwrap();
        let scenes = scenes(500, 7);
        let whole = evaluate(&model, &baseline, &scenes, &mut |_, _| true);
        let whole = whole.unwrap().unwrap();
        let part = |from: usize, to: usize| {
            let some = scenes[from..to].to_vec();
            let found = answered(&model, &baseline, &some, &mut |_, _| true);
            let text = serde_json::to_string(&found.unwrap().unwrap()).unwrap();
            serde_json::from_str::<Vec<Answered>>(&text).unwrap()
        };
        for bounds in [
            vec![0, 7],
            vec![0, 3, 7],
            vec![0, 1, 2, 3, 4, 5, 6, 7],
            vec![0, 0, 7, 7],
        ] {
            let parts = bounds.windows(2).flat_map(|b| part(b[0], b[1]));
            let joined = Evaluated::from_scenes(target, &parts.collect::<Vec<_>>());
            assert_eq!(joined, whole);
        }
    }
}

#[test]
fn images_that_are_the_same_for_all_scenes_are_the_best_such_ones() {
    let train = scenes(0, 20);
    let fit = DepthBaseline::fit(4.5, &train, 20).unwrap();
    let error = |image: &dyn Fn(usize) -> f32| -> f32 {
        let each = |s: &Arc<picofarm_model::scene::Scene>| -> f32 {
            let pixels = s.depth_m.iter().enumerate();
            pixels.map(|(i, z)| (image(i) - z).abs()).sum()
        };
        train.iter().map(each).sum()
    };
    let best = error(&|i| fit.median_m[i]);
    assert!(best <= error(&|_| fit.constant_m as f32));
    for other in &train {
        assert!(best <= error(&|i| other.depth_m[i]));
    }

    let Baseline::Mask(MaskBaseline { mask }) = Baseline::fit(
        &plan(Target::Shadow, ShadowVariant::All).question,
        &train,
        20,
    )
    .unwrap() else {
        panic!("a mask")
    };
    let iou = |mask: &dyn Fn(usize) -> bool| {
        let (mut both, mut either) = (0, 0);
        for s in &train {
            for (i, lit) in s.lit.iter().enumerate() {
                both += u32::from(mask(i) && *lit > 0);
                either += u32::from(mask(i) || *lit > 0);
            }
        }
        f64::from(both) / f64::from(either)
    };
    let best = iou(&|i| mask[i]);
    assert!(best >= iou(&|_| true));
    for other in &train {
        assert!(best >= iou(&|i| other.lit[i] > 0) - 1e-9);
    }
}

#[test]
fn the_peak_is_a_better_depth_than_a_constant_where_peaks_follow_depths() {
    let scenes = scenes(0, 20);
    let fit = DepthBaseline::fit(4.5, &scenes, 20).unwrap();
    let error = |depth: &dyn Fn(&picofarm_model::scene::Scene) -> Vec<f32>| -> f32 {
        scenes
            .iter()
            .flat_map(|s| depth(s).into_iter().zip(s.depth_m.clone()))
            .map(|(a, b)| (a - b).abs())
            .sum()
    };
    let constant = error(&|s| vec![fit.constant_m as f32; s.pixels()]);
    assert!(error(&|s| fit.of_peaks(s)) < 0.8 * constant);
}

#[test]
fn weights_go_out_by_pytorchs_names_and_come_back_the_same() {
    let device = Device::flex();
    let plan = plan(Target::Shadow, ShadowVariant::Concat);
    let trained = trained(&plan, sources());
    let (named, _) = weights::read(&trained.weights).unwrap();
    let first = &named["encoders.0.basic_module.SingleConv1.conv.weight"];
    assert_eq!(
        first.0,
        [32, 32, 3, 3],
        "one-hot channels are beside the dense ones"
    );
    let model = Model::read(&trained.weights, &device).unwrap();
    assert_eq!(model.plan(), &plan);
    let again = Training::start(plan, Some(&trained.weights), sources(), &device).unwrap();
    assert_eq!(again.finish().weights, trained.weights);
}

#[test]
fn the_layout_of_released_checkpoints_is_read_wrapped_or_combined() {
    let device = Device::flex();
    let plan = plan(Target::Tof, ShadowVariant::Concat);
    let trained = trained(&plan, sources());
    let (named, _) = weights::read(&trained.weights).unwrap();
    for prefix in ["module.", "depth_model.", "module.depth_model."] {
        let mut state: weights::Named = named
            .iter()
            .map(|(name, value)| (format!("{prefix}{name}"), value.clone()))
            .collect();
        if prefix.contains("depth_model") {
            state.insert("shadow_model.final_conv.bias".into(), (vec![1], vec![0.5]));
        }
        let bytes = weights::write(&state, &Default::default());
        let again = Training::start(plan.clone(), Some(&bytes), sources(), &device).unwrap();
        assert_eq!(again.finish().weights, trained.weights, "{prefix}");
    }
    let mut missing = named.clone();
    missing.remove("final_conv.bias");
    let bytes = weights::write(&missing, &Default::default());
    let error = Training::start(plan, Some(&bytes), sources(), &device).map(|_| ());
    assert!(
        error
            .unwrap_err()
            .to_string()
            .contains("\"final_conv.bias\" is missing")
    );
}

#[test]
fn the_released_network_has_the_published_number_of_parameters() {
    for (one_hot, published) in [(0, 356_404_556), (637, 368_095_417)] {
        let net = Net::new(NetSpec::released(637, one_hot, 1)).unwrap();
        let learned = net.declared().iter().filter(|d| d.learned);
        let count: usize = learned.map(picofarm_model::parameters::Declared::len).sum();
        assert_eq!(count, published);
    }
}

/// 375 bins to 160 moments: in the released code one layer for both streams, 60,160 values.
#[test]
fn the_streams_of_a_25d_network_share_their_projection_of_time_unless_each_has_its_own() {
    let values = |one_hot, time_projection| -> usize {
        let spec = NetSpec {
            architecture: Architecture::Unet25d,
            width: 4,
            levels: 4,
            time_projection,
            ..NetSpec::released(375, one_hot, 1)
        };
        let net = Net::new(spec).unwrap();
        let of_time = net.declared().iter();
        let of_time = of_time.filter(|d| d.name.starts_with("time_projection"));
        of_time.map(picofarm_model::parameters::Declared::len).sum()
    };
    let one = 375 * 160 + 160;
    for (one_hot, projection, layers) in [
        (0, TimeProjection::Shared, 1),
        (375, TimeProjection::Shared, 1),
        (0, TimeProjection::Each, 1),
        (375, TimeProjection::Each, 2),
    ] {
        let count = values(one_hot, projection);
        assert_eq!(count, layers * one, "{one_hot} {projection:?}");
    }
}

/// 637 bins to 128 channels: a 1×1 convolution with a bias has 81,664 values, without norm or ReLU.
#[test]
fn a_linear_stem_is_a_1x1_convolution_with_a_bias_over_bins_and_one_hot_bins() {
    for (one_hot, values) in [(0, 637 * 128 + 128), (637, 2 * 637 * 128 + 128)] {
        let spec = NetSpec {
            stem: 128,
            stem_form: StemForm::Linear,
            ..NetSpec::released(637, one_hot, 1)
        };
        let net = Net::new(spec).unwrap();
        let declared = net.declared().iter();
        let stem: Vec<_> = declared.filter(|d| d.name.starts_with("stem")).collect();
        let names: Vec<&str> = stem.iter().map(|d| &*d.name).collect();
        assert_eq!(names, ["stem.weight", "stem.bias"]);
        let count: usize = stem.iter().map(|d| d.len()).sum();
        assert_eq!(count, values);
    }
}

/// The loss along the gradient: (L(p + εg) − L(p − εg)) / 2ε = |g|², for every network.
#[test]
fn gradients_are_the_slopes_of_the_loss() {
    let device = Device::flex();
    let (block, linear) = (StemForm::Block, StemForm::Linear);
    let (shared, each) = (TimeProjection::Shared, TimeProjection::Each);
    for (target, architecture, one_hot, time_projection, stem, stem_form) in [
        (Target::Tof, Architecture::Unet2d, 0, shared, 0, block),
        (Target::Shadow, Architecture::Unet2d, 6, shared, 0, block),
        (Target::Tof, Architecture::Unet2d, 0, shared, 3, linear),
        (Target::Shadow, Architecture::Unet2d, 6, shared, 3, linear),
        (Target::Specular, Architecture::Unet25d, 0, shared, 0, block),
        (Target::Shadow, Architecture::Unet25d, 6, shared, 0, block),
        (Target::Shadow, Architecture::Unet25d, 6, each, 0, block),
    ] {
        let net = NetSpec {
            architecture,
            time_projection,
            stem,
            stem_form,
            width: 4,
            levels: 2,
            time: 4,
            ..NetSpec::released(6, one_hot, 1)
        };
        let trial = Trial {
            target,
            net,
            batch: 3,
            side: 8,
            learning_rate: 1e-3,
            decay: 0.0,
            seed: 2,
        };
        let slope = trial.slope(1e-3, &device).unwrap();
        let off = (slope.measured - slope.expected).abs() / slope.expected;
        assert!(off < 0.02, "{target:?} {architecture:?}: {slope:?}");
    }
}

#[test]
fn a_scene_is_asked_spot_by_spot() {
    let plan = Plan {
        epochs: 1,
        ..plan(Target::Shadow, ShadowVariant::Concat)
    };
    let model = Model::read(&trained(&plan, sources()).weights, &Device::flex()).unwrap();
    let mut asked = 0;
    let scene = scenes(7, 1).load(0).unwrap();
    answers(&model, &scene, &mut |said, batch| {
        asked += 1;
        assert_eq!((said.len(), batch.target.len()), (64, 64));
    })
    .unwrap();
    assert_eq!(asked, 2);
}

#[test]
fn random_numbers_are_uniform_and_permutations_whole() {
    let mut random = Random::new(1, &[]);
    let mean: f32 = (0..10_000).map(|_| random.unit()).sum::<f32>() / 1e4;
    assert!((mean - 0.5).abs() < 0.02, "{mean}");
    let mut order = random.permutation(1_000);
    assert_ne!(order, (0..1_000).collect::<Vec<_>>());
    order.sort_unstable();
    assert_eq!(order, (0..1_000).collect::<Vec<_>>());
}

/// Returns weights in which every weight with this name ending is `value`.
fn with(weights_of: &[u8], ends: &str, value: f32) -> Vec<u8> {
    let (mut named, metadata) = weights::read(weights_of).unwrap();
    let matching = named.iter_mut().filter(|(name, _)| name.ends_with(ends));
    for (_, (_, values)) in matching {
        values.fill(value);
    }
    weights::write(&named, &metadata)
}

#[test]
fn an_answer_that_is_no_number_fails_at_the_first_scene_and_is_never_a_figure() {
    for (target, variant) in [
        (Target::Tof, ShadowVariant::Concat),
        (Target::Shadow, ShadowVariant::Concat),
    ] {
        let plan = Plan {
            epochs: 1,
            ..plan(target, variant)
        };
        let weights = trained(&plan, sources()).weights;
        let broken = with(&weights, "weight", 3e38);
        let model = Model::read(&broken, &Device::flex()).unwrap();
        let baseline = Baseline::fit(model.question(), &scenes(0, 8), 8).unwrap();
        let error = evaluate(&model, &baseline, &scenes(500, 7), &mut |_, _| true).unwrap_err();
        let ModelError::Answer { scene, what } = &error else {
            panic!("{error}")
        };
        assert_eq!(*scene, Some(0));
        assert!(
            what.contains("row 0, column 0") && what.contains("its weights"),
            "{what}"
        );
    }
}

#[test]
fn impossible_weights_are_refused_by_name() {
    let plan = Plan {
        epochs: 1,
        ..plan(Target::Tof, ShadowVariant::Concat)
    };
    let weights = trained(&plan, sources()).weights;
    for (ends, value, said) in [
        ("running_var", -0.5, "a variance cannot be negative"),
        ("weight", f32::NAN, "expected finite numbers"),
        ("bias", f32::INFINITY, "expected finite numbers"),
    ] {
        let odd = with(&weights, ends, value);
        for error in [
            Model::read(&odd, &Device::flex()).unwrap_err(),
            Model::import(&odd, &plan, &Device::flex()).unwrap_err(),
        ] {
            assert!(matches!(error, ModelError::Values { .. }), "{error}");
            let text = error.to_string();
            assert!(text.contains(said) && text.contains(ends), "{text}");
        }
    }
}
