//! Networks other than U-Nets: their parts are compared with naive loops, their sizes with counts
//! by hand, and they learn.

use crate::common;

use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};
use picofarm_model::{
    Model, Random,
    input::{ShadowVariant, Target},
    net::{Architecture, Net, NetSpec, Swin},
    ops,
    parameters::Declared,
    scene::Scene,
    train::{Control, Event, Plan, Sources, Trained, Training},
    trial::Trial,
    weights,
};

/// Returns the spec of a small network of an architecture, over 12 bins.
fn small(architecture: Architecture, one_hot: usize) -> NetSpec {
    NetSpec {
        architecture,
        // The heads of NLOST share its channels.
        width: match architecture {
            Architecture::Nlost => 8,
            _ => 6,
        },
        swin: Swin {
            groups: 2,
            depth: 2,
            heads: 2,
            window: 4,
        },
        ..NetSpec::released(12, one_hot, 1)
    }
}

const OTHERS: [Architecture; 3] = [
    Architecture::Swinir,
    Architecture::Embeddings,
    Architecture::Nlost,
];

/// Returns the number of rows and columns of small images.
fn side(architecture: Architecture) -> usize {
    match architecture {
        Architecture::Nlost => 32,
        _ => 8,
    }
}

fn trial(target: Target, net: NetSpec) -> Trial {
    Trial {
        target,
        side: side(net.architecture),
        net,
        batch: 2,
        learning_rate: 1e-3,
        decay: 0.0,
        seed: 2,
    }
}

fn numbers(count: usize, stream: u64) -> Vec<f32> {
    let mut random = Random::new(1, &[stream]);
    (0..count).map(|_| random.normal()).collect()
}

fn values<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().try_into_vec().unwrap()
}

fn parameters(spec: NetSpec) -> usize {
    let net = Net::new(spec).unwrap();
    net.declared().iter().map(Declared::len).sum()
}

/// The number of windows of two images.
const W: usize = 4;
/// The number of tokens of a window.
const T: usize = 4;
/// The number of heads.
const H: usize = 2;
/// The number of features of a head.
const S: usize = 3;

/// Computes attention as a loop over pairs of tokens, with 64 bits.
fn attention(qkv: &[f64], bias: &[f64], mask: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; W * T * H * S];
    for (window, head, a) in (0..W * H * T).map(|i| (i / T / H, i / T % H, i % T)) {
        let at = |part, token, s| qkv[((window * T + token) * 3 + part) * H * S + head * S + s];
        let score = |b| {
            let product: f64 = (0..S).map(|s| at(0, a, s) * at(1, b, s)).sum();
            let within = (a * T) + b;
            product / (S as f64).sqrt()
                + bias[head * T * T + within]
                + mask[window % 2 * T * T + within]
        };
        let shares: Vec<f64> = (0..T).map(|b| f64::exp(score(b))).collect();
        let whole: f64 = shares.iter().sum();
        for s in 0..S {
            let of = |b| shares[b] / whole * at(2, b, s);
            out[(window * T + a) * H * S + head * S + s] = (0..T).map(of).sum();
        }
    }
    out
}

