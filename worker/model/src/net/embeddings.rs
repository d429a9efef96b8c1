//! Learned feature embeddings (Chen et al., SIGGRAPH Asia 2020, released code): a volume of
//! features of half the size, its greatest values over depth and their positions, and a network
//! over those images.
//!
//! The released code transforms light between the two parts, for confocal scans of a wall; here
//! this step is the identity. All depths are kept, depth grows with time like the learned quantity,
//! and the output is not clamped because clamping would stop its gradients.

use burn::tensor::Tensor;

use super::{
    downsample::Downsample,
    network::Network,
    pass::{Input, Pass},
    rendering::{Rendering, by_channel, normalised},
    spec::NetSpec,
};
use crate::parameters::Declarations;

#[derive(Debug, Clone)]
pub(super) struct Embeddings {
    volume: Downsample,
    depth: Rendering,
}

impl Embeddings {
    pub(super) fn declare(d: &mut Declarations, spec: &NetSpec) -> Self {
        let (streams, width) = (spec.streams(), spec.width);
        Self {
            volume: Downsample::declare(d, "downnet", streams, width),
            depth: Rendering::declare(d, "depth", streams + width, spec.outputs),
        }
    }

    pub(super) fn forward(&self, pass: &Pass, input: Input) -> Tensor<4> {
        let (volume, time) = self.volume.forward(pass, input);
        let rows = volume.dims()[2];
        let volume = normalised(by_channel(volume, time));
        self.depth.forward(pass, volume, rows)
    }
}

impl Network for Embeddings {
    const OVER_TIME: bool = true;

    fn build(d: &mut Declarations, spec: &NetSpec) -> Self {
        Self::declare(d, spec)
    }

    fn multiple(_spec: &NetSpec) -> (usize, &'static str, String) {
        (2, "net.architecture", "embeddings halve the image".into())
    }

    fn multiply_adds(spec: &NetSpec, side: usize) -> f64 {
        let (streams, width) = (spec.streams(), spec.width);
        spec.of_downsample(side, width) + spec.of_rendering(side, width + streams)
    }

    fn describe(spec: &NetSpec) -> String {
        format!("learned feature embeddings, width {}", spec.width)
    }

    fn forward(&self, pass: &mut Pass, input: Input) -> Tensor<4> {
        Self::forward(self, pass, input)
    }
}
