//! The operations as compositions of burn's operations, for devices without our kernels and as a
//! reference for testing the kernels.

use burn::tensor::{
    Int, Tensor,
    module::{self, batch_norm_train},
    ops::{ConvOptions, InterpolateMode, InterpolateOptions, MaxPoolOptions},
};

use super::{EPSILON, Normalised, attend, from_windows, shifted, shifted_back, windows};
use crate::kernel::AdamW;

/// The number of channels that matrix units process at once. If a layer has another number than a
/// multiple (e.g. 637 bins), kernels of graphics processors read its values one by one.
const ALIGNED: usize = 16;

/// See [`super::conv3x3`]. Channels are padded with zeros to a multiple of `ALIGNED`, unless
/// there are fewer.
pub fn conv3x3(x: Tensor<4>, w: Tensor<4>) -> Tensor<4> {
    let outputs = w.dims()[0];
    let x = filled(x, 1);
    let w = filled(filled(w, 0), 1);
    let y = module::conv2d(x, w, None, ConvOptions::new([1, 1], [1, 1], [1, 1], 1));
    match y.dims()[1] == outputs {
        true => y,
        false => y.narrow(1, 0, outputs),
    }
}

/// Pads a dimension with zeros to a multiple of [`ALIGNED`], unless it is smaller.
fn filled(x: Tensor<4>, dim: usize) -> Tensor<4> {
    let mut shape = x.dims();
    let there = shape[dim];
    shape[dim] = there.next_multiple_of(ALIGNED) - there;
    if there < ALIGNED || shape[dim] == 0 {
        return x;
    }
    let none = Tensor::<4>::zeros(shape, &x.device()).cast(x.dtype());
    Tensor::cat(vec![x, none], dim)
}

/// See [`super::conv1x1`].
pub fn conv1x1(x: Tensor<4>, w: Tensor<4>, bias: Tensor<1>) -> Tensor<4> {
    module::conv2d(
        x,
        w,
        Some(bias),
        ConvOptions::new([1, 1], [0, 0], [1, 1], 1),
    )
}

/// Returns the one-hot tensor of `bins` (N, H, W): (N, B, H, W).
pub fn one_hot(bins: Tensor<3, Int>, channels: usize) -> Tensor<4> {
    let [n, h, w] = bins.dims();
    let device = bins.device();
    let channel =
        Tensor::<1, Int>::arange(0..channels as i64, &device).reshape([1, channels, 1, 1]);
    bins.reshape([n, 1, h, w])
        .equal(channel.expand([n, channels, h, w]))
        .float()
}

/// See [`super::one_hot_conv3x3`]: the dense form.
pub fn one_hot_conv3x3(bins: Tensor<3, Int>, w: Tensor<4>) -> Tensor<4> {
    let channels = w.dims()[1];
    let dense = one_hot(bins, channels).cast(w.dtype());
    conv3x3(dense, w)
}

/// See [`super::batch_norm_relu`].
pub fn batch_norm_relu(x: Tensor<4>, gamma: Tensor<1>, beta: Tensor<1>) -> Normalised {
    let normed = batch_norm_train(x, gamma, beta, EPSILON);
    Normalised {
        y: burn::tensor::activation::relu(normed.output),
        mean: normed.mean.inner(),
        variance: normed.variance.inner(),
    }
}

/// See [`super::norm_relu`].
pub fn norm_relu(
    x: Tensor<4>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    mean: Tensor<1>,
    variance: Tensor<1>,
) -> Tensor<4> {
    burn::tensor::activation::relu(module::batch_norm(x, gamma, beta, mean, variance, EPSILON))
}

/// See [`super::max_pool`].
pub fn max_pool(x: Tensor<4>) -> Tensor<4> {
    module::max_pool2d(x, MaxPoolOptions::new([2, 2]))
}

/// See [`super::join_upsampled`].
pub fn join_upsampled(skip: Tensor<4>, x: Tensor<4>) -> Tensor<4> {
    let options = InterpolateOptions::new(InterpolateMode::Nearest).with_scale_factor([2.0, 2.0]);
    Tensor::cat(vec![skip, module::interpolate(x, options)], 1)
}

/// See [`super::layer_norm`].
pub fn layer_norm<const D: usize>(x: Tensor<D>, gamma: Tensor<1>, beta: Tensor<1>) -> Tensor<D> {
    module::layer_norm(x, gamma, Some(beta), EPSILON)
}

/// See [`super::window_attention`]; `mask` is [`super::window_mask`] if windows are shifted.
pub fn window_attention(
    qkv: Tensor<4>,
    bias: Tensor<3>,
    window: usize,
    shift: usize,
    mask: Option<Tensor<3>>,
) -> Tensor<4> {
    let [_, h, w, _] = qkv.dims();
    let seen = windows(shifted(qkv, shift), window);
    let heads = bias.dims()[0];
    let said = from_windows(attend(seen, heads, Some(bias), mask), window, [h, w]);
    shifted_back(said, shift)
}