#[test]
fn attention_within_windows_is_a_loop_over_pairs_of_tokens_and_its_gradient_the_slope_of_that() {
    let device = Device::flex().autodiff();
    let qkv = numbers(W * T * 3 * H * S, 1);
    let bias = numbers(H * T * T, 2);
    let mask: Vec<f32> = (0..2 * T * T)
        .map(|i| if i % 5 == 3 { -100.0 } else { 0.0 })
        .collect();
    let weights = numbers(W * T * H * S, 3);
    let wide = |x: &[f32]| -> Vec<f64> { x.iter().map(|x| f64::from(*x)).collect() };
    let expected = attention(&wide(&qkv), &wide(&bias), &wide(&mask));

    let tensor = |values: &[f32], shape: [usize; 3]| {
        Tensor::<3>::from_data(TensorData::new(values.to_vec(), shape), &device)
    };
    let x = tensor(&qkv, [W, T, 3 * H * S]).require_grad();
    let y = ops::attend(
        x.clone(),
        H,
        Some(tensor(&bias, [H, T, T])),
        Some(tensor(&mask, [2, T, T])),
    );
    for (found, expected) in values(y.clone().inner()).iter().zip(&expected) {
        assert!(
            (f64::from(*found) - expected).abs() < 1e-6,
            "{found} {expected}"
        );
    }
    let sum = (y * tensor(&weights, [W, T, H * S])).sum();
    let gradient = values(x.grad(&sum.backward()).unwrap());
    let sum = |moved: &[f64]| -> f64 {
        let said = attention(moved, &wide(&bias), &wide(&mask));
        said.iter()
            .zip(&weights)
            .map(|(y, w)| y * f64::from(*w))
            .sum()
    };
    for at in (0..qkv.len()).step_by(7) {
        let moved = |by: f64| {
            let mut qkv = wide(&qkv);
            qkv[at] += by;
            sum(&qkv)
        };
        let slope = (moved(1e-5) - moved(-1e-5)) / 2e-5;
        assert!(
            (f64::from(gradient[at]) - slope).abs() < 1e-5,
            "{at}: {} {slope}",
            gradient[at]
        );
    }
}

#[test]
fn windows_hold_the_pixels_of_their_place_and_go_back_to_it() {
    let device = Device::flex();
    let (n, h, w, c, window) = (2, 4, 6, 3, 2);
    let image = numbers(n * h * w * c, 4);
    let x = Tensor::<4>::from_data(TensorData::new(image.clone(), [n, h, w, c]), &device);
    let y = ops::windows(x.clone(), window);
    assert_eq!(y.dims(), [n * 6, 4, c]);
    let all = values(y.clone());
    // The fourth window of the second image begins in row 2; its third token is in the next row.
    let (row, column) = (2 + 1, 0);
    let pixel = ((h + row) * w + column) * c;
    assert_eq!(all[((6 + 3) * 4 + 2) * c..][..c], image[pixel..][..c]);
    assert_eq!(values(ops::from_windows(y, window, [h, w])), image);

    let moved = ops::shifted(x, 1);
    let turned = values(moved.clone());
    for (row, column) in (0..h * w).map(|i| (i / w, i % w)) {
        let from = ((row + 1) % h * w + (column + 1) % w) * c;
        assert_eq!(turned[(row * w + column) * c..][..c], image[from..][..c]);
    }
    assert_eq!(values(ops::shifted_back(moved, 1)), image);
}

/// Tokens that a shift brought together are as far apart as before it. Their scores are masked if
/// that distance is a window or more.
#[test]
fn a_mask_parts_what_was_no_neighbour_before_the_shift() {
    for (h, w, window, shift) in [(8, 16, 4, 2), (16, 16, 8, 4), (6, 4, 2, 1)] {
        let mask = ops::window_mask([h, w], window, shift);
        let tokens = window * window;
        let mut parted = 0;
        for (at, found) in mask.iter().enumerate() {
            let (which, a, b) = (at / tokens / tokens, at / tokens % tokens, at % tokens);
            let before = |token: usize| {
                let row = which / (w / window) * window + token / window;
                let column = which % (w / window) * window + token % window;
                ((row + shift) % h, (column + shift) % w)
            };
            let ((row, column), (of_row, of_column)) = (before(a), before(b));
            let near = row.abs_diff(of_row) < window && column.abs_diff(of_column) < window;
            assert_eq!(*found, if near { 0.0 } else { -100.0 }, "{which} {a} {b}");
            parted += usize::from(!near);
        }
        assert!(parted > 0 && parted < mask.len());
    }
}

/// The table that the released code of Swin builds for windows of 2×2.
#[test]
fn relative_positions_are_differences_of_rows_and_columns() {
    let found = ops::relative_positions(2);
    assert_eq!(found, [4, 3, 1, 0, 5, 4, 2, 1, 7, 6, 4, 3, 8, 7, 5, 4]);
    let mut all = ops::relative_positions(8);
    all.sort_unstable();
    all.dedup();
    assert_eq!(all, (0..225).collect::<Vec<_>>());
}

