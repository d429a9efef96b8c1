//! A picture to draw on: scaled images and small captions.

use font8x8::UnicodeFonts;
use picofarm_scene::export::rgb_png;

use crate::error::Result;

/// 8-bit RGB, row-major.
pub struct Canvas {
    pub width: usize,
    pub height: usize,
    pixels: Vec<[u8; 3]>,
}

/// Height of a caption in pixels.
pub const TEXT: usize = 8;

impl Canvas {
    pub fn new(width: usize, height: usize, colour: [u8; 3]) -> Self {
        Self {
            width,
            height,
            pixels: vec![colour; width * height],
        }
    }

    pub fn set(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        if x < self.width && y < self.height {
            self.pixels[y * self.width + x] = colour;
        }
    }

    /// Draws an image of `size` (w, h) into a square of `cell` pixels at (x, y): box-filtered where it
    /// shrinks, nearest where it grows.
    pub fn image(
        &mut self,
        at: (usize, usize),
        cell: usize,
        size: (usize, usize),
        colour: impl Fn(usize) -> [u8; 3],
    ) {
        let (w, h) = size;
        let span = |k: usize, n: usize| (k * n / cell, ((k + 1) * n / cell).max(k * n / cell + 1));
        for row in 0..cell {
            let (r0, r1) = span(row, h);
            for column in 0..cell {
                let (c0, c1) = span(column, w);
                let mut sum = [0u32; 3];
                for r in r0..r1 {
                    for c in c0..c1 {
                        let v = colour(r * w + c);
                        (0..3).for_each(|k| sum[k] += u32::from(v[k]));
                    }
                }
                let n = ((r1 - r0) * (c1 - c0)) as u32;
                self.set(at.0 + column, at.1 + row, sum.map(|s| (s / n) as u8));
            }
        }
    }

    /// Writes a caption with its upper left corner at (x, y).
    pub fn text(&mut self, x: usize, y: usize, text: &str, colour: [u8; 3]) {
        for (i, letter) in text.chars().enumerate() {
            let glyph = font8x8::BASIC_FONTS.get(letter).unwrap_or_default();
            for (row, bits) in glyph.iter().enumerate() {
                for column in (0..8).filter(|c| bits >> c & 1 == 1) {
                    self.set(x + i * 8 + column, y + row, colour);
                }
            }
        }
    }

    /// A small cross.
    pub fn cross(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        for d in 0..7 {
            self.set((x + d).wrapping_sub(3), y, colour);
            self.set(x, (y + d).wrapping_sub(3), colour);
        }
    }

    /// The picture as a PNG.
    pub fn png(&self) -> Vec<u8> {
        let pixels = self.pixels.as_flattened();
        rgb_png(self.width as u32, self.height as u32, pixels)
    }

    /// Writes a PNG, whole or not at all.
    pub fn save(&self, path: &std::path::Path) -> Result<()> {
        super::write_atomically(path, &self.png())
    }
}
