//! The memory of networks: weights, values stored by passes, and the optimiser's state.

use picofarm_settings::{Architecture, Swin};

use super::shape::{BIN, Shape};

/// Copies of the weights in a training: their values, the optimiser's two moments, gradients, and a
/// checkpoint of the first three on its way to the store.
const LEARNT: f64 = 7.0;
/// Bytes of a value that a forward pass stores for the backward pass, in 32 bits, including values
/// that are computed from it at the same time.
const KEPT: f64 = 5.0;
/// The same if time is a dimension, because more gradients of three adjacent moments exist at once.
const KEPT_OF_TIME: f64 = 7.0;
/// Feature maps of the finest level that exist at once during inference.
const LIVE: f64 = 7.0;
/// The same for the widest convolution, which is computed in a transformed form of four times the
/// values on either side.
const WIDEST: f64 = 8.0;

/// The shape of a network, as far as memory depends on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Network {
    /// The scenes from which it learns.
    pub scene: Shape,
    /// Channels of the input, one-hot ones included.
    pub inputs: f64,
    /// Input channels that take memory. One-hot channels are stored as numbers.
    pub dense: f64,
    /// Channels of the first level.
    pub width: f64,
    /// Levels.
    pub levels: u32,
    /// Moments of the time axis of a 2.5D network; 1 for a 2D one.
    pub time: f64,
    /// Channels of a projection before the first level; 0 means none.
    pub stem: f64,
    /// Weights of that projection for each pair of channels.
    pub stem_taps: f64,
    /// Architecture.
    pub architecture: Architecture,
    /// Groups and blocks of a SwinIR.
    pub swin: Swin,
}

/// Feature maps that a transformer block stores for the backward pass: norms, queries, keys,
/// values, sums and the perceptron. Scores of attention are not included, because the gradient
/// recomputes them.
const BLOCK: f64 = 15.0;

impl Network {
    /// Returns inputs, middle and outputs of each level's encoder, from the finest.
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

