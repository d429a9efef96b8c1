//! What the networks of volumes are made of: convolutions that repeat the borders around images and volumes, and residual
//! blocks of two of them (Chen et al., SIGGRAPH Asia 2020, released code).
//!
//! A volume lies as (N·T, C, H, W), an image for each moment, as in the 2.5D U-Net.

use burn::tensor::{Tensor, activation::leaky_relu};

use super::pass::Pass;
use crate::{
    ops,
    parameters::{Begin, Declarations, Id},
};

/// Slope of leaky ReLU below 0.
const SLOPE: f64 = 0.2;

/// 3×3 or 3×3×3 convolution with a bias, whose border is repeated around what it sees.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bordered {
    weight: Id,
    bias: Id,
    /// Over time too.
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

    /// Of `time` moments; 1 for images.
    pub(super) fn forward(&self, pass: &Pass, x: Tensor<4>, time: usize) -> Tensor<4> {
        let [images, c, h, w] = x.dims();
        let (beside, weight) = match self.volume {
            false => (x, pass.get(self.weight)),
            true => {
                let x = bordered(x.reshape([images / time, time, c, h, w]), 1);
                let moments = (0..3).map(|k| x.clone().narrow(1, k, time)).collect();
                let beside = Tensor::cat(moments, 2).reshape([images, 3 * c, h, w]);
                let weight: Tensor<5> = pass.get(self.weight);
                let outputs = weight.dims()[0];
                // Channels of a moment lie beside each other.
                let weight = weight.swap_dims(1, 2).reshape([outputs, 3 * c, 3, 3]);
                (beside, weight)
            }
        };
        let around = bordered(bordered(beside, 2), 3);
        let y = ops::conv3x3(pass.lower(around), pass.lower(weight));
        let y = pass.raise(y.narrow(2, 1, h).narrow(3, 1, w));
        let bias: Tensor<1> = pass.get(self.bias);
        let outputs = bias.dims()[0];
        y + bias.reshape([1, outputs, 1, 1])
    }
}

/// leaky(conv(leaky(conv(x))) + x).
#[derive(Debug, Clone, Copy)]
pub(super) struct Residual([Bordered; 2]);

impl Residual {
    pub(super) fn declare(d: &mut Declarations, at: &str, channels: usize, volume: bool) -> Self {
        // Paddings and the activation between count as modules in PyTorch.
        Self(
            [1, 4].map(|k| {
                Bordered::declare(d, &format!("{at}.tmp.{k}"), channels, channels, volume)
            }),
        )
    }

    pub(super) fn forward(&self, pass: &Pass, x: Tensor<4>, time: usize) -> Tensor<4> {
        let [first, second] = &self.0;
        let between = leaky_relu(first.forward(pass, x.clone(), time), SLOPE);
        leaky_relu(second.forward(pass, between, time) + x, SLOPE)
    }
}

/// A convolution and two residual blocks, and another convolution where `outputs` says so.
#[derive(Debug, Clone)]
pub(super) struct Chain {
    first: Bordered,
    blocks: [Residual; 2],
    last: Option<Bordered>,
}

impl Chain {
    /// Of images.
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

/// One more at either end of a dimension, as what lies there.
pub(super) fn bordered<const D: usize>(x: Tensor<D>, dim: usize) -> Tensor<D> {
    let last = x.dims()[dim] - 1;
    let ends = [0, last].map(|at| x.clone().narrow(dim, at, 1));
    let [first, last] = ends;
    Tensor::cat(vec![first, x, last], dim)
}
