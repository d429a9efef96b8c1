//! Attention within windows, as in Swin transformers (Liu et al., ICCV 2021, sections 3.2 and 3.3)
//! and SwinIR (Liang et al., ICCVW 2021). [`window_attention`], [`gelu`] and [`layer_norm`] have
//! our own kernels. The other functions, and the plain form of attention, are compositions of
//! burn's operations.
//!
//! A *token* is the row of features of a pixel. Feature maps have their channels last here, (N, H,
//! W, C). Windows of w×w tokens are stored as (N·H/w·W/w, w², C): windows row by row within an
//! image, and tokens row by row within a window.

use burn::{
    backend::Dispatch,
    tensor::{Device, Int, Tensor, TensorData, activation},
};

use super::{cpu::NetOps, has_kernels, plain};
use crate::kernel::AttentionShape;

/// The value added to the scores of tokens that a shift brought into one window, which separates
/// them; as in the released code.
pub const APART: f64 = -100.0;

/// Layer norm over the last dimension, with PyTorch's epsilon: (…, C), scale (C) and shift (C) to
/// (…, C).
pub fn layer_norm<const D: usize>(x: Tensor<D>, gamma: Tensor<1>, beta: Tensor<1>) -> Tensor<D> {
    if !has_kernels(&x.device()) {
        return plain::layer_norm(x, gamma, beta);
    }
    Tensor::from_dispatch(Dispatch::layer_norm(
        x.into_dispatch(),
        gamma.into_dispatch(),
        beta.into_dispatch(),
    ))
}

/// (…, I), weights (O, I) and a bias (O) to (…, O), as PyTorch's `Linear`.
pub fn linear<const D: usize>(x: Tensor<D>, w: Tensor<2>, bias: Tensor<1>) -> Tensor<D> {
    let mut shape = x.dims();
    let inputs = shape[D - 1];
    let tokens = shape.iter().product::<usize>() / inputs;
    let [outputs, _] = w.dims();
    let y = x.reshape([tokens, inputs]).matmul(w.transpose()) + bias.reshape([1, outputs]);
    shape[D - 1] = outputs;
    y.reshape(shape)
}

/// Cuts (N, H, W, C) into windows.
///
/// # Panics
/// If H or W is not a multiple of `window`.
pub fn windows(x: Tensor<4>, window: usize) -> Tensor<3> {
    let [n, h, w, c] = x.dims();
    let (rows, columns) = (h / window, w / window);
    x.reshape([n, rows, window, columns, window, c])
        .permute([0, 1, 3, 2, 4, 5])
        .reshape([n * rows * columns, window * window, c])
}

/// Joins windows to (N, H, W, C).
pub fn from_windows(x: Tensor<3>, window: usize, [h, w]: [usize; 2]) -> Tensor<4> {
    let [all, _, c] = x.dims();
    let (rows, columns) = (h / window, w / window);
    let n = all / (rows * columns);
    x.reshape([n, rows, columns, window, window, c])
        .permute([0, 1, 3, 2, 4, 5])
        .reshape([n, h, w, c])
}

/// Moves rows and columns cyclically by `shift` towards the origin. `shift` must be in 0..H and
/// 0..W.
pub fn shifted(x: Tensor<4>, shift: usize) -> Tensor<4> {
    let turn = |x: Tensor<4>, dim: usize| {
        let len = x.dims()[dim];
        let first = x.clone().narrow(dim, 0, shift);
        Tensor::cat(vec![x.narrow(dim, shift, len - shift), first], dim)
    };
    match shift {
        0 => x,
        _ => turn(turn(x, 1), 2),
    }
}

/// The inverse of [`shifted`] by the same `shift`.
pub fn shifted_back(x: Tensor<4>, shift: usize) -> Tensor<4> {
    let turn = |x: Tensor<4>, dim: usize| {
        let len = x.dims()[dim];
        let last = x.clone().narrow(dim, len - shift, shift);
        Tensor::cat(vec![last, x.narrow(dim, 0, len - shift)], dim)
    };
    match shift {
        0 => x,
        _ => turn(turn(x, 1), 2),
    }
}

/// Returns, for each pair of tokens of a window, (w², w²) row by row, the index into a table of (2w
/// − 1)² position differences, ordered by row first: (row of a − row of b + w − 1)·(2w − 1) +
/// column of a − column of b + w − 1.
pub fn relative_positions(window: usize) -> Vec<usize> {
    let tokens = window * window;
    let place = |token: usize| (token / window, token % window);
    let entry = |at: usize| {
        let ((row, column), (of_row, of_column)) = (place(at / tokens), place(at % tokens));
        let (down, right) = (row + window - 1 - of_row, column + window - 1 - of_column);
        down * (2 * window - 1) + right
    };
    (0..tokens * tokens).map(entry).collect()
}

/// Returns the values added to the scores in each window of an image of (H, W) tokens that was
/// [`shifted`], (H/w·W/w, w², w²) row by row: [`APART`] if a shift brought two tokens together from
/// different ends of the image, else 0.
pub fn window_mask([h, w]: [usize; 2], window: usize, shift: usize) -> Vec<f32> {
    // There are three bands: whole windows, tokens that were in the last window before the shift,
    // and tokens from the other end.
    let band = |at: usize, len: usize| match (at < len - window, at < len - shift) {
        (true, _) => 0,
        (false, true) => 1,
        (false, false) => 2,
    };
    let (columns, tokens) = (w / window, window * window);
    let mut mask = Vec::with_capacity(h / window * columns * tokens * tokens);
    for which in 0..h / window * columns {
        let region = |token: usize| {
            let row = which / columns * window + token / window;
            let column = which % columns * window + token % window;
            (band(row, h), band(column, w))
        };
        for a in 0..tokens {
            let apart = |b| {
                if region(a) == region(b) {
                    0.0
                } else {
                    APART as f32
                }
            };
            mask.extend((0..tokens).map(apart));
        }
    }
    mask
}

