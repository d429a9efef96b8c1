//! The first part of networks of volumes: time, rows and columns are halved, once by a learned
//! filter and once by convolutions (Chen et al., SIGGRAPH Asia 2020, released code).

use burn::tensor::Tensor;

use super::{
    pass::{Input, Pass},
    residual::Residual,
};
use crate::{
    ops,
    parameters::{Begin, Declarations, Id},
};

/// The mean of the last two taps of each dimension: the initial value of the learned box filter.
pub(super) const BOX: [f32; 27] = {
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

#[derive(Debug, Clone)]
pub(super) struct Downsample {
    /// One filter for the measurement and one for the shadow transient.
    filters: Id,
    first: First,
    blocks: [Residual; 2],
}

/// 3×3×3 convolution with stride 2 and a bias.
#[derive(Debug, Clone, Copy)]
struct First {
    weight: Id,
    bias: Id,
}

impl Downsample {
    /// Declares filters to one channel for each stream, and convolutions to `width` channels.
    pub(super) fn declare(d: &mut Declarations, at: &str, streams: usize, width: usize) -> Self {
        let begin = Begin::FanIn(27 * streams);
        let name = |name: &str| format!("{at}.{name}");
        Self {
            filters: d.add(
                name("weights"),
                &[streams, 1, 3, 3, 3],
                Begin::Repeated(&BOX, 1.0),
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
            blocks: [2, 3].map(|k| Residual::declare(d, &name(&format!("conv1.{k}")), width, true)),
        }
    }

    /// Returns features (N·T/2, streams + width, H/2, W/2), and T/2.
    pub(super) fn forward(&self, pass: &Pass, input: Input) -> (Tensor<4>, usize) {
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
        // The channels of a 1×1 convolution are ordered by tap, then by stream.
        let weight = weight
            .permute([0, 2, 3, 4, 1])
            .reshape([width, 27 * channels, 1, 1]);
        let mut features = pass.raise(ops::conv1x1(
            pass.lower(seen),
            pass.lower(weight),
            pass.lower(pass.get(self.first.bias)),
        ));
        for block in &self.blocks {
            features = block.forward(pass, features, time);
        }

        // Each stream has its own filter; the entries of other streams are zero.
        let seen = ops::taps(x, false);
        let device = seen.device();
        let filters = pass.flat(self.filters).reshape([channels, 27, 1]);
        let own = Tensor::<2>::eye(channels, &device).reshape([channels, 1, channels]);
        let filters = (filters * own).reshape([channels, 27 * channels, 1, 1]);
        let filtered = ops::conv1x1(seen, filters, Tensor::zeros([channels], &device));
        (Tensor::cat(vec![filtered, features], 1), time)
    }
}
