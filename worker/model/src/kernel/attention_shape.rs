//! The shape of attention within windows: which pixels a window holds, and which of its pairs are apart.

use rayon::prelude::*;

use super::simd::LANES;

/// Attention within windows: queries, keys and values beside each other, (images, height, width, 3·heads·size), each head after
/// head, to (images, height, width, heads·size).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AttentionShape {
    /// Images in the batch.
    pub images: usize,
    /// Rows of an image; a multiple of `window`.
    pub height: usize,
    /// Columns of an image; a multiple of `window`.
    pub width: usize,
    /// Rows and columns of a window.
    pub window: usize,
    /// How far windows lie from the first pixel, less than a window.
    pub shift: usize,
    /// Heads.
    pub heads: usize,
    /// Features of a head.
    pub size: usize,
    /// Added to the scores of tokens that the shift brings together from different ends of the image.
    pub apart: f32,
}

impl AttentionShape {
    /// Tokens of a window.
    pub fn tokens(&self) -> usize {
        self.window * self.window
    }

    /// Features of a token.
    pub fn channels(&self) -> usize {
        self.heads * self.size
    }

    /// Pixels of all images.
    pub fn pixels(&self) -> usize {
        self.images * self.height * self.width
    }

    /// Tokens rounded up to whole lanes.
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

    /// The pixel, of all images, where a token of a window lies.
    fn pixel(&self, window: usize, token: usize) -> usize {
        let columns = self.width / self.window;
        let of_image = self.height / self.window * columns;
        let (image, at) = (window / of_image, window % of_image);
        let row = at / columns * self.window + token / self.window + self.shift;
        let column = at % columns * self.window + token % self.window + self.shift;
        (image * self.height + row % self.height) * self.width + column % self.width
    }

    /// The window and the token of a pixel.
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

    /// For each token of a window, from which ends of the image it comes; none where all come from one.
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

    /// What is added to a window's scores besides the bias, [keys][padded queries].
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

    /// `bias` (heads, queries, keys) as [heads][keys][padded queries].
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

    /// The rows of a window's tokens, one after the other, of `x` with `wide` values a pixel.
    pub(super) fn gather(&self, x: &[f32], wide: usize, window: usize, to: &mut [f32]) {
        for (token, to) in to.chunks_exact_mut(wide).enumerate() {
            let at = self.pixel(window, token) * wide;
            to.copy_from_slice(&x[at..at + wide]);
        }
    }

    /// The reverse for all windows: rows window by window to rows pixel by pixel.
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
