//! The networks: their layers, and passes through them.

mod block;
mod cost;
mod downsample;
mod embeddings;
mod layer;
mod network;
mod nlost;
mod pass;
mod rendering;
mod residual;
mod spec;
mod swinir;
mod unet25d;
mod unet2d;
mod volume;

use std::{ops::Range, sync::Arc};

use burn::tensor::Tensor;

pub use block::ONE_HOT;
pub use pass::{Cut, Input, MOMENTUM, Pass};
pub use spec::{Architecture, NetSpec, Precision, StemForm, Swin, TimeProjection};

use crate::{
    ModelError,
    parameters::{Declarations, Declared},
};
use network::{AnyNetwork, registered};

/// A network without its parameters' values.
#[derive(Debug, Clone)]
pub struct Net {
    spec: NetSpec,
    declared: Vec<Declared>,
    segments: Vec<Range<usize>>,
    network: Arc<dyn AnyNetwork>,
}

impl Net {
    /// Creates the network of a spec.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] naming the first field that cannot be used.
    pub fn new(spec: NetSpec) -> Result<Self, ModelError> {
        spec.check()?;
        let mut declarations = Declarations::default();
        let network = (registered(spec.architecture).build)(&mut declarations, &spec);
        let begins = std::iter::once(0).chain(declarations.cuts.iter().copied());
        let ends = declarations.cuts.iter().copied();
        let ends = ends.chain([declarations.list.len()]);
        Ok(Self {
            spec,
            segments: begins.zip(ends).map(|(begin, end)| begin..end).collect(),
            declared: declarations.list,
            network,
        })
    }

    /// Returns the network's spec.
    pub fn spec(&self) -> &NetSpec {
        &self.spec
    }

    /// Returns the declarations of the network's parameters.
    pub fn declared(&self) -> &[Declared] {
        &self.declared
    }

    /// Returns the segments of the network as ranges of its parameters. The gradients of the last
    /// segment are available first, while those of the earlier ones are still to be computed.
    pub fn segments(&self) -> &[Range<usize>] {
        &self.segments
    }

    /// Maps (N, C, H, W) to (N, outputs, H, W): logits or depths without an activation.
    ///
    /// # Panics
    /// If the input does not have the spec's channels, or if H or W is not a multiple of
    /// [`NetSpec::multiple`].
    pub fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        let [_, channels, h, w] = input.dense.dims();
        let multiple = self.spec.multiple();
        assert_eq!(channels, self.spec.dense, "channels of the input");
        assert!(
            h % multiple == 0 && w % multiple == 0,
            "{h}×{w} pixels must be multiples of {multiple}"
        );
        assert_eq!(input.one_hot.is_some(), self.spec.one_hot > 0);
        pass.compute_in(self.spec.precision);
        if !self.spec.added {
            return self.network.forward(pass, input);
        }
        let last = input.dense.clone().narrow(1, channels - 1, 1);
        self.network.forward(pass, input) + last
    }
}