/// The counts are by hand: the lightweight SwinIR (width 60, 4 groups) in front of pixel shuffles
/// of 2, 3 and 4, and the one for colour denoising (width 180, 6 groups).
#[test]
fn a_swinir_has_as_many_parameters_as_counted_by_hand() {
    let count = |width, groups, outputs| {
        parameters(NetSpec {
            architecture: Architecture::Swinir,
            width,
            swin: Swin {
                groups,
                ..Swin::default()
            },
            ..NetSpec::released(3, 0, outputs)
        })
    };
    assert_eq!(count(60, 4, 12), 910_152);
    assert_eq!(count(60, 4, 27), 918_267);
    assert_eq!(count(60, 4, 48), 929_628);
    assert_eq!(count(180, 6, 3), 11_504_163);
}

#[test]
fn multiply_adds_are_those_counted_by_hand() {
    let side = 16;
    let pixels = side * side;
    let bins = 12 + 12;
    // Width 6, 2 groups of 2 blocks, windows of 16 tokens.
    let block = 6 * 18 + 6 * 6 + 2 * 6 * 12 + 2 * 16 * 6;
    let swinir = 9 * bins * 6 + 2 * (2 * block + 9 * 36) + 9 * 36 + 9 * 6;
    // Two filters, one convolution and four others of 6 channels over 6 moments; 16 channels, and
    // 32.
    let volume = 27 * (2 + 2 * 6 + 4 * 36) * 6 * pixels / 4;
    let images = 9 * 5 * 16 * 16 * pixels / 4;
    let fine = (9 * (17 * 32 + 4 * 32 * 32 + 32) + 2) * pixels;
    let embeddings = volume + images + fine;
    // 8 channels, 5 features; 6, 3, 2, 1 and 1 moments of 64 pixels.
    let first = 27 * (2 + 2 * 3 + 4 * 9) * 6;
    let scales = 27 * (2 * 5 * 2 + 2 * 2 * 2) * 3;
    let halved = 27 * 6 * 64 * 2;
    let embedded = 125 * 64 + 125 * 64 + 64;
    let layers = 8 * 64 + 8 * 64;
    let near = 27 * 64 + layers + 2 * (256 + 1) * 8;
    let upwards = 27 * 64;
    let decoder = 2 * (3 * 64 + 8 + 16) + 8 * 64;
    let over_time = 27 * (8 * 4 * 2 + 4 * 2 * 4 + 2 * 8 * 8);
    let joined = 27 * (24 * 8 + 8 * 5) * 3;
    let volume = first + scales + halved + embedded + near + upwards;
    let volume = (volume + 2 * decoder + 2 * over_time + joined) * pixels / 4;
    // 16 pixels, each of which attends to all of them.
    let far = (125 * 64 + 27 * 64 + layers + 2 * (16 + 1) * 8) * pixels / 16;
    let images = 9 * 5 * 10 * 10 * pixels / 4;
    let fine = (9 * (11 * 20 + 4 * 20 * 20 + 20) + 2) * pixels;
    let nlost = volume + far + images + fine;
    for (architecture, expected) in [
        (Architecture::Swinir, swinir * pixels),
        (Architecture::Embeddings, embeddings),
        (Architecture::Nlost, nlost),
    ] {
        let found = small(architecture, 12).multiply_adds(side);
        assert_eq!(found, expected as f64, "{architecture:?}");
    }
    // Two levels of 2 and 4 channels; time 4, then 2. Projection, encoders, time to one moment,
    // decoder, last layer.
    let unet25d = NetSpec {
        width: 2,
        levels: 2,
        time: 4,
        ..small(Architecture::Unet25d, 12)
    };
    let first = 2 * 12 * 4 + 27 * (2 * 2 + 2 * 2) * 4 + (4 * 2 + 2) * 2;
    let second = 27 * (2 * 2 + 2 * 4) * 2 + 2 * 4;
    let decoder = 9 * (6 * 2 + 2 * 2) + 2;
    let expected = (first + decoder) * pixels + second * pixels / 4;
    assert_eq!(unet25d.multiply_adds(side), expected as f64);
}

