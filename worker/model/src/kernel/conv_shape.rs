//! The shape of a convolution, and of its packed weights.

use super::plane::Grid;

/// Output channels of a block of packed weights.
pub(super) const BLOCK: usize = 8;

/// A convolution of stride 1: input (images, inputs, height, width), output (images, outputs, height,
/// width), weights (outputs, inputs, k, k), all contiguous in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvShape {
    /// Images in the batch.
    pub images: usize,
    /// Input channels.
    pub inputs: usize,
    /// Output channels.
    pub outputs: usize,
    /// Rows of a plane.
    pub height: usize,
    /// Pixels of a row.
    pub width: usize,
}

impl ConvShape {
    /// Values of the input.
    pub fn input_len(&self) -> usize {
        self.images * self.inputs * self.height * self.width
    }

    /// Values of the output.
    pub fn output_len(&self) -> usize {
        self.images * self.outputs * self.height * self.width
    }

    /// Values of the weights of a K×K kernel.
    pub fn weight_len(&self, k: usize) -> usize {
        self.outputs * self.inputs * k * k
    }

    /// The planes with the padding of a K×K kernel.
    pub(super) fn grid(&self, k: usize) -> Grid {
        Grid {
            images: self.images,
            height: self.height,
            width: self.width,
            pad: k / 2,
        }
    }

    /// The same with input and output exchanged.
    pub(super) fn swapped(&self) -> Self {
        Self {
            inputs: self.outputs,
            outputs: self.inputs,
            ..*self
        }
    }
}
