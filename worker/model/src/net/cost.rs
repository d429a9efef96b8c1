//! The cost of a pass: multiply-adds, computed from the shape alone. Norms, activations, softmax
//! and pooling are not counted.

use super::{network::registered, spec::NetSpec};

impl NetSpec {
    /// Returns the multiply-adds of a forward pass over an image of `side`² pixels. One-hot
    /// channels count as dense ones.
    pub fn multiply_adds(&self, side: usize) -> f64 {
        (registered(self.architecture).multiply_adds)(self, side)
    }

    /// Returns the cost of the 2D decoder of both U-Nets.
    pub(super) fn of_decoder(&self, side: usize) -> f64 {
        let mut sum = 0.0;
        for (level, pair) in self.widths().windows(2).enumerate() {
            let pixels = (side >> level).pow(2);
            sum += (9 * (pair[0] + pair[1] + pair[0]) * pair[0] * pixels) as f64;
        }
        sum + (self.width * self.outputs * side * side) as f64
    }

    /// Returns the cost of the part that halves time, rows and columns: a filter for each stream, a
    /// convolution to `width` channels, and four others.
    pub(super) fn of_downsample(&self, side: usize, width: usize) -> f64 {
        let streams = self.streams();
        let voxel = 27 * (streams + streams * width + 4 * width * width);
        (voxel * self.dense.div_ceil(2) * (side / 2).pow(2)) as f64
    }

    /// Returns the cost of the part from a volume of `channels`, with half as many rows and
    /// columns, to the output.
    pub(super) fn of_rendering(&self, side: usize, channels: usize) -> f64 {
        let (pixels, coarse) = (side * side, (side / 2).pow(2));
        let (features, outputs) = (2 * channels, self.outputs);
        let images = 9 * 5 * features * features * coarse;
        let fine = (features + outputs) * 2 * features + 16 * features * features;
        let fine = 9 * (fine + 2 * features * outputs) + 2 * outputs;
        (images + fine * pixels) as f64
    }
}
