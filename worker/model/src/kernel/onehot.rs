//! The 3×3 convolution over a one-hot input, a gather of weight columns, and its weight gradient, a
//! scatter.
//!
//! The input is one bin per pixel, so each output is a sum of at most nine weights, whatever the
//! number of bins. Weights are transposed to `[tap][bin][outputs]` with one zero column for "no
//! bin"; each output sums its taps in order. The gradient adds pixels in order.

use rayon::prelude::*;

use super::conv_shape::ConvShape;
use super::plane::{Grid, split};
use super::simd::{Kernels, LANES, Lanes, Op};

/// The number of pixels of a band.
const BAND: usize = 2048;

/// A 3×3 convolution of stride 1 and padding 1 over one-hot bins: input one bin a pixel (images,
/// height, width), weights (outputs, bins, 3, 3), output (images, outputs, height, width).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OneHotShape {
    /// The number of images in the batch.
    pub images: usize,
    /// The number of bins: the input channels of the dense form.
    pub bins: usize,
    /// The number of output channels.
    pub outputs: usize,
    /// The number of rows of a plane.
    pub height: usize,
    /// The number of pixels of a row.
    pub width: usize,
}

impl OneHotShape {
    /// Returns the dense form.
    pub fn dense(&self) -> ConvShape {
        ConvShape {
            images: self.images,
            inputs: self.bins,
            outputs: self.outputs,
            height: self.height,
            width: self.width,
        }
    }

    fn grid(&self) -> Grid {
        self.dense().grid(3)
    }

    /// Returns the bins in padded planes, `[image][height + 2][width + 2]`, with `bins` for "no
    /// bin".
    fn padded(&self, bins: &[u16]) -> Vec<u32> {
        let row = self.width + 2;
        let none = u32::try_from(self.bins).expect("bins fit 32 bits");
        let mut padded = vec![none; self.images * (self.height + 2) * row];
        for (y, from) in bins.chunks_exact(self.width).enumerate() {
            let (image, y) = (y / self.height, y % self.height);
            let at = (image * (self.height + 2) + y + 1) * row + 1;
            for (to, bin) in padded[at..at + self.width].iter_mut().zip(from) {
                *to = u32::from(*bin).min(none);
            }
        }
        padded
    }
}

impl Kernels {
    /// Adds the convolution over one-hot bins to `out`. A bin of [`OneHotShape::bins`] or more
    /// (such as `u16::MAX`) means that all channels are zero at that pixel.
    pub fn onehot_conv3x3(self, s: &OneHotShape, bins: &[u16], w: &[f32], out: &mut [f32]) {
        let d = s.dense();
        assert_eq!(bins.len(), s.images * s.height * s.width, "one bin a pixel");
        assert_eq!(w.len(), d.weight_len(3), "weight length");
        assert_eq!(out.len(), d.output_len(), "output length");
        if out.is_empty() || s.bins == 0 {
            return;
        }
        let padded = s.padded(bins);
        let blocks = s.outputs.div_ceil(LANES);
        let columns = columns(s, w, blocks * LANES);
        let grid = s.grid();
        let bands = grid.bands(BAND.max(grid.pixels().div_ceil(64)));
        split(grid, s.outputs, s.outputs, &bands, out)
            .into_par_iter()
            .zip(&bands)
            .for_each(|(mut out, band)| {
                for (image, out) in band.images.clone().zip(out.chunks_exact_mut(s.outputs)) {
                    let first = image * (s.height + 2) + band.rows.start;
                    self.run(Gather {
                        bins: &padded[first * (s.width + 2)..],
                        width: s.width,
                        rows: band.rows.len(),
                        columns: &columns,
                        blocks,
                        tap: (s.bins + 1) * blocks * LANES,
                        out,
                    });
                }
            });
    }

