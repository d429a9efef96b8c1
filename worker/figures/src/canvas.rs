//! A picture to draw on, with scaled images and small captions.

use std::io::Cursor;

use font8x8::UnicodeFonts;

use crate::rgb_png;

/// Maximum number of pixels of a decoded picture.
const MOST_PIXELS: usize = 1 << 24;

/// 8-bit RGB, row-major.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Canvas {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    pixels: Vec<[u8; 3]>,
}

/// Height of a caption in pixels.
pub const TEXT: usize = 8;

impl Canvas {
    /// Returns a picture of one colour.
    pub fn new(width: usize, height: usize, colour: [u8; 3]) -> Self {
        Self {
            width,
            height,
            pixels: vec![colour; width * height],
        }
    }

    /// Sets a pixel; pixels outside of the picture are ignored.
    pub fn set(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        if x < self.width && y < self.height {
            self.pixels[y * self.width + x] = colour;
        }
    }

    /// Draws an image of `size` (w, h) into a square of `cell` pixels at (x, y): box-filtered if it
    /// shrinks, nearest neighbour if it grows.
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

    /// Draws another picture with its upper left corner at (x, y).
    pub fn paste(&mut self, at: (usize, usize), other: &Self) {
        for (k, colour) in other.pixels.iter().enumerate() {
            self.set(at.0 + k % other.width, at.1 + k / other.width, *colour);
        }
    }

    /// Returns the part of `size` (w, h) with its upper left corner at (x, y); `None` if it exceeds
    /// the picture.
    pub fn part(&self, (x, y): (usize, usize), (w, h): (usize, usize)) -> Option<Self> {
        if x + w > self.width || y + h > self.height {
            return None;
        }
        let row = |row: usize| &self.pixels[row * self.width + x..][..w];
        Some(Self {
            width: w,
            height: h,
            pixels: (y..y + h).flat_map(row).copied().collect(),
        })
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

    /// Draws a small cross.
    pub fn cross(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        for d in 0..7 {
            self.set((x + d).wrapping_sub(3), y, colour);
            self.set(x, (y + d).wrapping_sub(3), colour);
        }
    }

    /// Encodes the picture as a PNG.
    pub fn png(&self) -> Vec<u8> {
        let pixels = self.pixels.as_flattened();
        rgb_png(self.width as u32, self.height as u32, pixels)
    }

    /// Decodes a picture written by [`Self::png`].
    ///
    /// # Errors
    /// A description of the problem: not a PNG of 8-bit RGB, or more than 16 million pixels.
    pub fn from_png(bytes: &[u8]) -> Result<Self, String> {
        let damaged = |e: png::DecodingError| format!("is no readable PNG ({e})");
        let mut reader = png::Decoder::new(Cursor::new(bytes))
            .read_info()
            .map_err(damaged)?;
        let info = reader.info();
        let (width, height) = (info.width as usize, info.height as usize);
        if (info.color_type, info.bit_depth) != (png::ColorType::Rgb, png::BitDepth::Eight) {
            return Err("is no PNG of 8-bit RGB".into());
        }
        if width.saturating_mul(height) > MOST_PIXELS {
            return Err(format!(
                "has {width}x{height} pixels, expected at most {MOST_PIXELS}"
            ));
        }
        let mut pixels = vec![[0; 3]; width * height];
        reader
            .next_frame(pixels.as_flattened_mut())
            .map_err(damaged)?;
        Ok(Self {
            width,
            height,
            pixels,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_comes_back_from_its_png_and_parts_are_cut_out_of_it() {
        let mut canvas = Canvas::new(40, 20, [1, 2, 3]);
        canvas.text(3, 4, "m", [250, 251, 252]);
        let back = Canvas::from_png(&canvas.png()).unwrap();
        assert_eq!(back, canvas);
        let part = back.part((3, 4), (8, 8)).unwrap();
        let mut again = Canvas::new(40, 20, [1, 2, 3]);
        again.paste((3, 4), &part);
        assert_eq!(again, canvas);
        assert_eq!(back.part((33, 4), (8, 8)), None);
    }

    #[test]
    fn what_is_no_such_png_is_refused() {
        assert!(Canvas::from_png(b"GIF89a").unwrap_err().contains("PNG"));
        let mut huge = Canvas::new(1, 1, [0; 3]).png();
        huge[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]);
        assert!(Canvas::from_png(&huge).is_err());
    }
}
