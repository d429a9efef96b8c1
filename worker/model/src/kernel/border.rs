//! The operations around convolutions with repeated borders: extending images by one pixel at every
//! side, removing that border after the convolution, and leaky ReLU.

use rayon::prelude::*;

use super::simd::{Kernels, LANES, Lanes, Op};

/// The number of values in a task of elementwise operations.
const PART: usize = 1 << 14;

/// A batch of images, grouped into volumes of some moments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BorderShape {
    /// The number of images, counting each moment.
    pub images: usize,
    /// The number of consecutive images that are moments of one volume. The first and the last
    /// moment are repeated too.
    pub moments: usize,
    /// Whether the channels of the moments before and after are concatenated with those of each.
    pub volume: bool,
    /// The number of channels.
    pub channels: usize,
    /// The number of rows.
    pub height: usize,
    /// The number of columns.
    pub width: usize,
}

impl BorderShape {
    /// Returns the number of values of the images.
    pub fn len(&self) -> usize {
        self.images * self.channels * self.height * self.width
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the number of images that are concatenated in one with its border.
    fn parts(&self) -> usize {
        if self.volume { 3 } else { 1 }
    }

    fn image(&self) -> usize {
        self.channels * self.height * self.width
    }

    /// Returns the number of values of an image with its border, for one part.
    fn around(&self) -> usize {
        self.channels * (self.height + 2) * (self.width + 2)
    }

    /// Returns the index of the image used as part `part` of another.
    fn seen(&self, image: usize, part: usize) -> usize {
        if !self.volume {
            return image;
        }
        let (first, moment) = (image / self.moments * self.moments, image % self.moments);
        first + (moment + part).clamp(1, self.moments) - 1
    }
}

impl Kernels {
    /// Extends images by repeating their border. If the shape is a volume, also concatenates the
    /// moments before, at and after each. Writes all of `out`, (images, 1 or 3 times channels,
    /// height + 2, width + 2).
    pub fn surround(self, s: &BorderShape, x: &[f32], out: &mut [f32]) {
        assert_eq!(x.len(), s.len(), "input length");
        assert_eq!(
            out.len(),
            s.images * s.parts() * s.around(),
            "output length"
        );
        if s.is_empty() {
            return;
        }
        let each = out.par_chunks_exact_mut(s.around()).enumerate();
        each.for_each(|(at, out)| {
            let from = s.seen(at / s.parts(), at % s.parts()) * s.image();
            let planes = x[from..][..s.image()].chunks_exact(s.height * s.width);
            let to = out.chunks_exact_mut((s.height + 2) * (s.width + 2));
            for (plane, to) in planes.zip(to) {
                for (y, to) in to.chunks_exact_mut(s.width + 2).enumerate() {
                    let row = &plane[(y.clamp(1, s.height) - 1) * s.width..][..s.width];
                    to[0] = row[0];
                    to[1..=s.width].copy_from_slice(row);
                    to[s.width + 1] = row[s.width - 1];
                }
            }
        });
    }

    /// Computes the gradient of [`Kernels::surround`]. Writes all of `dx`.
    pub fn surround_grad(self, s: &BorderShape, dy: &[f32], dx: &mut [f32]) {
        assert_eq!(dx.len(), s.len(), "input gradient length");
        assert_eq!(
            dy.len(),
            s.images * s.parts() * s.around(),
            "gradient length"
        );
        if s.is_empty() {
            return;
        }
        let each = dx.par_chunks_exact_mut(s.image()).enumerate();
        each.for_each(|(image, dx)| {
            dx.fill(0.0);
            let first = image / s.moments * s.moments;
            let near = image.saturating_sub(1).max(first)..(image + 2).min(first + s.moments);
            for (other, part) in near.flat_map(|i| (0..s.parts()).map(move |part| (i, part))) {
                if s.seen(other, part) != image {
                    continue;
                }
                let dy = &dy[(other * s.parts() + part) * s.around()..][..s.around()];
                let planes = dx.chunks_exact_mut(s.height * s.width);
                let from = dy.chunks_exact((s.height + 2) * (s.width + 2));
                for (dx, dy) in planes.zip(from) {
                    self.run(Fold { s, dy, dx });
                }
            }
        });
    }

