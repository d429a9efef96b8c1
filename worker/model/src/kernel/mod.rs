//! CPU kernels of the model runtime: 3×3 and 1×1 convolutions, batch norm with ReLU, pooling,
//! AdamW, the convolution over one-hot bins, attention within windows, layer norm, GELU, and
//! operations along time and at borders. All work on `f32` slices, in NCHW order unless documented
//! otherwise.
//!
//! **The same bits everywhere**: every result is a fixed-order chain of fused multiply-adds, or a
//! fixed tree over a fixed number of virtual lanes. Neither the number of threads nor the
//! instruction set ([`simd::Isa`]) changes a bit. The portable path uses [`f32::mul_add`], which
//! gives equal results but is slow without hardware support.
//!
//! All functions are methods of [`Kernels`], which contains the instruction set. They panic if a
//! slice's length disagrees with the shape, because shapes are the caller's invariant.

mod adam;
mod attention;
mod attention_shape;
mod border;
mod conv;
mod conv_shape;
mod exp;
mod grad;
mod layer_norm;
mod moments;
mod norm;
mod onehot;
mod plane;
mod pool;
mod scratch;
mod simd;
mod taps;
mod winograd;
mod winograd_grad;

pub use adam::AdamW;
pub use attention_shape::AttentionShape;
pub use border::BorderShape;
pub use conv_shape::ConvShape;
pub use layer_norm::LayerNorm;
pub use moments::MomentShape;
pub use norm::{BatchNorm, NormShape};
pub use onehot::OneHotShape;
pub use pool::PlaneShape;
pub use simd::Kernels;
pub use taps::TapShape;

#[cfg(test)]
mod tests;
