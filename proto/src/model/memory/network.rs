//! What networks take: weights, what passes keep, and what the optimiser keeps.

use super::shape::{BIN, Shape};

/// Copies of the weights in a training: their values, the optimiser's two moments, gradients, and a checkpoint of the
/// first three on its way to the store.
const LEARNT: f64 = 7.0;
/// Bytes of a value that a pass keeps for its way back, in 32 bits, with what is computed from it at the same time.
const KEPT: f64 = 5.0;
/// Feature maps of the finest level that live at once when a network is asked.
const LIVE: f64 = 7.0;
/// The same of the widest convolution, which is computed in a transformed form of four times the values on either side.
const WIDEST: f64 = 8.0;

/// The shape of a network, as far as memory depends on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Network {
    /// The scenes that it learns from.
    pub scene: Shape,
    /// Channels of the input, one-hot ones included.
    pub inputs: f64,
    /// Of them, those that take memory: one-hot channels are kept as numbers.
    pub dense: f64,
    /// Channels of the first level.
    pub width: f64,
    /// Levels.
    pub levels: u32,
    /// Moments of the time axis of a 2.5D network; 1 for a 2D one.
    pub time: f64,
    /// Channels of a projection before the first level; 0 = none.
    pub stem: f64,
    /// Weights of that projection for each pair of channels.
    pub stem_taps: f64,
}

impl Network {
    /// Inputs, middle and outputs of each level's encoder, from the finest.
    fn encoders(&self) -> impl Iterator<Item = [f64; 3]> {
        let first = match (self.time > 1.0, self.stem > 0.0) {
            (true, _) => (self.inputs / self.dense.max(1.0)).ceil(),
            (false, true) => self.stem,
            (false, false) => self.inputs,
        };
        let width = self.width;
        (0..self.levels).map(move |level| {
            let outputs = width * f64::from(1u32 << level);
            let inputs = if level == 0 { first } else { outputs / 2.0 };
            [inputs, inputs.max(outputs / 2.0), outputs]
        })
    }

    /// Bytes of its weights: 3×3 convolutions (3×3×3 in the encoder of a 2.5D network).
    pub fn weights(&self) -> f64 {
        let taps = if self.time > 1.0 { 27.0 } else { 9.0 };
        let encoders: f64 = self
            .encoders()
            .map(|[a, b, c]| taps * (a * b + b * c))
            .sum();
        let decoders: f64 = self
            .encoders()
            .take(self.levels.saturating_sub(1) as usize)
            .map(|[_, _, c]| 9.0 * (3.0 * c * c + c * c))
            .sum();
        let stem = self.stem_taps * self.inputs * self.stem + self.inputs * self.time;
        BIN * (encoders + decoders + stem)
    }

    /// Values that a pass over one image keeps for its way back: of each convolution what goes in, what comes out, and
    /// what the norm makes of it.
    fn kept(&self, source: &Shape) -> f64 {
        let mut sum = source.pixels() * (self.dense + 2.0 * self.stem);
        for (level, [inputs, between, outputs]) in self.encoders().enumerate() {
            // A quarter of the pixels a level, and half of the moments.
            let scale = f64::from(1u32 << (2 * level));
            let time = (self.time / f64::from(1u32 << level)).max(1.0);
            let beside = if self.time > 1.0 {
                3.0 * (inputs + between)
            } else {
                0.0
            };
            let values = 2.0 * (between + outputs) + beside;
            let decoder = if level + 1 < self.levels as usize {
                7.0 * outputs
            } else {
                0.0
            };
            sum += source.pixels() / scale * (values * time + decoder);
        }
        sum
    }

    /// Bytes that a training takes, `images` at a time.
    pub(in crate::model) fn learn(&self, source: &Shape, images: u32) -> f64 {
        let images = f64::from(images);
        // Two batches wait for the network.
        let batches = 2.0 * images * BIN * source.pixels() * self.dense;
        LEARNT * self.weights() + KEPT * images * self.kept(source) + batches
    }

    /// Bytes that asking it about one image takes, its weights included.
    pub(in crate::model) fn ask(&self, source: &Shape) -> f64 {
        let widest = self
            .encoders()
            .next()
            .map_or(0.0, |[_, between, outputs]| between.max(outputs));
        let maps =
            BIN * source.pixels() * (self.dense + LIVE * self.width + WIDEST * widest) * self.time;
        self.weights() + maps
    }
}