/// The division of an image into windows.
#[derive(Debug, Clone)]
pub struct Windows {
    /// The number of rows and columns of a window.
    pub window: usize,
    /// The cyclic offset of the windows from the first pixel.
    pub shift: usize,
    /// The [`window_mask`], if a device needs it.
    mask: Option<Tensor<3>>,
}

impl Windows {
    /// Divides an image of (H, W) tokens into windows. H and W must be multiples of `window`, and
    /// `shift` must be less.
    pub fn new([h, w]: [usize; 2], window: usize, shift: usize, device: &Device) -> Self {
        let mask = (shift > 0 && !has_kernels(device)).then(|| {
            let tokens = window * window;
            let mask = TensorData::new(
                window_mask([h, w], window, shift),
                [h * w / tokens, tokens, tokens],
            );
            Tensor::from_data(mask, device)
        });
        Self {
            window,
            shift,
            mask,
        }
    }

    fn shape(&self, [images, height, width, all]: [usize; 4], heads: usize) -> AttentionShape {
        AttentionShape {
            images,
            height,
            width,
            window: self.window,
            shift: self.shift,
            heads,
            size: all / 3 / heads,
            apart: APART as f32,
        }
    }
}

/// Multi-head attention within windows of a map.
///
/// `qkv` (N, H, W, 3·C) contains queries, keys and values in this order, each head after head. A
/// head's scores are ⟨q, k⟩ times (C/heads)^−½, plus `bias` (heads, w², w²), plus [`window_mask`].
/// Returns (N, H, W, C), head after head.
pub fn window_attention(qkv: Tensor<4>, bias: Tensor<3>, windows: &Windows) -> Tensor<4> {
    if !has_kernels(&qkv.device()) {
        let mask = windows.mask.clone();
        return plain::window_attention(qkv, bias, windows.window, windows.shift, mask);
    }
    let shape = windows.shape(qkv.dims(), bias.dims()[0]);
    Tensor::from_dispatch(Dispatch::window_attention(
        qkv.into_dispatch(),
        bias.into_dispatch(),
        shape,
    ))
}

/// x·Φ(x), with Φ the standard normal distribution (Hendrycks and Gimpel, 2016; the exact form).
pub fn gelu<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    if !has_kernels(&x.device()) {
        return activation::gelu(x);
    }
    Tensor::from_dispatch(Dispatch::gelu(x.into_dispatch()))
}

/// Multi-head attention within windows that are already cut out; devices other than the CPU use it
/// for [`window_attention`].
///
/// `qkv` (windows, w², 3·C) contains queries, keys and values in this order, each head after head.
/// A head's scores are ⟨q, k⟩ times (C/heads)^−½, plus `bias` (heads, w², w²), plus `mask` (windows
/// of an image, w², w²), the same for every image. Returns (windows, w², C), head after head. The
/// number of tokens need not be w².
pub fn attend(
    qkv: Tensor<3>,
    heads: usize,
    bias: Option<Tensor<3>>,
    mask: Option<Tensor<3>>,
) -> Tensor<3> {
    let [all, tokens, channels] = qkv.dims();
    let size = channels / 3 / heads;
    let apart = qkv
        .reshape([all, tokens, 3, heads, size])
        .permute([2, 0, 3, 1, 4]);
    let part = |which| {
        apart
            .clone()
            .narrow(0, which, 1)
            .reshape([all, heads, tokens, size])
    };
    let [q, k, v] = [0, 1, 2].map(part);
    let q = q.mul_scalar((size as f64).powf(-0.5));
    let mut scores = q.matmul(k.swap_dims(2, 3));
    if let Some(bias) = bias {
        scores = scores + bias.reshape([1, heads, tokens, tokens]);
    }
    if let Some(mask) = mask {
        let [of_image, ..] = mask.dims();
        let images = all / of_image;
        let by_image = scores.reshape([images, of_image, heads, tokens, tokens]);
        let mask = mask.reshape([1, of_image, 1, tokens, tokens]);
        scores = (by_image + mask).reshape([all, heads, tokens, tokens]);
    }
    activation::softmax(scores, 3)
        .matmul(v)
        .swap_dims(1, 2)
        .reshape([all, tokens, heads * size])
}

/// Returns the rows of a table ((2w − 1)², heads) for each pair of tokens: (heads, w², w²).
pub fn position_bias(table: Tensor<2>, window: usize) -> Tensor<3> {
    let (tokens, [_, heads]) = (window * window, table.dims());
    let entries = relative_positions(window).into_iter().map(|at| at as i64);
    let entries = TensorData::new(entries.collect::<Vec<i64>>(), [tokens * tokens]);
    let entries = Tensor::<1, Int>::from_data(entries, &table.device());
    table
        .select(0, entries)
        .transpose()
        .reshape([heads, tokens, tokens])
}
