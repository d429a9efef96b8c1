//! The gradients of the operations on the CPU, computed from the output's gradient and the state
//! that the operation saved.

use burn::backend::{Flex, TensorMetadata, tensor::IntTensor};

use super::{
    EPSILON,
    cpu::{
        Cpu, alike, bins, border_shape, contiguous, conv_shape, dims, layer, made, moment_shape,
        norm_shape, one_hot_shape, planes, tensor, values,
    },
};
use crate::kernel::{AttentionShape, BatchNorm, Kernels};

/// Returns the gradient of the input.
pub(super) fn conv3x3_by_input(dy: Cpu, w: Cpu) -> Cpu {
    let (dy, w) = (contiguous(dy), contiguous(w));
    let ([n, o, h, wide], [_, c, ..]) = (dims(&dy), dims::<4>(&w));
    let s = conv_shape([n, c, h, wide], c, o);
    made([n, c, h, wide], |dx| {
        Kernels::best().conv3x3_input_grad(&s, values(&dy), values(&w), dx);
    })
}

/// Returns the gradient of the weights.
pub(super) fn conv3x3_by_weight(x: Cpu, dy: Cpu) -> Cpu {
    let (x, dy) = (contiguous(x), contiguous(dy));
    let (at, [_, o, ..]) = (dims(&x), dims::<4>(&dy));
    let s = conv_shape(at, at[1], o);
    made([o, at[1], 3, 3], |dw| {
        Kernels::best().conv3x3_weight_grad(&s, values(&x), values(&dy), dw);
    })
}

/// Returns the gradient of the input.
pub(super) fn conv1x1_by_input(dy: Cpu, w: Cpu) -> Cpu {
    let (dy, w) = (contiguous(dy), contiguous(w));
    let ([n, o, h, wide], [_, c, ..]) = (dims(&dy), dims::<4>(&w));
    let s = conv_shape([n, c, h, wide], c, o);
    made([n, c, h, wide], |dx| {
        Kernels::best().conv1x1_input_grad(&s, values(&dy), values(&w), dx);
    })
}

/// Returns the gradient of the weights.
pub(super) fn conv1x1_by_weight(x: Cpu, dy: Cpu) -> Cpu {
    let (x, dy) = (contiguous(x), contiguous(dy));
    let (at, [_, o, ..]) = (dims(&x), dims::<4>(&dy));
    let s = conv_shape(at, at[1], o);
    made([o, at[1], 1, 1], |dw| {
        Kernels::best().conv1x1_weight_grad(&s, values(&x), values(&dy), dw);
    })
}

/// Returns the gradient of the bias.
pub(super) fn conv1x1_by_bias(dy: Cpu) -> Cpu {
    let dy = contiguous(dy);
    let at = dims::<4>(&dy);
    let s = conv_shape(at, 0, at[1]);
    made([at[1]], |db| Kernels::best().bias_grad(&s, values(&dy), db))
}

/// Returns the gradient of the weights, which have `channels` for each pixel of the kernel.
pub(super) fn one_hot_conv3x3_by_weight(at: IntTensor<Flex>, dy: Cpu, channels: usize) -> Cpu {
    let dy = contiguous(dy);
    let [_, o, ..] = dims::<4>(&dy);
    let s = one_hot_shape(at.shape().dims(), [o, channels, 3, 3]);
    let bins = bins(at);
    made([o, channels, 3, 3], |dw| {
        Kernels::best().onehot_conv3x3_weight_grad(&s, &bins, values(&dy), dw);
    })
}

/// Returns the gradients of input, scale and shift.
pub(super) fn batch_norm_relu_grad(
    x: Cpu,
    gamma: Cpu,
    beta: Cpu,
    mean: Cpu,
    variance: Cpu,
    dy: Cpu,
) -> (Cpu, Cpu, Cpu) {
    let (x, dy, gamma, beta) = (
        contiguous(x),
        contiguous(dy),
        contiguous(gamma),
        contiguous(beta),
    );
    let at = dims::<4>(&x);
    let norm = BatchNorm {
        gamma: values(&gamma),
        beta: values(&beta),
        mean: values(&mean),
        var: values(&variance),
        eps: EPSILON as f32,
    };
    let (mut dgamma, mut dbeta) = (vec![0.0; at[1]], vec![0.0; at[1]]);
    let dx = made(at, |dx| {
        Kernels::best().batch_norm_relu_grad(
            &norm_shape(at),
            values(&x),
            &norm,
            values(&dy),
            dx,
            &mut dgamma,
            &mut dbeta,
        );
    });
    (dx, tensor(dgamma, [at[1]]), tensor(dbeta, [at[1]]))
}

/// Returns the gradient of the input.
pub(super) fn max_pool_grad(x: Cpu, dy: Cpu) -> Cpu {
    let (x, dy) = (contiguous(x), contiguous(dy));
    let at = dims::<4>(&x);
    let s = planes(at);
    // Finding the maximum's position again is cheaper than storing it.
    let (mut y, mut which) = (vec![0.0; s.halved().len()], vec![0; s.halved().len()]);
    Kernels::best().max_pool(&s, values(&x), &mut y, &mut which);
    made(at, |dx| {
        Kernels::best().max_pool_grad(&s, values(&dy), &which, dx);
    })
}

