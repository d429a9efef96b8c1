//! Convolutions of volumes as 3×3 convolutions of images.
//!
//! A volume is stored as (N·T, C, H, W), one image for each moment. The moments that a convolution
//! reads become concatenated channels. Its kernel in space is split or reordered into 3×3 kernels,
//! so every convolution uses the same 3×3 kernel code. Weights have the shapes of PyTorch's
//! `Conv3d` and `ConvTranspose3d`. The tests below compare the results with burn's own
//! three-dimensional convolution.

use burn::tensor::Tensor;

use super::pass::Pass;
use crate::ops;

/// The moments that each output of a convolution reads.
#[derive(Debug, Clone, Copy)]
pub(super) struct Seen {
    /// The number of moments, which is odd; they are centred on the output's own.
    pub taps: usize,
    /// The distance between two of these moments.
    pub apart: usize,
    /// The distance in moments from one output to the next: 1 or 2.
    pub stride: usize,
}

impl Seen {
    /// Returns the number of output moments for `time` input moments.
    pub(super) fn moments(&self, time: usize) -> usize {
        time.div_ceil(self.stride)
    }
}

/// Returns every second image of each volume, starting with the first.
pub(super) fn every_second(x: Tensor<4>, time: usize) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    let (n, half) = (images / time, time.div_ceil(2));
    let mut x = x.reshape([n, time, c * h * w]);
    if time % 2 == 1 {
        let none = Tensor::zeros([n, 1, c * h * w], &x.device());
        x = Tensor::cat(vec![x, none], 1);
    }
    x.reshape([n * half, 2, c * h * w])
        .narrow(1, 0, 1)
        .reshape([n * half, c, h, w])
}

/// Concatenates the images that each output reads as channels, with zeros beyond the ends: (N·T, C,
/// H, W) to (N·T', taps·C, H, W).
fn seen(x: Tensor<4>, time: usize, seen: Seen) -> Tensor<4> {
    let [images, c, h, w] = x.dims();
    let (n, moments) = (images / time, seen.moments(time));
    if seen.taps == 3 && seen.apart == 1 {
        let beside = ops::adjacent(x, time);
        return match seen.stride {
            1 => beside,
            _ => every_second(beside, time),
        };
    }
    let reach = seen.taps / 2 * seen.apart;
    // The input ends with the last tap of the last output.
    let after = (moments - 1) * seen.stride + reach + seen.stride - time;
    let values = c * h * w;
    let dark = |count| Tensor::zeros([n, count, values], &x.device());
    let x = Tensor::cat(
        vec![
            dark(reach),
            x.clone().reshape([n, time, values]),
            dark(after),
        ],
        1,
    );
    let each = (0..seen.taps).map(|tap| {
        let from = x.clone().narrow(1, tap * seen.apart, moments * seen.stride);
        from.reshape([n * moments, seen.stride, values])
            .narrow(1, 0, 1)
            .reshape([n * moments, c, h, w])
    });
    Tensor::cat(each.collect(), 1)
}

/// Computes a 3×3 convolution of images with a kernel (O, C, 3, 3).
fn conv3x3(pass: &Pass, x: Tensor<4>, kernel: Tensor<4>) -> Tensor<4> {
    pass.raise(ops::conv3x3(pass.lower(x), pass.lower(kernel)))
}

/// Converts (O, C, T, H, W) to a kernel for images of several moments: (O, T·C, H, W).
fn kernel(weight: Tensor<5>) -> Tensor<4> {
    let [o, c, t, h, w] = weight.dims();
    weight.swap_dims(1, 2).reshape([o, t * c, h, w])
}

/// Computes a convolution with (O, C, taps, 3, 3) and zeros beyond the ends.
pub(super) fn conv(
    pass: &Pass,
    x: Tensor<4>,
    time: usize,
    weight: Tensor<5>,
    over_time: Seen,
) -> Tensor<4> {
    conv3x3(pass, seen(x, time, over_time), kernel(weight))
}

/// Like [`conv`], but with every second pixel in space; rows and columns must be even in number.
pub(super) fn dilated(
    pass: &Pass,
    x: Tensor<4>,
    time: usize,
    weight: Tensor<5>,
    over_time: Seen,
) -> Tensor<4> {
    let x = seen(x, time, over_time);
    let [images, c, h, w] = x.dims();
    // Pixels of even and odd rows and columns do not interact, so they form four images.
    let apart = x
        .reshape([images, c, h / 2, 2, w / 2, 2])
        .permute([0, 3, 5, 1, 2, 4])
        .reshape([4 * images, c, h / 2, w / 2]);
    let y = conv3x3(pass, apart, kernel(weight));
    let outputs = y.dims()[1];
    y.reshape([images, 2, 2, outputs, h / 2, w / 2])
        .permute([0, 3, 4, 1, 5, 2])
        .reshape([images, outputs, h, w])
}

