//! What every network provides, and the registry of networks. All other code asks the registry: to
//! remove a network, remove its line and its files.

use std::{fmt, sync::Arc};

use burn::tensor::Tensor;

use super::{
    embeddings::Embeddings,
    nlost::Nlost,
    pass::{Input, Pass},
    spec::{Architecture, NetSpec},
    swinir::Swinir,
    unet2d::Unet2d,
    unet25d::Unet25d,
};
use crate::{ModelError, parameters::Declarations};

/// A network: what follows from its spec, and its forward pass.
pub(super) trait Network: fmt::Debug + Send + Sync {
    /// Whether the network has a decoder on an encoder's features, which may be frozen.
    const HAS_ENCODER: bool = false;
    /// Whether a convolution may be in front of the first level.
    const HAS_STEM: bool = false;
    /// Whether the last layer may begin with zeros ([`NetSpec::added`]).
    const ADDS: bool = false;
    /// Whether time is a dimension. Both streams of the input then have the same bins.
    const OVER_TIME: bool;

    /// Declares the parameters.
    fn build(d: &mut Declarations, spec: &NetSpec) -> Self
    where
        Self: Sized;

    /// Returns the required divisor of the image's width and height, the setting that determines
    /// it, and the reason.
    fn multiple(spec: &NetSpec) -> (usize, &'static str, String)
    where
        Self: Sized;

    /// Checks the settings that only this network has.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] naming the field.
    fn check(_spec: &NetSpec) -> Result<(), ModelError>
    where
        Self: Sized,
    {
        Ok(())
    }

    /// Returns the multiply-adds of a forward pass over an image of `side`² pixels.
    fn multiply_adds(spec: &NetSpec, side: usize) -> f64
    where
        Self: Sized;

    /// Describes the network for reports.
    fn describe(spec: &NetSpec) -> String
    where
        Self: Sized;

    /// Maps (N, C, H, W) to (N, outputs, H, W).
    fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4>;
}

/// A row of the registry.
pub(super) struct Row {
    pub has_encoder: bool,
    pub has_stem: bool,
    pub adds: bool,
    pub over_time: bool,
    pub build: fn(&mut Declarations, &NetSpec) -> Arc<dyn AnyNetwork>,
    pub multiple: fn(&NetSpec) -> (usize, &'static str, String),
    pub check: fn(&NetSpec) -> Result<(), ModelError>,
    pub multiply_adds: fn(&NetSpec, usize) -> f64,
    pub describe: fn(&NetSpec) -> String,
}

/// The forward pass of any network.
pub(super) trait AnyNetwork: fmt::Debug + Send + Sync {
    /// See [`Network::forward`].
    fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4>;
}

impl<N: Network> AnyNetwork for N {
    fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        Network::forward(self, pass, input)
    }
}

impl Row {
    fn new<N: Network + 'static>() -> Self {
        Self {
            has_encoder: N::HAS_ENCODER,
            has_stem: N::HAS_STEM,
            adds: N::ADDS,
            over_time: N::OVER_TIME,
            build: |d, spec| Arc::new(N::build(d, spec)),
            multiple: N::multiple,
            check: N::check,
            multiply_adds: N::multiply_adds,
            describe: N::describe,
        }
    }
}

/// Returns the network of an architecture.
pub(super) fn registered(architecture: Architecture) -> Row {
    match architecture {
        Architecture::Unet2d => Row::new::<Unet2d>(),
        Architecture::Unet25d => Row::new::<Unet25d>(),
        Architecture::Swinir => Row::new::<Swinir>(),
        Architecture::Embeddings => Row::new::<Embeddings>(),
        Architecture::Nlost => Row::new::<Nlost>(),
    }
}
