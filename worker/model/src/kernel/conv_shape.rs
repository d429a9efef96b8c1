//! The shape of a convolution, and of its packed weights.

use super::plane::Grid;

/// The number of output channels of a block of packed weights.
pub(super) const BLOCK: usize = 8;

/// A convolution of stride 1: input (images, inputs, height, width), output (images, outputs,
/// height, width), weights (outputs, inputs, k, k), all contiguous in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvShape {
    /// The number of images in the batch.
    pub images: usize,
    /// The number of input channels.
    pub inputs: usize,
    /// The number of output channels.
    pub outputs: usize,
    /// The number of rows of a plane.
    pub height: usize,
    /// The number of pixels of a row.
    pub width: usize,
}

impl ConvShape {
    /// Returns the number of values of the input.
    pub fn input_len(&self) -> usize {
        self.images * self.inputs * self.height * self.width
    }

    /// Returns the number of values of the output.
    pub fn output_len(&self) -> usize {
        self.images * self.outputs * self.height * self.width
    }

    /// Returns the number of weights of a K×K kernel.
    pub fn weight_len(&self, k: usize) -> usize {
        self.outputs * self.inputs * k * k
    }

    /// Returns the planes with the padding of a K×K kernel.
    pub(super) fn grid(&self, k: usize) -> Grid {
        Grid {
            images: self.images,
            height: self.height,
            width: self.width,
            pad: k / 2,
        }
    }

    /// Returns the shape with input and output exchanged.
    pub(super) fn swapped(&self) -> Self {
        Self {
            inputs: self.outputs,
            outputs: self.inputs,
            ..*self
        }
    }
}