/// The lightweight SwinIR for twice the size, at 1280×720: 244 G, including norms, is the figure
/// that is usually quoted (not looked up here).
#[test]
fn a_swinir_takes_about_as_many_multiply_adds_as_is_quoted() {
    let light = NetSpec {
        architecture: Architecture::Swinir,
        width: 60,
        ..NetSpec::released(3, 0, 12)
    };
    let found = light.multiply_adds(8) / 64.0 * 640.0 * 360.0 / 244e9;
    assert!((0.97..1.03).contains(&found), "{found}");
}

/// The loss along the gradient: (L(p + εg) − L(p − εg)) / 2ε = |g|². If one-hot bins are filtered,
/// many of the greatest values are equal, so the loss of networks of volumes has no slope there;
/// their gradient is compared with PyTorch's instead.
#[test]
fn gradients_of_other_networks_are_the_slopes_of_the_loss() {
    for architecture in OTHERS {
        for (target, one_hot) in [
            (Target::Tof, 0),
            (Target::Shadow, 12),
            (Target::Specular, 0),
        ] {
            let volume = architecture != Architecture::Swinir;
            if volume && one_hot > 0 {
                continue;
            }
            let trial = trial(target, small(architecture, one_hot));
            // The positions of NLOST's greatest values jump, but less often in a shorter step.
            let step = match architecture {
                Architecture::Nlost => 1e-5,
                _ => 1e-3,
            };
            let slope = trial.slope(step, &Device::flex()).unwrap();
            let off = (slope.measured - slope.expected).abs() / slope.expected;
            assert!(off < 0.02, "{target:?} {architecture:?}: {slope:?}");
        }
    }
}

#[test]
fn other_networks_learn_a_batch_by_heart() {
    for architecture in OTHERS {
        let trial = trial(Target::Specular, small(architecture, 0));
        let (mut learner, mut batch) = trial.begin(&Device::flex()).unwrap();
        // The mirrors of the left half are in blocks of 2×2 pixels, because networks of volumes see
        // half of the pixels.
        let (fine, side) = (batch.target.clone(), side(architecture));
        for (at, mirror) in batch.target.iter_mut().enumerate() {
            *mirror = fine[at / (2 * side) * 2 * side + at % side / 2];
        }
        let pace = picofarm_model::train::Pace {
            learning_rate: 2e-3,
            beta1: 0.9,
        };
        let mut loss = || learner.step(vec![batch.clone()], pace).unwrap();
        let first = loss();
        let last = (0..150).map(|_| loss()).last().unwrap();
        assert!(last < 0.3 * first, "{architecture:?}: {first} to {last}");
    }
}

#[test]
fn other_networks_come_to_the_same_bits_with_any_number_of_threads() {
    for architecture in OTHERS {
        // The network is large enough that burn's own operations use several threads.
        let net = NetSpec {
            width: 24,
            ..small(architecture, 12)
        };
        let trial = Trial {
            side: 32,
            ..trial(Target::Shadow, net)
        };
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| trial.record(3, &Device::flex()).unwrap())
        };
        let one = with(1);
        for threads in [2, 5] {
            assert!(with(threads) == one, "{architecture:?}, {threads} threads");
        }
    }
}

/// Compares the gather of a one-hot input's weights with the dense form, by PyTorch's names.
#[test]
fn a_one_hot_input_is_a_dense_one() {
    let trial = trial(Target::Shadow, small(Architecture::Swinir, 12));
    let device = Device::flex();
    let (learner, batch) = trial.begin(&device).unwrap();
    let (dense, wide) = trial.dense(&device).unwrap();
    for (a, b) in learner.predict(&batch).iter().zip(dense.predict(&wide)) {
        assert!((a - b).abs() < 1e-5, "{a} {b}");
    }
    let named = weights::to_torch(learner.parameters().to_named());
    assert_eq!(named["conv_first.weight"].0, [6, 24, 3, 3]);
}

