//! The gradients of a step, summed over its batches.

use burn::tensor::Tensor;

use super::{group::Blocks, loss::Loss};
use crate::parameters::{Id, download};

/// The gradients of a step's batches, summed as [`Blocks`] are.
#[derive(Default)]
pub struct Gradients {
    pub(super) blocks: Blocks<Summed>,
    /// The running statistics after the step's first batch, if the sum includes it.
    pub(super) moved: Vec<(Id, Tensor<1>)>,
    /// The loss of the batch added last.
    pub(super) latest: Option<Loss>,
}

/// Gradients and losses summed over batches. There is a gradient for each declared parameter; it is
/// `None` if the parameter is not learned.
pub(super) struct Summed {
    pub(super) gradients: Vec<Option<Tensor<1>>>,
    pub(super) losses: Loss,
}

impl Summed {
    /// Returns `len` numbers: the gradients in the order of declaration, and the loss.
    pub(super) fn numbers(&self, len: usize) -> Vec<f32> {
        let mut values = Vec::with_capacity(len);
        for gradient in self.gradients.iter().flatten() {
            values.extend(download(gradient));
        }
        values.push(self.losses.clone().value());
        values
    }

    pub(super) fn add(one: Self, other: Self) -> Self {
        let both = one.gradients.into_iter().zip(other.gradients);
        Self {
            gradients: both.map(|(a, b)| Some(a? + b?)).collect(),
            losses: one.losses.plus(other.losses),
        }
    }
}
