//! Layers of networks of volumes: convolutions that repeat the borders of images and volumes, and
//! residual blocks of two such convolutions (Chen et al., SIGGRAPH Asia 2020, released code).
//!
//! A volume is stored as (N·T, C, H, W), one image for each moment, as in the 2.5D U-Net.

use burn::tensor::Tensor;

use super::pass::Pass;
use crate::{
    ops,
    parameters::{Begin, Declarations, Id},
};

/// The slope of leaky ReLU below 0.
pub(super) const SLOPE: f32 = 0.2;

/// A 3×3 or 3×3×3 convolution with a bias. The border of its input is repeated outwards.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bordered {
    weight: Id,
    bias: Id,
    /// Whether it also extends over time.
    volume: bool,
}

impl Bordered {
    pub(super) fn declare(
        d: &mut Declarations,
        at: &str,
        inputs: usize,
        outputs: usize,
        volume: bool,
    ) -> Self {
        let shape = [outputs, inputs, 3, 3, 3];
        let shape = if volume { &shape[..] } else { &shape[..4] };
        let begin = Begin::FanIn(shape[1..].iter().product());
        Self {
            weight: d.add(format!("{at}.weight"), shape, begin, true),
            bias: d.add(format!("{at}.bias"), &shape[..1], begin, true),
            volume,
        }
    }

    /// Applies the convolution to `time` moments; 1 for images.
    pub(super) fn forward(&self, pass: &Pass, x: Tensor<4>, time: usize) -> Tensor<4> {
        let c = x.dims()[1];
        let weight = match self.volume {
            false => pass.get(self.weight),
            true => {
                let weight: Tensor<5> = pass.get(self.weight);
                let outputs = weight.dims()[0];
                // The channels of the three moments are concatenated.
                weight.swap_dims(1, 2).reshape([outputs, 3 * c, 3, 3])
            }
        };
        let around = ops::surround(x, time, self.volume);
        let y = pass.raise(ops::conv3x3(pass.lower(around), pass.lower(weight)));
        ops::crop(y, pass.get(self.bias))
    }
}

/// leaky(conv(leaky(conv(x))) + x).
#[derive(Debug, Clone, Copy)]
pub(super) struct Residual([Bordered; 2]);

impl Residual {
    pub(super) fn declare(d: &mut Declarations, at: &str, channels: usize, volume: bool) -> Self {
        // PyTorch counts paddings and the activation between the convolutions as modules.
        Self(
            [1, 4].map(|k| {
                Bordered::declare(d, &format!("{at}.tmp.{k}"), channels, channels, volume)
            }),
        )
    }

    pub(super) fn forward(&self, pass: &Pass, x: Tensor<4>, time: usize) -> Tensor<4> {
        let [first, second] = &self.0;
        let between = ops::leaky_relu(first.forward(pass, x.clone(), time), SLOPE);
        ops::leaky_relu(second.forward(pass, between, time) + x, SLOPE)
    }
}

/// A convolution and two residual blocks, followed by another convolution if `outputs` is set.
#[derive(Debug, Clone)]
pub(super) struct Chain {
    first: Bordered,
    blocks: [Residual; 2],
    last: Option<Bordered>,
}

impl Chain {
    /// Declares a chain for images.
    pub(super) fn declare(
        d: &mut Declarations,
        at: &str,
        inputs: usize,
        channels: usize,
        outputs: Option<usize>,
    ) -> Self {
        let conv = |d: &mut Declarations, k: usize, inputs, outputs| {
            Bordered::declare(d, &format!("{at}.{k}"), inputs, outputs, false)
        };
        Self {
            first: conv(d, 1, inputs, channels),
            blocks: [2, 3].map(|k| Residual::declare(d, &format!("{at}.{k}"), channels, false)),
            last: outputs.map(|outputs| conv(d, 5, channels, outputs)),
        }
    }

    pub(super) fn forward(&self, pass: &Pass, x: Tensor<4>) -> Tensor<4> {
        let mut x = self.first.forward(pass, x, 1);
        for block in &self.blocks {
            x = block.forward(pass, x, 1);
        }
        match &self.last {
            Some(last) => last.forward(pass, x, 1),
            None => x,
        }
    }
}