/// Converts (O, C, T, 5, 5) to (O, T·C, 6, 6), with zeros in the last row and column.
fn kernel6(weight: Tensor<5>) -> Tensor<4> {
    let weight = kernel(weight);
    let [o, c, ..] = weight.dims();
    let column = Tensor::zeros([o, c, 5, 1], &weight.device());
    let row = Tensor::zeros([o, c, 1, 6], &weight.device());
    Tensor::cat(vec![Tensor::cat(vec![weight, column], 3), row], 2)
}

/// Computes a convolution with (O, C, 5, 5, 5) and zeros beyond the ends.
pub(super) fn conv5(
    pass: &Pass,
    x: Tensor<4>,
    time: usize,
    weight: Tensor<5>,
    over_time: Seen,
) -> Tensor<4> {
    let x = seen(x, time, over_time);
    let [images, c, h, w] = x.dims();
    let weight = kernel6(weight);
    let outputs = weight.dims()[0];
    // Four 3×3 kernels, with centres one pixel before and two pixels after the output's pixel.
    let weight = weight
        .reshape([outputs, c, 2, 3, 2, 3])
        .permute([2, 4, 0, 1, 3, 5])
        .reshape([4 * outputs, c, 3, 3]);
    let dark = |shape: [usize; 4]| Tensor::zeros(shape, &x.device());
    let (before, after) = (dark([images, c, 1, w]), dark([images, c, 2, w]));
    let tall = Tensor::cat(vec![before, x.clone(), after], 2);
    let (before, after) = (dark([images, c, h + 3, 1]), dark([images, c, h + 3, 2]));
    let y = conv3x3(pass, Tensor::cat(vec![before, tall, after], 3), weight);
    let part = |which: usize| {
        let (row, column) = (which / 2 * 3, which % 2 * 3);
        y.clone()
            .narrow(1, which * outputs, outputs)
            .narrow(2, row, h)
            .narrow(3, column, w)
    };
    part(0) + part(1) + (part(2) + part(3))
}

/// Computes a convolution with (O, C, 5, 5, 5) at every second row and column, and zeros beyond the
/// ends: (N·T, C, H, W) to (N·T, O, H/2, W/2).
pub(super) fn conv5_halved(pass: &Pass, x: Tensor<4>, time: usize, weight: Tensor<5>) -> Tensor<4> {
    let over_time = Seen {
        taps: 5,
        apart: 1,
        stride: 1,
    };
    let x = seen(x, time, over_time);
    let [images, c, h, w] = x.dims();
    let weight = kernel6(weight);
    let outputs = weight.dims()[0];
    // Two rows and two columns become the channels of one pixel, so six taps become three.
    let weight = weight
        .reshape([outputs, c, 3, 2, 3, 2])
        .permute([0, 3, 5, 1, 2, 4])
        .reshape([outputs, 4 * c, 3, 3]);
    let x = x
        .reshape([images, c, h / 2, 2, w / 2, 2])
        .permute([0, 3, 5, 1, 2, 4])
        .reshape([images, 4 * c, h / 2, w / 2]);
    conv3x3(pass, x, weight)
}

/// Computes a transposed convolution with (C, O, 6, 3, 3), stride 2 in time, padding 2 there and 1
/// in space: (N·T, C, H, W) to (N·2T, O, H, W).
pub(super) fn doubled_in_time(
    pass: &Pass,
    x: Tensor<4>,
    time: usize,
    weight: Tensor<5>,
) -> Tensor<4> {
    let [images, _, h, w] = x.dims();
    let [c, o, ..] = weight.dims();
    // An even moment uses taps 4, 2 and 0 of the moments before, at and after it, an odd one taps
    // 5, 3 and 1.
    let weight = weight
        .reshape([c, o, 3, 2, 3, 3])
        .flip([2, 4, 5])
        .permute([3, 1, 2, 0, 4, 5])
        .reshape([2 * o, 3 * c, 3, 3]);
    let y = conv3x3(pass, ops::adjacent(x, time), weight);
    y.reshape([2 * images, o, h, w])
}

/// Computes a transposed convolution with (C, O, 3, 6, 6), stride 2 in space, padding 2 there and 1
/// in time: (N·T, C, H, W) to (N·T, O, 2H, 2W).
pub(super) fn doubled_in_space(
    pass: &Pass,
    x: Tensor<4>,
    time: usize,
    weight: Tensor<5>,
) -> Tensor<4> {
    let [images, _, h, w] = x.dims();
    let [c, o, ..] = weight.dims();
    let weight = weight
        .reshape([c, o, 3, 3, 2, 3, 2])
        .flip([2, 3, 5])
        .permute([4, 6, 1, 2, 0, 3, 5])
        .reshape([4 * o, 3 * c, 3, 3]);
    let y = conv3x3(pass, ops::adjacent(x, time), weight);
    y.reshape([images, 2, 2, o, h, w])
        .permute([0, 3, 4, 1, 5, 2])
        .reshape([images, o, 2 * h, 2 * w])
}