    /// Computes the weights' gradient of [`Kernels::onehot_conv3x3`]. Writes all of `dw` (outputs,
    /// bins, 3, 3).
    pub fn onehot_conv3x3_weight_grad(
        self,
        s: &OneHotShape,
        bins: &[u16],
        dy: &[f32],
        dw: &mut [f32],
    ) {
        let d = s.dense();
        assert_eq!(bins.len(), s.images * s.height * s.width, "one bin a pixel");
        assert_eq!(dy.len(), d.output_len(), "output gradient length");
        assert_eq!(dw.len(), d.weight_len(3), "weight gradient length");
        if dy.is_empty() || s.bins == 0 {
            return dw.fill(0.0);
        }
        let padded = s.padded(bins);
        let wide = if s.outputs > LANES { 2 * LANES } else { LANES };
        let pixels = s.height * s.width;
        let g = self.transposed(s.images, s.outputs, pixels, dy, wide);
        let g: Vec<&[f32]> = g.chunks_exact(s.images * pixels * wide).collect();
        let sums: Vec<Vec<f32>> = (0..g.len() * 9)
            .into_par_iter()
            .map(|i| {
                let (block, tap) = (i / 9, i % 9);
                let mut sums = vec![0.0; (s.bins + 1) * wide];
                for image in 0..s.images {
                    let row = s.width + 2;
                    let first = (image * (s.height + 2) + tap / 3) * row + tap % 3;
                    self.run(Scatter {
                        bins: &padded[first..],
                        width: s.width,
                        g: &g[block][image * pixels * wide..(image + 1) * pixels * wide],
                        wide,
                        sums: &mut sums,
                    });
                }
                sums
            })
            .collect();
        dw.par_chunks_exact_mut(s.bins * 9)
            .enumerate()
            .for_each(|(o, dw)| {
                let sums = &sums[o / wide * 9..][..9];
                for (bin, dw) in dw.chunks_exact_mut(9).enumerate() {
                    for (dw, sums) in dw.iter_mut().zip(sums) {
                        *dw = sums[bin * wide + o % wide];
                    }
                }
            });
    }
}

/// Converts weights to `[tap][bins + 1][wide]`, with the last column zero.
fn columns(s: &OneHotShape, w: &[f32], wide: usize) -> Vec<f32> {
    let plane = (s.bins + 1) * wide;
    let mut columns = vec![0.0; 9 * plane];
    columns
        .par_chunks_exact_mut(plane)
        .enumerate()
        .for_each(|(tap, to)| {
            for (o, w) in w.chunks_exact(s.bins * 9).enumerate() {
                for (to, w) in to[o..]
                    .iter_mut()
                    .step_by(wide)
                    .zip(w[tap..].iter().step_by(9))
                {
                    *to = *w;
                }
            }
        });
    columns
}

/// The sums of one image's rows in one band.
struct Gather<'a, 'b> {
    bins: &'a [u32],
    width: usize,
    rows: usize,
    columns: &'a [f32],
    blocks: usize,
    tap: usize,
    /// The outputs, channel by channel.
    out: &'a mut [&'b mut [f32]],
}

impl Op for Gather<'_, '_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let row = self.width + 2;
        let mut tile = [[0.0; LANES]; LANES];
        for y in 0..self.rows {
            for x in (0..self.width).step_by(LANES) {
                let n = LANES.min(self.width - x);
                for b in 0..self.blocks {
                    for (i, tile) in tile.iter_mut().enumerate().take(n) {
                        let mut sum = L::splat(0.0);
                        for tap in 0..9 {
                            let bin = self.bins[(y + tap / 3) * row + x + i + tap % 3] as usize;
                            let at = tap * self.tap + (bin * self.blocks + b) * LANES;
                            sum = sum.add(L::load(&self.columns[at..]));
                        }
                        sum.store(tile);
                    }
                    let outs = self.out.iter_mut().skip(b * LANES).take(LANES);
                    for (o, out) in outs.enumerate() {
                        let out = &mut out[y * self.width + x..][..n];
                        for (out, tile) in out.iter_mut().zip(&tile) {
                            *out += tile[o];
                        }
                    }
                }
            }
        }
    }
}

/// Adds one image's gradient to the sums of its bins, for one tap.
struct Scatter<'a> {
    bins: &'a [u32],
    width: usize,
    g: &'a [f32],
    wide: usize,
    sums: &'a mut [f32],
}

impl Op for Scatter<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        for (y, g) in self.g.chunks_exact(self.width * self.wide).enumerate() {
            let bins = &self.bins[y * (self.width + 2)..][..self.width];
            for (bin, g) in bins.iter().zip(g.chunks_exact(self.wide)) {
                let sums = &mut self.sums[*bin as usize * self.wide..][..self.wide];
                for (sums, g) in sums.chunks_exact_mut(LANES).zip(g.chunks_exact(LANES)) {
                    L::load(sums).add(L::load(g)).store(sums);
                }
            }
        }
    }
}
