//! One pass through a network: which values its parameters have, and what is to be remembered.

use burn::tensor::{Int, Tensor};

use super::Precision;
use crate::{
    ops::{self, Normalised},
    parameters::{Declared, Id, Parameters, shaped},
};

/// What a network sees.
#[derive(Debug, Clone)]
pub struct Input {
    /// (N, C, H, W).
    pub dense: Tensor<4>,
    /// Bins of the one-hot channels (N, H, W); outside of them = none.
    pub one_hot: Option<Tensor<3, Int>>,
}

/// How much a batch moves running statistics: PyTorch's default.
pub const MOMENTUM: f64 = 0.1;

/// A pass.
pub struct Pass<'a> {
    declared: &'a [Declared],
    leaves: &'a [Tensor<1>],
    training: bool,
    precision: Precision,
    /// Statistics after this batch.
    moved: Vec<(Id, Tensor<1>)>,
    /// What segments hand on, where the graph is cut between them.
    cuts: Option<Vec<Cut>>,
}

/// What a segment of a network hands on to later ones, where the graph of a pass is cut: two graphs instead of one.
pub struct Cut {
    /// The segment that it comes from.
    pub segment: usize,
    /// As that segment made it.
    pub made: Tensor<4>,
    /// The same as later segments see it: a leaf of theirs.
    pub seen: Tensor<4>,
}

impl<'a> Pass<'a> {
    /// A pass that learns: `leaves` are the parameters with gradients.
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

    /// The same with a graph for each segment, so that gradients come one segment after the other.
    #[must_use]
    pub fn in_segments(self) -> Self {
        Self {
            cuts: Some(Vec::new()),
            ..self
        }
    }

    /// What a segment hands on, as later segments see it.
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

    /// A pass that only looks: batch norm by its running statistics.
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

    /// Numbers in which convolutions are computed from now on.
    pub(super) fn compute_in(&mut self, precision: Precision) {
        self.precision = precision;
    }

    /// A number as convolutions take it.
    pub(super) fn lower<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        match self.precision {
            Precision::F32 => x,
            Precision::Bf16 => ops::to_bf16(x),
        }
    }

    /// What a convolution gave, as all else takes it.
    pub(super) fn raise<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        match self.precision {
            Precision::F32 => x,
            Precision::Bf16 => ops::from_bf16(x),
        }
    }

    /// Does something in evaluation: batch norm by its running statistics.
    pub(super) fn frozen<T>(&mut self, work: impl FnOnce(&mut Self) -> T) -> T {
        let before = std::mem::replace(&mut self.training, false);
        let out = work(self);
        self.training = before;
        out
    }

    /// A parameter in its declared shape.
    pub fn get<const D: usize>(&self, id: Id) -> Tensor<D> {
        shaped(&self.declared[id.0], self.leaves[id.0].clone())
    }

    /// How a parameter was declared.
    pub(super) fn declared(&self, id: Id) -> &Declared {
        &self.declared[id.0]
    }

    /// A parameter as one row.
    pub(super) fn flat(&self, id: Id) -> Tensor<1> {
        self.leaves[id.0].clone()
    }

    /// Batch norm and ReLU; in training by the batch's statistics, of which it keeps the running mean and the
    /// **unbiased** running variance, as PyTorch does.
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

    /// Statistics after this batch, and what segments handed on.
    pub fn into_moved(self) -> (Vec<(Id, Tensor<1>)>, Vec<Cut>) {
        (self.moved, self.cuts.unwrap_or_default())
    }
}

/// A batch norm's parameters.
#[derive(Debug, Clone, Copy)]
pub struct Norm {
    /// Scale.
    pub gamma: Id,
    /// Shift.
    pub beta: Id,
    /// Running mean.
    pub mean: Id,
    /// Running unbiased variance.
    pub variance: Id,
    /// Number of batches seen (PyTorch keeps it; nothing reads it).
    pub batches: Id,
}
