//! The operations of networks, each with its gradient. On the CPU they are our own kernels, which
//! use burn's `extension`, because `burn`'s own convolutions reach 0.4 to 0.55 of PyTorch's speed
//! on CPUs and its batch norm and ReLU are separate. On other devices they are burn's operations,
//! composed in [`plain`]; the kernels are tested against these.

mod cpu;
mod differentiate;
mod gradient;
pub mod plain;
mod window;

use burn::{
    backend::{Dispatch, DispatchDevice},
    tensor::{Device, FloatDType, Int, Tensor, activation},
};

use crate::kernel::AdamW;
use cpu::NetOps;
pub use window::{
    APART, Windows, attend, from_windows, gelu, layer_norm, linear, position_bias,
    relative_positions, shifted, shifted_back, window_attention, window_mask, windows,
};

/// A constant added to variances: PyTorch's default.
pub const EPSILON: f64 = 1e-5;

/// Returns whether tensors of a device use our kernels.
pub fn has_kernels(device: &Device) -> bool {
    match device.as_dispatch() {
        DispatchDevice::Flex(_) => true,
        DispatchDevice::Autodiff(inner) => matches!(&**inner, DispatchDevice::Flex(_)),
        #[allow(unreachable_patterns, reason = "with CUDA there are more devices")]
        _ => false,
    }
}

/// Converts the input of a convolution in bfloat16: the values and their gradients are rounded to
/// bfloat16. Our kernels compute with 32 bits, which represent such numbers exactly; on other
/// devices the tensor itself is bfloat16.
pub fn to_bf16<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    let kernels = has_kernels(&x.device());
    let rounded = x.cast(FloatDType::BF16);
    match kernels {
        true => rounded.cast(FloatDType::F32),
        false => rounded,
    }
}

/// Rounds the output of a convolution in bfloat16 to that format, and returns it in 32 bits.
pub fn from_bf16<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    match has_kernels(&x.device()) {
        true => to_bf16(x),
        false => x.cast(FloatDType::F32),
    }
}

/// 3×3 convolution with zero padding and no bias: (N, C, H, W) and (O, C, 3, 3) to (N, O, H, W).
pub fn conv3x3(x: Tensor<4>, w: Tensor<4>) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::conv3x3(x, w);
    }
    Tensor::from_dispatch(Dispatch::conv3x3(x.into_dispatch(), w.into_dispatch()))
}

/// 1×1 convolution with a bias: (N, C, H, W), (O, C, 1, 1) and (O) to (N, O, H, W).
pub fn conv1x1(x: Tensor<4>, w: Tensor<4>, bias: Tensor<1>) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::conv1x1(x, w, bias);
    }
    Tensor::from_dispatch(Dispatch::conv1x1(
        x.into_dispatch(),
        w.into_dispatch(),
        bias.into_dispatch(),
    ))
}

/// [`conv3x3`] of the one-hot tensor of `bins` (N, H, W) with (O, B, 3, 3), without creating that
/// tensor. A bin outside 0..B gives a pixel of zeros. The bins have no gradient.
pub fn one_hot_conv3x3(bins: Tensor<3, Int>, w: Tensor<4>) -> Tensor<4> {
    if !has_kernels(&w.device()) {
        return plain::one_hot_conv3x3(bins, w);
    }
    Tensor::from_dispatch(Dispatch::one_hot_conv3x3(
        bins.into_dispatch(),
        w.into_dispatch(),
    ))
}

/// The result of [`batch_norm_relu`].
pub struct Normalised {
    /// The output, in the shape of the input.
    pub y: Tensor<4>,
    /// The mean of each channel, without gradient.
    pub mean: Tensor<1>,
    /// The biased variance of each channel, without gradient.
    pub variance: Tensor<1>,
}

/// Batch norm by the batch's own statistics, then ReLU.
pub fn batch_norm_relu(x: Tensor<4>, gamma: Tensor<1>, beta: Tensor<1>) -> Normalised {
    if !has_kernels(&x.device()) {
        return plain::batch_norm_relu(x, gamma, beta);
    }
    let (y, mean, variance) = Dispatch::batch_norm_relu(
        x.into_dispatch(),
        gamma.into_dispatch(),
        beta.into_dispatch(),
    );
    Normalised {
        y: Tensor::from_dispatch(y),
        mean: Tensor::<1>::from_dispatch(mean).inner(),
        variance: Tensor::<1>::from_dispatch(variance).inner(),
    }
}

/// Batch norm by given statistics, then ReLU: for evaluation, without gradients.
pub fn norm_relu(
    x: Tensor<4>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    mean: Tensor<1>,
    variance: Tensor<1>,
) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::norm_relu(x, gamma, beta, mean, variance);
    }
    Tensor::from_dispatch(Dispatch::norm_relu(
        x.into_dispatch(),
        gamma.into_dispatch(),
        beta.into_dispatch(),
        mean.into_dispatch(),
        variance.into_dispatch(),
    ))
}