/// Computes a convolution with (O, C, 3, 3, 3) at every second moment, with borders repeated in
/// time and space. The result is (N·⌈T/2⌉, O, H + 2, W + 2); its outermost pixels have no meaning.
pub(super) fn conv_bordered_halved(
    pass: &Pass,
    x: Tensor<4>,
    time: usize,
    weight: Tensor<5>,
) -> Tensor<4> {
    let around = every_second(ops::surround(x, time, true), time);
    conv3x3(pass, around, kernel(weight))
}

#[cfg(test)]
mod tests {
    use burn::tensor::{
        Device, TensorData,
        module::{conv_transpose3d, conv3d},
        ops::{ConvOptions, ConvTransposeOptions},
    };

    use super::*;
    use crate::{Random, ops::plain::bordered};

    fn numbers<const D: usize>(shape: [usize; D], stream: u64) -> Tensor<D> {
        let mut random = Random::new(3, &[stream]);
        let count = shape.iter().product();
        let values: Vec<f32> = (0..count).map(|_| random.normal()).collect();
        Tensor::from_data(TensorData::new(values, shape), &Device::flex())
    }

    /// Converts (N, C, T, H, W) to images of moments.
    fn images(x: Tensor<5>) -> Tensor<4> {
        let [n, c, t, h, w] = x.dims();
        x.swap_dims(1, 2).reshape([n * t, c, h, w])
    }

    fn same(found: Tensor<4>, expected: Tensor<5>, what: &str) {
        let expected = images(expected);
        assert_eq!(found.dims(), expected.dims(), "{what}");
        let apart: f32 = (found - expected).abs().max().into_scalar();
        assert!(apart < 1e-4, "{what}: {apart}");
    }

    /// Returns volumes of 2 images with 3 channels and 8×12 pixels, with an even and an odd number
    /// of moments.
    fn volumes() -> impl Iterator<Item = (usize, Tensor<5>)> {
        [6, 7]
            .into_iter()
            .map(|time| (time, numbers([2, 3, time, 8, 12], 1)))
    }

    #[test]
    fn convolutions_of_volumes_are_those_in_three_dimensions() {
        let pass = Pass::training(&[], &[]);
        let options = |stride: [usize; 3], pad, dilation| {
            ConvOptions::new(stride, [pad; 3], [dilation; 3], 1)
        };
        let (three, five) = (numbers([4, 3, 3, 3, 3], 2), numbers([4, 3, 5, 5, 5], 3));
        for (time, x) in volumes() {
            for stride in [1, 2] {
                let over_time = |taps, apart| Seen {
                    taps,
                    apart,
                    stride,
                };
                let strides = [stride, 1, 1];
                let of =
                    |weight: &Tensor<5>, options| conv3d(x.clone(), weight.clone(), None, options);
                let y = conv(
                    &pass,
                    images(x.clone()),
                    time,
                    three.clone(),
                    over_time(3, 1),
                );
                same(y, of(&three, options(strides, 1, 1)), "3");
                let y = dilated(
                    &pass,
                    images(x.clone()),
                    time,
                    three.clone(),
                    over_time(3, 2),
                );
                same(y, of(&three, options(strides, 2, 2)), "3 with gaps");
                let y = conv5(
                    &pass,
                    images(x.clone()),
                    time,
                    five.clone(),
                    over_time(5, 1),
                );
                same(y, of(&five, options(strides, 2, 1)), "5");
            }
            let y = conv5_halved(&pass, images(x.clone()), time, five.clone());
            let expected = conv3d(x.clone(), five.clone(), None, options([1, 2, 2], 2, 1));
            same(y, expected, "5, halved");

            let around = bordered(bordered(bordered(x.clone(), 2), 3), 4);
            let expected = conv3d(around, three.clone(), None, options([2, 1, 1], 0, 1));
            let y = conv_bordered_halved(&pass, images(x), time, three.clone());
            let y = y.narrow(2, 1, 8).narrow(3, 1, 12);
            same(y, expected, "3 with borders");
        }
    }

    #[test]
    fn transposed_convolutions_of_volumes_are_those_in_three_dimensions() {
        let pass = Pass::training(&[], &[]);
        let options = |stride, pad| ConvTransposeOptions::new(stride, pad, [0; 3], [1; 3], 1);
        let (long, wide) = (numbers([3, 4, 6, 3, 3], 2), numbers([3, 4, 3, 6, 6], 3));
        for (time, x) in volumes() {
            let expected =
                conv_transpose3d(x.clone(), long.clone(), None, options([2, 1, 1], [2, 1, 1]));
            let y = doubled_in_time(&pass, images(x.clone()), time, long.clone());
            same(y, expected, "in time");
            let expected =
                conv_transpose3d(x.clone(), wide.clone(), None, options([1, 2, 2], [1, 2, 2]));
            let y = doubled_in_space(&pass, images(x), time, wide.clone());
            same(y, expected, "in space");
        }
    }
}
