//! Learned feature embeddings (Chen et al., SIGGRAPH Asia 2020, released code): a volume of features of half the size, its
//! greatest values over depth and where they lie, and a network over those images.
//!
//! Between the two stands a transform of light in theirs, for confocal scans of a wall; here it is the identity. All depths are
//! kept, depth grows with time as what is learnt does, and the output is not clamped: gradients end where it is.

use burn::tensor::{Tensor, activation::relu};

use super::{
    pass::{Input, Pass},
    residual::{Chain, Residual},
    spec::NetSpec,
};
use crate::{
    ops::{self, plain::bordered},
    parameters::{Begin, Declarations, Id},
};

/// The mean of the last two taps of each dimension: what the learnt box filter begins with.
const BOX: [f32; 27] = {
    let mut taps = [0.0; 27];
    let mut k = 0;
    while k < 27 {
        if k / 9 > 0 && k / 3 % 3 > 0 && k % 3 > 0 {
            taps[k] = 0.125;
        }
        k += 1;
    }
    taps
};

/// Added to the greatest value that features are divided by.
const LEAST: f64 = 1e-15;

#[derive(Debug, Clone)]
pub(super) struct Embeddings {
    /// Of measurement and shadow transient, a filter each.
    filters: Id,
    first: First,
    volume: [Residual; 2],
    /// Weights of the first features' greatest value and depth in the output.
    raw: Id,
    coarse: Chain,
    fine: Chain,
}

/// 3×3×3 convolution with stride 2 and a bias.
#[derive(Debug, Clone, Copy)]
struct First {
    weight: Id,
    bias: Id,
}

impl Embeddings {
    pub(super) fn declare(d: &mut Declarations, spec: &NetSpec) -> Self {
        let (streams, width) = (spec.streams(), spec.width);
        let features = 2 * (width + streams);
        let begin = Begin::FanIn(27 * streams);
        let name = |name: &str| format!("downnet.{name}");
        Self {
            filters: d.add(
                name("weights"),
                &[streams, 1, 3, 3, 3],
                Begin::Repeated(&BOX),
                true,
            ),
            first: First {
                weight: d.add(
                    name("conv1.1.weight"),
                    &[width, streams, 3, 3, 3],
                    begin,
                    true,
                ),
                bias: d.add(name("conv1.1.bias"), &[width], begin, true),
            },
            volume: [2, 3].map(|k| Residual::declare(d, &name(&format!("conv1.{k}")), width, true)),
            raw: d.add(
                "depth.weights".into(),
                &[spec.outputs, 2, 1, 1],
                Begin::Repeated(&[0.0, 1.0]),
                true,
            ),
            coarse: Chain::declare(d, "depth.conv1", features, features, None),
            fine: Chain::declare(
                d,
                "depth.conv2",
                features + spec.outputs,
                2 * features,
                Some(spec.outputs),
            ),
        }
    }

    pub(super) fn forward(&self, pass: &Pass, input: Input) -> Tensor<4> {
        let (volume, time) = self.volume(pass, input);
        let flat = flattened(volume, time);
        let half = flat.dims()[1] / 2;
        let first = [0, half].map(|at| flat.clone().narrow(1, at, 1));
        let raw = doubled(Tensor::cat(first.into(), 1));
        let weights: Tensor<4> = pass.get(self.raw);
        let none = Tensor::zeros([weights.dims()[0]], &raw.device());
        let raw = pass.raise(ops::conv1x1(
            pass.lower(raw),
            pass.lower(weights),
            pass.lower(none),
        ));
        let features = doubled(self.coarse.forward(pass, flat));
        let fine = Tensor::cat(vec![raw.clone(), features], 1);
        raw + self.fine.forward(pass, fine)
    }

    /// Features (N·T/2, streams + width, H/2, W/2), and T/2.
    fn volume(&self, pass: &Pass, input: Input) -> (Tensor<4>, usize) {
        let bins = input.dense.dims()[1];
        let mut streams = vec![input.dense.unsqueeze_dim::<5>(2)];
        if let Some(one_hot) = input.one_hot {
            streams.push(ops::plain::one_hot(one_hot, bins).unsqueeze_dim(2));
        }
        let channels = streams.len();
        // (N, T, streams, H, W)
        let x = Tensor::cat(streams, 2);
        let time = bins.div_ceil(2);

        let seen = ops::taps(x.clone(), true);
        let weight: Tensor<5> = pass.get(self.first.weight);
        let width = weight.dims()[0];
        // Taps, then streams, are the channels of a 1×1 convolution.
        let weight = weight
            .permute([0, 2, 3, 4, 1])
            .reshape([width, 27 * channels, 1, 1]);
        let mut features = pass.raise(ops::conv1x1(
            pass.lower(seen),
            pass.lower(weight),
            pass.lower(pass.get(self.first.bias)),
        ));
        for block in &self.volume {
            features = block.forward(pass, features, time);
        }

        // A filter of its own for each stream: zeros for those of the others.
        let seen = ops::taps(x, false);
        let device = seen.device();
        let filters = pass.flat(self.filters).reshape([channels, 27, 1]);
        let own = Tensor::<2>::eye(channels, &device).reshape([channels, 1, channels]);
        let filters = (filters * own).reshape([channels, 27 * channels, 1, 1]);
        let filtered = ops::conv1x1(seen, filters, Tensor::zeros([channels], &device));
        (Tensor::cat(vec![filtered, features], 1), time)
    }
}

/// Features without what is negative, (f − min)/(max − min) of each channel of a volume; then their greatest values over time, and the
/// moments of those from 0 to 1: (N·T, C, H, W) to (N, 2·C, H, W).
fn flattened(x: Tensor<4>, time: usize) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    let n = images / time;
    let x = relu(x).reshape([n, time, c, h * w]).swap_dims(1, 2);
    // All voxels of a channel in one row: of equal ones, the first has the gradient.
    let x = x.reshape([n, c, time * h * w]);
    let x = x.clone() - x.min_dim(2);
    let greatest = x.clone().max_dim(2);
    let x = (x / (greatest + LEAST)).reshape([n, c, time, h * w]);
    let (values, moments) = x.max_dim_with_indices(2);
    let moments = moments.float().div_scalar((time - 1).max(1) as f64);
    let each = [values, moments].map(|x| x.reshape([n, c, h, w]));
    Tensor::cat(each.into(), 1)
}

/// Twice as many rows and columns, between pixels in proportion to how near they are (bilinear, corners not aligned).
fn doubled(mut x: Tensor<4>) -> Tensor<4> {
    for dim in [2, 3] {
        let mut shape = x.dims();
        let len = shape[dim];
        let around = bordered(x.clone(), dim);
        let near = x.mul_scalar(0.75);
        let between = [0, 2].map(|from| {
            let other = around.clone().narrow(dim, from, len);
            near.clone() + other.mul_scalar(0.25)
        });
        shape[dim] = 2 * len;
        x = Tensor::stack::<5>(between.into(), dim + 1).reshape(shape);
    }
    x
}