/// Max-pool 2×2 with stride 2. Of equal values, the first is selected.
pub fn max_pool(x: Tensor<4>) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::max_pool(x);
    }
    Tensor::from_dispatch(Dispatch::max_pool(x.into_dispatch()))
}

/// Upsamples `x` (N, D, H/2, W/2) by repeating each pixel four times, and appends it to `skip` (N,
/// C, H, W): (N, C + D, H, W).
pub fn join_upsampled(skip: Tensor<4>, x: Tensor<4>) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::join_upsampled(skip, x);
    }
    Tensor::from_dispatch(Dispatch::join_upsampled(
        skip.into_dispatch(),
        x.into_dispatch(),
    ))
}

/// Extends images (N·T, C, H, W) by repeating the outermost pixels once at each side: (N·T, C, H +
/// 2, W + 2). For a volume of `moments`, also concatenates the channels of the moments before, at
/// and after each, with the first and the last moment repeated: (N·T, 3·C, H + 2, W + 2).
pub fn surround(x: Tensor<4>, moments: usize, volume: bool) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::surround(x, moments, volume);
    }
    Tensor::from_dispatch(Dispatch::surround(x.into_dispatch(), moments, volume))
}

/// Gathers the inputs of a 3×3×3 convolution with stride 2 from volumes (N, T, S, H, W), with ends
/// repeated or zeros beyond them: (N·⌈T/2⌉, 27·S, H/2, W/2). Channels are ordered by moment, then
/// by row, with a tap's streams adjacent. **It has no gradient**: it is for inputs.
pub fn taps(x: Tensor<5>, repeated: bool) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::taps(x.detach(), repeated);
    }
    Tensor::from_dispatch(Dispatch::taps(x.into_dispatch(), repeated))
}

/// Removes the outermost pixels of images (N, C, H + 2, W + 2) and adds a bias (C): (N, C, H, W).
pub fn crop(x: Tensor<4>, bias: Tensor<1>) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::crop(x, bias);
    }
    Tensor::from_dispatch(Dispatch::crop(x.into_dispatch(), bias.into_dispatch()))
}

/// x if it is above 0, else `slope`·x; the slope must be less than 1.
pub fn leaky_relu(x: Tensor<4>, slope: f32) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return activation::leaky_relu(x, f64::from(slope));
    }
    Tensor::from_dispatch(Dispatch::leaky_relu(x.into_dispatch(), slope))
}

/// Concatenates the channels of the moments before, at and after each, for images of `moments` each
/// (N·T, C, H, W): (N·T, 3·C, H, W), with zeros beyond the first and the last.
pub fn adjacent(x: Tensor<4>, moments: usize) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::adjacent(x, moments);
    }
    Tensor::from_dispatch(Dispatch::adjacent(x.into_dispatch(), moments))
}

/// The greater value of each two consecutive images, (N, C, H, W) to (N/2, C, H, W). Of equal
/// values, the first is selected.
pub fn halve_time(x: Tensor<4>) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return plain::halve_time(x);
    }
    Tensor::from_dispatch(Dispatch::halve_time(x.into_dispatch()))
}

/// [`conv1x1`] of the one-hot tensor of `bins` (N, H, W) with (O, B, 1, 1) and a bias (O), without
/// creating that tensor: it selects a row of the weights for each pixel. A bin outside 0..B gives a
/// pixel of zeros.
pub fn one_hot_conv1x1(bins: Tensor<3, Int>, w: Tensor<4>, bias: Tensor<1>) -> Tensor<4> {
    let ([n, h, wide], [outputs, channels, ..]) = (bins.dims(), w.dims());
    let none = Tensor::<2>::zeros([1, outputs], &w.device()).cast(w.dtype());
    let rows = Tensor::cat(vec![w.reshape([outputs, channels]).transpose(), none], 0);
    let outside = bins.clone().lower_elem(0) | bins.clone().greater_equal_elem(channels as i64);
    let rows = rows.select(0, bins.mask_fill(outside, channels as i64).flatten(0, 2));
    let y = (rows + bias.reshape([1, outputs])).reshape([n, h, wide, outputs]);
    y.permute([0, 3, 1, 2])
}

/// Takes one step of AdamW for one parameter. Returns the parameter and its two moments.
pub fn adamw(
    settings: AdamW,
    parameter: Tensor<1>,
    gradient: Tensor<1>,
    moments: [Tensor<1>; 2],
) -> (Tensor<1>, [Tensor<1>; 2]) {
    let [m, v] = moments;
    if !has_kernels(&parameter.device()) {
        return plain::adamw(settings, parameter, gradient, [m, v]);
    }
    let (p, m, v) = Dispatch::adamw(
        parameter.into_dispatch(),
        gradient.into_dispatch(),
        m.into_dispatch(),
        v.into_dispatch(),
        settings,
    );
    (
        Tensor::from_dispatch(p),
        [Tensor::from_dispatch(m), Tensor::from_dispatch(v)],
    )
}