    /// Removes the outermost pixels of images and adds each channel's bias. Writes all of `out`,
    /// which has the shape's size; `x` has two more rows and columns.
    pub fn crop(self, s: &BorderShape, x: &[f32], bias: &[f32], out: &mut [f32]) {
        assert_eq!(x.len(), s.images * s.around(), "input length");
        assert_eq!((out.len(), bias.len()), (s.len(), s.channels), "lengths");
        if s.is_empty() {
            return;
        }
        let planes = x.par_chunks_exact((s.height + 2) * (s.width + 2));
        let planes = planes.zip(out.par_chunks_exact_mut(s.height * s.width));
        planes.enumerate().for_each(|(at, (x, out))| {
            let bias = bias[at % s.channels];
            self.run(Crop { s, x, bias, out });
        });
    }

    /// Computes the gradient of [`Kernels::crop`] for the images. Writes all of `dx`, with zeros at
    /// the border.
    pub fn crop_grad(self, s: &BorderShape, dy: &[f32], dx: &mut [f32]) {
        assert_eq!(dx.len(), s.images * s.around(), "input gradient length");
        assert_eq!(dy.len(), s.len(), "gradient length");
        if s.is_empty() {
            return;
        }
        let planes = dx.par_chunks_exact_mut((s.height + 2) * (s.width + 2));
        let planes = planes.zip(dy.par_chunks_exact(s.height * s.width));
        planes.for_each(|(dx, dy)| {
            dx.fill(0.0);
            let rows = dx.chunks_exact_mut(s.width + 2).skip(1);
            for (dx, dy) in rows.zip(dy.chunks_exact(s.width)) {
                dx[1..=s.width].copy_from_slice(dy);
            }
        });
    }

    /// Computes x where it is above 0, else `slope`·x, with a slope below 1. Writes all of `y`.
    pub fn leaky_relu(self, slope: f32, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), y.len(), "one length for all");
        let parts = x.par_chunks(PART).zip(y.par_chunks_mut(PART));
        parts.for_each(|(x, y)| self.run(Leaky { slope, x, y }));
    }

    /// Computes the gradient of [`Kernels::leaky_relu`] from its input or its output. Writes all of
    /// `dx`.
    pub fn leaky_relu_grad(self, slope: f32, x: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert_eq!(
            (x.len(), dy.len()),
            (dx.len(), dx.len()),
            "one length for all"
        );
        let parts = x.par_chunks(PART).zip(dy.par_chunks(PART));
        let parts = parts.zip(dx.par_chunks_mut(PART));
        parts.for_each(|((x, dy), dx)| self.run(LeakyGrad { slope, x, dy, dx }));
    }
}

/// Adds a plane with its border to one without.
struct Fold<'a> {
    s: &'a BorderShape,
    dy: &'a [f32],
    dx: &'a mut [f32],
}

impl Op for Fold<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let (height, width) = (self.s.height, self.s.width);
        for (y, row) in self.dy.chunks_exact(width + 2).enumerate() {
            let to = &mut self.dx[(y.clamp(1, height) - 1) * width..][..width];
            to[0] += row[0];
            to[width - 1] += row[width + 1];
            let inner = row[1..=width].chunks(LANES);
            for (from, to) in inner.zip(to.chunks_mut(LANES)) {
                let sum = L::load_part(to, 0.0).add(L::load_part(from, 0.0));
                sum.store_part(to);
            }
        }
    }
}

struct Crop<'a> {
    s: &'a BorderShape,
    x: &'a [f32],
    bias: f32,
    out: &'a mut [f32],
}

impl Op for Crop<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let width = self.s.width;
        let bias = L::splat(self.bias);
        let rows = self.x.chunks_exact(width + 2).skip(1);
        for (x, out) in rows.zip(self.out.chunks_exact_mut(width)) {
            let inner = x[1..=width].chunks(LANES);
            for (x, out) in inner.zip(out.chunks_mut(LANES)) {
                L::load_part(x, 0.0).add(bias).store_part(out);
            }
        }
    }
}

struct Leaky<'a> {
    slope: f32,
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Op for Leaky<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let slope = L::splat(self.slope);
        for (x, y) in self.x.chunks(LANES).zip(self.y.chunks_mut(LANES)) {
            let x = L::load_part(x, 0.0);
            x.mul(slope).max(x).store_part(y);
        }
    }
}

struct LeakyGrad<'a> {
    slope: f32,
    x: &'a [f32],
    dy: &'a [f32],
    dx: &'a mut [f32],
}

impl Op for LeakyGrad<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let slope = L::splat(self.slope);
        let from = self.x.chunks(LANES).zip(self.dy.chunks(LANES));
        for ((x, dy), dx) in from.zip(self.dx.chunks_mut(LANES)) {
            let dy = L::load_part(dy, 0.0);
            let above = dy.where_positive(L::load_part(x, 0.0));
            dy.sub(above).fma(slope, above).store_part(dx);
        }
    }
}
