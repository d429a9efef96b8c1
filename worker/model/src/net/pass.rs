//! One pass through a network: the values of its parameters, and the statistics that it updates.

use burn::tensor::{Int, Tensor};

use super::Precision;
use crate::{
    ops::{self, Normalised},
    parameters::{Declared, Id, Parameters, shaped},
};

/// The input of a network.
#[derive(Debug, Clone)]
pub struct Input {
    /// (N, C, H, W).
    pub dense: Tensor<4>,
    /// The bins of the one-hot channels (N, H, W); a bin out of range gives zeros in all channels.
    pub one_hot: Option<Tensor<3, Int>>,
}

/// The weight of a batch in the running statistics: PyTorch's default.
pub const MOMENTUM: f64 = 0.1;

/// A pass through a network.
pub struct Pass<'a> {
    declared: &'a [Declared],
    leaves: &'a [Tensor<1>],
    training: bool,
    precision: Precision,
    /// The running statistics after this batch.
    moved: Vec<(Id, Tensor<1>)>,
    /// The outputs of segments, if the graph is cut between them.
    cuts: Option<Vec<Cut>>,
}

/// The output of a segment that later segments use, at a place where the graph of a pass is cut
/// into two.
pub struct Cut {
    /// The segment that computed the output.
    pub segment: usize,
    /// The tensor in the graph of that segment.
    pub made: Tensor<4>,
    /// The same values in the graph of later segments, as a leaf.
    pub seen: Tensor<4>,
}

impl<'a> Pass<'a> {
    /// Creates a training pass. `leaves` are the parameters with gradients.
    pub fn training(declared: &'a [Declared], leaves: &'a [Tensor<1>]) -> Self {
        Self {
            declared,
            leaves,
            training: true,
            precision: Precision::F32,
            moved: Vec::new(),
            cuts: None,
        }
    }

    /// Gives each segment a graph of its own, so that gradients are computed segment by segment.
    #[must_use]
    pub fn in_segments(self) -> Self {
        Self {
            cuts: Some(Vec::new()),
            ..self
        }
    }

    /// Passes a segment's output on. Returns the tensor that later segments use.
    pub(super) fn hand_on(&mut self, segment: usize, made: Tensor<4>) -> Tensor<4> {
        let Some(cuts) = &mut self.cuts else {
            return made;
        };
        let seen = made.clone().detach().require_grad();
        cuts.push(Cut {
            segment,
            made,
            seen: seen.clone(),
        });
        seen
    }

    /// Creates an evaluation pass, in which batch norm uses the running statistics.
    pub fn evaluation(parameters: &'a Parameters) -> Self {
        Self {
            declared: parameters.declared(),
            leaves: parameters.values(),
            training: false,
            precision: Precision::F32,
            moved: Vec::new(),
            cuts: None,
        }
    }

    /// Sets the number format of subsequent convolutions.
    pub(super) fn compute_in(&mut self, precision: Precision) {
        self.precision = precision;
    }

    /// Converts a tensor to the number format of convolutions.
    pub(super) fn lower<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        match self.precision {
            Precision::F32 => x,
            Precision::Bf16 => ops::to_bf16(x),
        }
    }

    /// Converts a convolution's output to the number format of other operations.
    pub(super) fn raise<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        match self.precision {
            Precision::F32 => x,
            Precision::Bf16 => ops::from_bf16(x),
        }
    }

    /// Runs `work` in evaluation mode: batch norm uses the running statistics.
    pub(super) fn frozen<T>(&mut self, work: impl FnOnce(&mut Self) -> T) -> T {
        let before = std::mem::replace(&mut self.training, false);
        let out = work(self);
        self.training = before;
        out
    }

    /// Returns a parameter in its declared shape.
    pub fn get<const D: usize>(&self, id: Id) -> Tensor<D> {
        shaped(&self.declared[id.0], self.leaves[id.0].clone())
    }

    /// Returns a parameter's declaration.
    pub(super) fn declared(&self, id: Id) -> &Declared {
        &self.declared[id.0]
    }

    /// Returns a parameter as one row.
    pub(super) fn flat(&self, id: Id) -> Tensor<1> {
        self.leaves[id.0].clone()
    }

    /// Applies batch norm and ReLU. In training, the batch's statistics are used, and the running
    /// mean and the **unbiased** running variance are updated, as in PyTorch.
    pub fn norm_relu(&mut self, norm: &Norm, x: Tensor<4>) -> Tensor<4> {
        let (gamma, beta) = (self.get(norm.gamma), self.get(norm.beta));
        if !self.training {
            let (mean, variance) = (self.get(norm.mean), self.get(norm.variance));
            return ops::norm_relu(x, gamma, beta, mean, variance);
        }
        let [n, _, h, w] = x.dims();
        let count = (n * h * w) as f64;
        let Normalised { y, mean, variance } = ops::batch_norm_relu(x, gamma, beta);
        let unbiased = variance.mul_scalar(count / (count - 1.0).max(1.0));
        for (id, batch) in [(norm.mean, mean), (norm.variance, unbiased)] {
            let before: Tensor<1> = self.get::<1>(id).inner();
            let after = before.mul_scalar(1.0 - MOMENTUM) + batch.mul_scalar(MOMENTUM);
            self.moved.push((id, after));
        }
        let one: Tensor<1> = self.get::<1>(norm.batches).inner().add_scalar(1.0);
        self.moved.push((norm.batches, one));
        y
    }

    /// Returns the running statistics after this batch, and the cuts between segments.
    pub fn into_moved(self) -> (Vec<(Id, Tensor<1>)>, Vec<Cut>) {
        (self.moved, self.cuts.unwrap_or_default())
    }
}

/// A batch norm's parameters.
#[derive(Debug, Clone, Copy)]
pub struct Norm {
    /// The scale.
    pub gamma: Id,
    /// The shift.
    pub beta: Id,
    /// The running mean.
    pub mean: Id,
    /// The running unbiased variance.
    pub variance: Id,
    /// The number of batches seen. PyTorch stores it; it is not used.
    pub batches: Id,
}