/// Extends a dimension by repeating its first and last entries once.
pub fn bordered<const D: usize>(x: Tensor<D>, dim: usize) -> Tensor<D> {
    let last = x.dims()[dim] - 1;
    let ends = [0, last].map(|at| x.clone().narrow(dim, at, 1));
    let [first, last] = ends;
    Tensor::cat(vec![first, x, last], dim)
}

/// See [`super::surround`].
pub fn surround(x: Tensor<4>, moments: usize, volume: bool) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    let beside = match volume {
        false => x,
        true => {
            let x = bordered(x.reshape([images / moments, moments, c, h, w]), 1);
            let each = (0..3).map(|k| x.clone().narrow(1, k, moments));
            Tensor::cat(each.collect(), 2).reshape([images, 3 * c, h, w])
        }
    };
    bordered(bordered(beside, 2), 3)
}

/// See [`super::taps`].
pub fn taps(x: Tensor<5>, repeated: bool) -> Tensor<4> {
    let [n, moments, s, h, w] = x.dims();
    let more = if repeated { bordered } else { dark };
    let time = moments.div_ceil(2);
    let seen = tapped(more(more(more(x, 1), 3), 4), time);
    seen.reshape([n * time, 27 * s, h / 2, w / 2])
}

/// Gathers the inputs of a 3×3×3 convolution with stride 2 from a tensor that is already extended
/// by one at both ends of T, H and W: (N, T + 2, S, H + 2, W + 2) to (N·T/2, 27, S, H/2, W/2),
/// ordered by moment, then by row.
fn tapped(x: Tensor<5>, time: usize) -> Tensor<5> {
    let [n, there, s, h, w] = x.dims();
    let (rows, columns) = (h / 2 - 1, w / 2 - 1);
    let short = 2 * time + 2 - there;
    let mut x = x;
    if short > 0 {
        // If the number of moments is odd, the entry after the last is never read.
        let none = Tensor::zeros([n, short, s, h, w], &x.device());
        x = Tensor::cat(vec![x, none], 1);
    }
    let every_second = |x: Tensor<5>, dim: usize, from: usize, count: usize| {
        let mut shape = x.dims();
        let (before, after) = (
            shape[..dim].iter().product::<usize>(),
            shape[dim + 1..].iter().product::<usize>(),
        );
        let pairs = x.narrow(dim, from, 2 * count);
        shape[dim] = count;
        pairs
            .reshape([before, count, 2, after])
            .narrow(2, 0, 1)
            .reshape(shape)
    };
    let mut all = Vec::with_capacity(27);
    for moment in 0..3 {
        let x = every_second(x.clone(), 1, moment, time);
        for row in 0..3 {
            let x = every_second(x.clone(), 3, row, rows);
            all.extend((0..3).map(|column| {
                every_second(x.clone(), 4, column, columns).reshape([n * time, 1, s, rows, columns])
            }));
        }
    }
    Tensor::cat(all, 1)
}

/// Extends a dimension by a zero at both ends.
fn dark(x: Tensor<5>, dim: usize) -> Tensor<5> {
    let mut shape = x.dims();
    shape[dim] = 1;
    let none = Tensor::zeros(shape, &x.device());
    Tensor::cat(vec![none.clone(), x, none], dim)
}

/// See [`super::crop`].
pub fn crop(x: Tensor<4>, bias: Tensor<1>) -> Tensor<4> {
    let [_, c, h, w] = x.dims();
    x.narrow(2, 1, h - 2).narrow(3, 1, w - 2) + bias.reshape([1, c, 1, 1])
}

/// See [`super::adjacent`].
pub fn adjacent(x: Tensor<4>, moments: usize) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    let n = images / moments;
    let dark = Tensor::<5>::zeros([n, 1, c, h, w], &x.device()).cast(x.dtype());
    let x = x.reshape([n, moments, c, h, w]);
    let padded = Tensor::cat(vec![dark.clone(), x, dark], 1);
    let each = (0..3).map(|k| padded.clone().narrow(1, k, moments));
    Tensor::cat(each.collect(), 2).reshape([images, 3 * c, h, w])
}

/// See [`super::halve_time`].
pub fn halve_time(x: Tensor<4>) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    let pairs = x.reshape([images / 2, 2, c, h, w]);
    pairs.max_dim(1).reshape([images / 2, c, h, w])
}

/// See [`super::adamw`].
pub fn adamw(
    a: AdamW,
    parameter: Tensor<1>,
    gradient: Tensor<1>,
    [m, v]: [Tensor<1>; 2],
) -> (Tensor<1>, [Tensor<1>; 2]) {
    let m = m.mul_scalar(a.beta1) + gradient.clone().mul_scalar(1.0 - a.beta1);
    let v = v.mul_scalar(a.beta2) + gradient.square().mul_scalar(1.0 - a.beta2);
    let steps = i32::try_from(a.step).unwrap_or(i32::MAX);
    let root = (v.clone() / (1.0 - a.beta2.powi(steps))).sqrt() + a.eps;
    let step = (m.clone() / root).mul_scalar(a.learning_rate / (1.0 - a.beta1.powi(steps)));
    let parameter = parameter.mul_scalar(1.0 - a.learning_rate * a.decay) - step;
    (parameter, [m, v])
}