#[test]
fn what_cannot_be_built_is_refused_by_name() {
    let refused = |spec: NetSpec, field: &str| {
        let text = Net::new(spec).map(|_| ()).unwrap_err().to_string();
        assert!(text.starts_with(field), "{field}: {text}");
    };
    for architecture in OTHERS {
        let spec = || small(architecture, 0);
        refused(NetSpec { stem: 8, ..spec() }, "net.stem");
        let frozen = NetSpec {
            frozen: true,
            ..spec()
        };
        refused(frozen, "net.frozen");
    }
    let odd = NetSpec {
        width: 6,
        ..small(Architecture::Nlost, 0)
    };
    refused(odd, "net.width");
    let swin = |swin: Swin| NetSpec {
        swin,
        ..small(Architecture::Swinir, 0)
    };
    let usual = Swin::default();
    refused(swin(Swin { heads: 4, ..usual }), "net.width");
    refused(swin(Swin { groups: 0, ..usual }), "net.swin.groups");
    refused(swin(Swin { window: 1, ..usual }), "net.swin.window");
    let side = Trial {
        side: 12,
        ..trial(Target::Tof, swin(usual))
    };
    let text = side
        .begin(&Device::flex())
        .map(|_| ())
        .unwrap_err()
        .to_string();
    assert!(text.contains("multiple of 8"), "{text}");
}

/// Returns scenes of a size that a network of an architecture accepts.
fn sources(architecture: Architecture) -> Sources {
    let side = side(architecture);
    if side == 8 {
        return common::sources();
    }
    let scenes = |seeds: std::ops::Range<u64>| -> Arc<Vec<Arc<Scene>>> {
        Arc::new(seeds.map(|seed| common::sized(seed, side)).collect())
    };
    Sources {
        train: scenes(0..9),
        validation: scenes(100..103),
    }
}

/// Returns the result of a training that is stopped once after `stop` steps and resumed from the
/// checkpoint.
fn trained(plan: &Plan, stop: Option<u64>) -> Trained {
    let sources = || sources(plan.net.architecture);
    let device = Device::flex();
    let mut training = Training::start(plan.clone(), None, sources(), &device).unwrap();
    if let Some(stop) = stop {
        let at = &mut |_: &Training, event: &Event| match event {
            Event::Step { step, .. } if *step >= stop => Control::Stop,
            _ => Control::Continue,
        };
        training.run(&mut |t, e| at(t, e)).unwrap();
        let checkpoint = training.checkpoint();
        training =
            Training::resume(plan.clone(), &[checkpoint.as_slice()], sources(), &device).unwrap();
    }
    training.run(&mut |_, _| Control::Continue).unwrap();
    training.finish()
}

#[test]
fn other_networks_learn_every_target_go_on_after_a_stop_and_are_read_back_to_the_same_bits() {
    for architecture in OTHERS {
        for (target, variant) in [
            (Target::Tof, ShadowVariant::Concat),
            (Target::Specular, ShadowVariant::Concat),
            (Target::Shadow, ShadowVariant::Concat),
            (Target::Shadow, ShadowVariant::Difference),
            (Target::Shadow, ShadowVariant::All),
        ] {
            let mut plan = common::plan(target, variant);
            let of = plan.net.clone();
            plan.net = NetSpec {
                dense: of.dense,
                one_hot: of.one_hot,
                outputs: of.outputs,
                ..small(architecture, 0)
            };
            (plan.learning_rate, plan.ema) = (1e-3, Some(0.9));
            let (whole, stopped) = (trained(&plan, None), trained(&plan, Some(2)));
            assert!(whole.weights == stopped.weights, "{plan:?}");
            assert_eq!(whole.history, stopped.history);
            let device = Device::flex();
            let model = Model::read(&whole.weights, &device).unwrap();
            assert_eq!(model.plan(), &plan);
            let sources = sources(architecture);
            let again = Training::start(plan, Some(&whole.weights), sources, &device);
            assert!(again.unwrap().finish().weights == whole.weights);
        }
    }
}