    /// Returns the bytes of the weights: 3×3 convolutions (3×3×3 in the encoder of a 2.5D network).
    pub fn weights(&self) -> f64 {
        match self.architecture {
            Architecture::Unet2d | Architecture::Unet25d => {}
            Architecture::Swinir => return BIN * self.swin_weights(),
            Architecture::Embeddings => {
                let [width, streams, flat] = self.embedded();
                let volume = 27.0 * (streams * width + 4.0 * width * width);
                return BIN * (volume + 9.0 * (5.0 + 2.0 + 16.0) * flat * flat);
            }
            Architecture::Nlost => {
                // 3×3×3 around the middle, 5×5×5 three times, transposed ones, and layers of
                // attention.
                let c = self.width;
                let volume = 27.0 * (6.0 + 2.0 + 3.0) * c * c + 3.0 * 125.0 * c * c;
                let transposed = (108.0 + 2.0 * 54.0 * (0.5 + 0.125 + 0.25)) * c * c;
                let [_, streams, _] = self.embedded();
                let ends = 27.0 * 1.5 * c * (streams + 3.0);
                return BIN * (volume + transposed + ends + 56.0 * c * c);
            }
        }
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

    /// Returns the number of values that a pass over one image stores for the backward pass: for
    /// each convolution its input, its output and the normalized output.
    fn kept(&self, source: &Shape) -> f64 {
        if self.architecture == Architecture::Swinir {
            let blocks = f64::from(self.swin.groups * self.swin.depth);
            let convolutions = 3.0 * f64::from(self.swin.groups + 3);
            let values = self.width * (convolutions + blocks * BLOCK);
            return source.pixels() * (self.dense + values);
        }
        if self.architecture == Architecture::Embeddings {
            let [width, streams, flat] = self.embedded();
            // An eighth of the voxels: the inputs of the first convolutions, and four others with
            // their neighbourhoods (fitted to processes that trained).
            let voxels = source.pixels() * self.dense / 8.0;
            let volume = voxels * (2.0 * 27.0 * streams + 4.0 * 4.5 * width + 4.0 * flat);
            return volume + source.pixels() * (self.dense + 30.0 * flat);
        }
        if self.architecture == Architecture::Nlost {
            return self.kept_of_nlost(source);
        }
        let mut sum = source.pixels() * (self.dense + 2.0 * self.stem);
        for (level, [inputs, between, outputs]) in self.encoders().enumerate() {
            // A quarter of the pixels for each level, and half of the moments.
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

    /// Returns the number of values that a pass of NLOST over one image stores, in a volume of a
    /// quarter of the pixels. Processes that trained at eight sizes took 0.76 to 0.94 of the
    /// resulting memory.
    fn kept_of_nlost(&self, source: &Shape) -> f64 {
        let [c, streams, _] = self.embedded();
        let features = streams + 3.0;
        let pixels = source.pixels() / 4.0;
        let half = pixels * self.dense / 2.0;
        // The inputs of convolutions, three or five adjacent moments, are stored with their
        // outputs.
        let first = half * (2.0 * 27.0 * streams + 4.0 * 4.5 * 3.0 + 8.0 * features);
        let scales = half / 2.0 * (12.0 * features + 12.0 * c);
        let halved = half / 4.0 * (15.0 * c + 4.0 * 4.5 * c);
        let embedded = half / 8.0 * 24.0 * c;
        let joined = half / 2.0 * (16.0 * c + 4.0 * features);
        // Sixteenths of the moments: local and global attention, decoders, and their upsampling to
        // more moments.
        let tokens = half / 16.0;
        let attention = tokens * (60.0 * c + 3.0 * pixels / 4.0);
        first
            + scales
            + halved
            + embedded
            + joined
            + attention
            + source.pixels() * (self.dense + 60.0 * features)
    }

    /// Returns the channels of the volume, the streams, and the channels of the resulting images.
    fn embedded(&self) -> [f64; 3] {
        let streams = (self.inputs / self.dense.max(1.0)).ceil();
        [self.width, streams, 2.0 * (self.width + streams)]
    }

    /// Returns the number of weights of a SwinIR.
    fn swin_weights(&self) -> f64 {
        let (e, swin) = (self.width, &self.swin);
        let places = f64::from(2 * swin.window - 1).powi(2);
        let block = 8.0 * e * e + 11.0 * e + places * f64::from(swin.heads);
        let convolutions = self.inputs + e * f64::from(swin.groups + 1) + 1.0;
        9.0 * e * convolutions + f64::from(swin.groups * swin.depth) * block
    }

    /// Returns the bytes of a training with `images` images at a time.
    pub(in crate::spec) fn learn(&self, source: &Shape, images: u32) -> f64 {
        let images = f64::from(images);
        // Two batches wait for the network.
        let batches = 2.0 * images * BIN * source.pixels() * self.dense;
        let kept = if self.time > 1.0 { KEPT_OF_TIME } else { KEPT };
        LEARNT * self.weights() + kept * images * self.kept(source) + batches
    }

    /// Returns the bytes of an inference on one image, weights included.
    pub(in crate::spec) fn ask(&self, source: &Shape) -> f64 {
        match self.architecture {
            Architecture::Unet2d | Architecture::Unet25d => {}
            Architecture::Swinir => {
                let values = self.dense + (LIVE + BLOCK) * self.width;
                return self.weights() + BIN * source.pixels() * values;
            }
            Architecture::Embeddings | Architecture::Nlost => {
                return self.weights() + BIN * self.kept(source);
            }
        }
        let widest = self
            .encoders()
            .next()
            .map_or(0.0, |[_, between, outputs]| between.max(outputs));
        let maps =
            BIN * source.pixels() * (self.dense + LIVE * self.width + WIDEST * widest) * self.time;
        self.weights() + maps
    }
}
