//! The shape of attention within windows: the pixels of each window, and the pairs of tokens that
//! are masked.

use rayon::prelude::*;

use super::simd::LANES;

/// Attention within windows. The input contains queries, keys and values in this order, (images,
/// height, width, 3·heads·size), each head after head. The output is (images, height, width,
/// heads·size).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AttentionShape {
    /// The number of images in the batch.
    pub images: usize,
    /// The number of rows of an image; a multiple of `window`.
    pub height: usize,
    /// The number of columns of an image; a multiple of `window`.
    pub width: usize,
    /// The number of rows and columns of a window.
    pub window: usize,
    /// The offset of windows from the first pixel, less than a window.
    pub shift: usize,
    /// The number of heads.
    pub heads: usize,
    /// The number of features of a head.
    pub size: usize,
    /// The value added to the scores of tokens that the shift brings together from different ends
    /// of the image.
    pub apart: f32,
}

impl AttentionShape {
    /// Returns the number of tokens of a window.
    pub fn tokens(&self) -> usize {
        self.window * self.window
    }

    /// Returns the number of features of a token.
    pub fn channels(&self) -> usize {
        self.heads * self.size
    }

    /// Returns the number of pixels of all images.
    pub fn pixels(&self) -> usize {
        self.images * self.height * self.width
    }

    /// Returns the number of tokens rounded up to whole lanes.
    pub(super) fn padded(&self) -> usize {
        self.tokens().next_multiple_of(LANES)
    }

    pub(super) fn check(&self) {
        assert!(self.window > 0 && self.shift < self.window, "windows");
        assert!(
            self.height.is_multiple_of(self.window) && self.width.is_multiple_of(self.window),
            "whole windows"
        );
    }

    /// Returns the index, among the pixels of all images, of a token of a window.
    fn pixel(&self, window: usize, token: usize) -> usize {
        let columns = self.width / self.window;
        let of_image = self.height / self.window * columns;
        let (image, at) = (window / of_image, window % of_image);
        let row = at / columns * self.window + token / self.window + self.shift;
        let column = at % columns * self.window + token % self.window + self.shift;
        (image * self.height + row % self.height) * self.width + column % self.width
    }

    /// Returns the window and the token of a pixel.
    fn token(&self, pixel: usize) -> (usize, usize) {
        let (columns, of_image) = (self.width / self.window, self.height * self.width);
        let (image, at) = (pixel / of_image, pixel % of_image);
        let row = (at / self.width + self.height - self.shift) % self.height;
        let column = (at % self.width + self.width - self.shift) % self.width;
        let window =
            image * of_image / self.tokens() + row / self.window * columns + column / self.window;
        let token = row % self.window * self.window + column % self.window;
        (window, token)
    }

    /// Returns the end of the image from which each token of a window comes, or `None` if all come
    /// from one end.
    fn regions(&self, window: usize) -> Option<Vec<u8>> {
        if self.shift == 0 {
            return None;
        }
        let columns = self.width / self.window;
        let at = window % (self.height / self.window * columns);
        let band = |at: usize, len: usize| u8::from(at >= len - self.shift);
        let region = |token: usize| {
            let row = at / columns * self.window + token / self.window;
            let column = at % columns * self.window + token % self.window;
            2 * band(row, self.height) + band(column, self.width)
        };
        let regions: Vec<u8> = (0..self.tokens()).map(region).collect();
        regions.iter().any(|r| *r != regions[0]).then_some(regions)
    }

    /// Returns the mask added to a window's scores in addition to the bias, [keys][padded queries].
    pub(super) fn mask(&self, window: usize) -> Option<Vec<f32>> {
        let regions = self.regions(window)?;
        let (tokens, padded) = (self.tokens(), self.padded());
        let mut mask = vec![0.0; tokens * padded];
        for (key, row) in mask.chunks_exact_mut(padded).enumerate() {
            for (query, to) in row[..tokens].iter_mut().enumerate() {
                if regions[query] != regions[key] {
                    *to = self.apart;
                }
            }
        }
        Some(mask)
    }

    /// Converts `bias` (heads, queries, keys) to [heads][keys][padded queries].
    pub(super) fn turned(&self, bias: &[f32]) -> Vec<f32> {
        let (tokens, padded) = (self.tokens(), self.padded());
        let mut turned = vec![0.0; self.heads * tokens * padded];
        let heads = bias.chunks_exact(tokens * tokens);
        for (from, to) in heads.zip(turned.chunks_exact_mut(tokens * padded)) {
            for (query, row) in from.chunks_exact(tokens).enumerate() {
                for (key, value) in row.iter().enumerate() {
                    to[key * padded + query] = *value;
                }
            }
        }
        turned
    }

    /// Copies the rows of a window's tokens from `x`, which has `wide` values a pixel.
    pub(super) fn gather(&self, x: &[f32], wide: usize, window: usize, to: &mut [f32]) {
        for (token, to) in to.chunks_exact_mut(wide).enumerate() {
            let at = self.pixel(window, token) * wide;
            to.copy_from_slice(&x[at..at + wide]);
        }
    }

    /// Copies the rows of all windows back, from window order to pixel order.
    pub(super) fn scatter(&self, windows: &[f32], wide: usize, to: &mut [f32]) {
        let row = self.width * wide;
        to.par_chunks_mut(row).enumerate().for_each(|(y, to)| {
            for (x, to) in to.chunks_exact_mut(wide).enumerate() {
                let (window, token) = self.token(y * self.width + x);
                let at = (window * self.tokens() + token) * wide;
                to.copy_from_slice(&windows[at..at + wide]);
            }
        });
    }
}