/// Returns the gradients of the first part, which has `c` channels, and of the second.
pub(super) fn join_upsampled_grad(dy: Cpu, c: usize) -> (Cpu, Cpu) {
    let dy = contiguous(dy);
    let [n, both, h, w] = dims(&dy);
    let d = both - c;
    let s = planes([1, d, h / 2, w / 2]);
    let mut dskip = Vec::with_capacity(n * c * h * w);
    let dx = made([n, d, h / 2, w / 2], |dx| {
        let images = values(&dy).chunks_exact(both * h * w);
        for (dy, dx) in images.zip(dx.chunks_exact_mut(s.len())) {
            let (first, rest) = dy.split_at(c * h * w);
            dskip.extend_from_slice(first);
            Kernels::best().upsample_grad(&s, rest, dx);
        }
    });
    (tensor(dskip, [n, c, h, w]), dx)
}

/// Returns the gradients of queries, keys and values, and of the bias.
pub(super) fn window_attention_grad(
    qkv: Cpu,
    bias: Cpu,
    s: &AttentionShape,
    dy: Cpu,
) -> (Cpu, Cpu) {
    let (qkv, bias, dy) = (contiguous(qkv), contiguous(bias), contiguous(dy));
    let mut dbias = vec![0.0; s.heads * s.tokens() * s.tokens()];
    let dqkv = alike(&qkv, |dqkv| {
        let (qkv, bias, dy) = (values(&qkv), values(&bias), values(&dy));
        Kernels::best().window_attention_grad(s, qkv, bias, dy, dqkv, &mut dbias);
    });
    (dqkv, tensor(dbias, [s.heads, s.tokens(), s.tokens()]))
}

/// Returns the gradient of the input.
pub(super) fn gelu_grad(x: Cpu, dy: Cpu) -> Cpu {
    let (x, dy) = (contiguous(x), contiguous(dy));
    alike(&x, |dx| {
        Kernels::best().gelu_grad(values(&x), values(&dy), dx);
    })
}

/// Returns the gradient of the input.
pub(super) fn adjacent_grad(dy: Cpu, moments: usize) -> Cpu {
    let dy = contiguous(dy);
    let [n, c, h, w] = dims(&dy);
    let s = moment_shape([n, c / 3, h, w], moments);
    made([n, c / 3, h, w], |dx| {
        Kernels::best().adjacent_grad(&s, values(&dy), dx);
    })
}

/// Returns the gradient of the input.
pub(super) fn halve_time_grad(x: Cpu, dy: Cpu) -> Cpu {
    let (x, dy) = (contiguous(x), contiguous(dy));
    let s = moment_shape(dims(&x), 2);
    alike(&x, |dx| {
        Kernels::best().halve_time_grad(&s, values(&x), values(&dy), dx);
    })
}

/// Returns the gradients of input, scale and shift.
pub(super) fn layer_norm_grad(x: Cpu, gamma: Cpu, beta: Cpu, dy: Cpu) -> (Cpu, Cpu, Cpu) {
    let [x, gamma, beta, dy] = [x, gamma, beta, dy].map(contiguous);
    let norm = layer(&gamma, &beta);
    let wide = norm.gamma.len();
    let (mut dgamma, mut dbeta) = (vec![0.0; wide], vec![0.0; wide]);
    let dx = alike(&x, |dx| {
        Kernels::best().layer_norm_grad(
            &norm,
            values(&x),
            values(&dy),
            dx,
            &mut dgamma,
            &mut dbeta,
        );
    });
    (dx, tensor(dgamma, [wide]), tensor(dbeta, [wide]))
}

/// Returns the gradient of the input, which has the output's size without its border.
pub(super) fn surround_grad(dy: Cpu, moments: usize, volume: bool) -> Cpu {
    let dy = contiguous(dy);
    let [n, c, h, w] = dims(&dy);
    let at = [n, c / if volume { 3 } else { 1 }, h - 2, w - 2];
    let s = border_shape(at, moments, volume);
    made(at, |dx| Kernels::best().surround_grad(&s, values(&dy), dx))
}

/// Returns the gradient of the input; [`conv1x1_by_bias`] computes that of the bias.
pub(super) fn crop_grad(dy: Cpu) -> Cpu {
    let dy = contiguous(dy);
    let [n, c, h, w] = dims(&dy);
    let s = border_shape([n, c, h, w], 1, false);
    made([n, c, h + 2, w + 2], |dx| {
        Kernels::best().crop_grad(&s, values(&dy), dx);
    })
}

/// Returns the gradient of the input.
pub(super) fn leaky_relu_grad(x: Cpu, slope: f32, dy: Cpu) -> Cpu {
    let (x, dy) = (contiguous(x), contiguous(dy));
    alike(&x, |dx| {
        Kernels::best().leaky_relu_grad(slope, values(&x), values(&dy), dx);
    })
}
