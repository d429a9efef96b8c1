//! The last part of networks of volumes: the greatest values over time and their positions, and a
//! network over those images (Chen et al., SIGGRAPH Asia 2020, released code).

use burn::tensor::{Tensor, activation::relu};

use super::{pass::Pass, residual::Chain};
use crate::{
    ops::{self, plain::bordered},
    parameters::{Begin, Declarations, Id},
};

/// A constant added to the greatest value before features are divided by it.
const LEAST: f64 = 1e-15;

#[derive(Debug, Clone)]
pub(super) struct Rendering {
    /// The weights of the first features' greatest value and depth in the output.
    raw: Id,
    coarse: Chain,
    fine: Chain,
}

impl Rendering {
    /// Declares the part for volumes with `channels`.
    pub(super) fn declare(d: &mut Declarations, at: &str, channels: usize, outputs: usize) -> Self {
        let features = 2 * channels;
        Self {
            raw: d.add(
                format!("{at}.weights"),
                &[outputs, 2, 1, 1],
                Begin::Repeated(&[0.0, 1.0], 1.0),
                true,
            ),
            coarse: Chain::declare(d, &format!("{at}.conv1"), features, features, None),
            fine: Chain::declare(
                d,
                &format!("{at}.conv2"),
                features + outputs,
                2 * features,
                Some(outputs),
            ),
        }
    }

    /// Maps (N, C, T, H·W) with `rows` to (N, outputs, 2·H, 2·W).
    pub(super) fn forward(&self, pass: &Pass, volume: Tensor<4>, rows: usize) -> Tensor<4> {
        let flat = flattened(volume, rows);
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
}

/// Reorders images of moments (N·T, C, H, W) as (N, C, T, H·W).
pub(super) fn by_channel(x: Tensor<4>, time: usize) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    x.reshape([images / time, time, c, h * w]).swap_dims(1, 2)
}

/// Removes negative values from features (N, C, T, H·W), and scales each channel of a volume by (f
/// − min)/(max − min).
pub(super) fn normalised(x: Tensor<4>) -> Tensor<4> {
    let [n, c, time, pixels] = x.dims();
    // All voxels of a channel form one row. Of equal values, the first has the gradient.
    let x = relu(x).reshape([n, c, time * pixels]);
    let x = x.clone() - x.min_dim(2);
    let greatest = x.clone().max_dim(2);
    (x / (greatest + LEAST)).reshape([n, c, time, pixels])
}

/// Returns the greatest values over time, and their moments scaled to 0..1: (N, C, T, H·W) to (N,
/// 2·C, H, W).
fn flattened(x: Tensor<4>, rows: usize) -> Tensor<4> {
    let [n, c, time, pixels] = x.dims();
    let (values, moments) = x.max_dim_with_indices(2);
    let moments = moments.float().div_scalar((time - 1).max(1) as f64);
    let each = [values, moments].map(|x| x.reshape([n, c, rows, pixels / rows]));
    Tensor::cat(each.into(), 1)
}

/// Doubles rows and columns with bilinear interpolation (corners not aligned).
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
