//! Planes with shared zero padding: bands of rows, the vector units that cover them, and their
//! packing.
//!
//! A padded row starts with one zero, which is also the right neighbour of the previous row. Padded
//! images follow each other with one zero row between them. A stencil tap is therefore one constant
//! offset in a whole band, and one unit of sixteen lanes may cover several short rows or images.

use std::ops::Range;

use super::simd::LANES;

/// Images of one size, and the padding of the stencil that is applied to them (0 or 1).
#[derive(Clone, Copy)]
pub(super) struct Grid {
    pub images: usize,
    pub height: usize,
    pub width: usize,
    pub pad: usize,
}

/// A band: whole images, or some rows of one image.
#[derive(Clone)]
pub(super) struct Band {
    pub images: Range<usize>,
    pub rows: Range<usize>,
}

/// Sixteen neighbouring positions of a packed band and the pixels among them.
pub(super) struct Unit {
    /// The offset of the first tap of the first lane in a packed plane.
    pub at: usize,
    /// The pixels among the lanes.
    pub runs: Vec<Run>,
}

/// Lanes that are neighbouring pixels.
pub(super) struct Run {
    pub lane: usize,
    pub len: usize,
    /// The image's index in the band.
    pub image: usize,
    /// The first pixel's index in the band's rows of that image.
    pub pixel: usize,
}

impl Grid {
    /// Returns the number of pixels of one image.
    pub fn pixels(self) -> usize {
        self.height * self.width
    }

    /// Returns the length of a packed row.
    pub fn stride(self) -> usize {
        self.width + self.pad
    }

    /// Divides all rows into bands of about `pixels` pixels.
    pub fn bands(self, pixels: usize) -> Vec<Band> {
        let all = self.pixels();
        if all == 0 || self.images == 0 {
            return Vec::new();
        }
        let mut bands = Vec::new();
        if all <= pixels {
            let whole = (pixels / all).min(self.images);
            let count = self.images.div_ceil(whole);
            let whole = self.images.div_ceil(count);
            for first in (0..self.images).step_by(whole) {
                bands.push(Band {
                    images: first..(first + whole).min(self.images),
                    rows: 0..self.height,
                });
            }
            return bands;
        }
        let rows = (pixels / self.width).max(1);
        let rows = self.height.div_ceil(self.height.div_ceil(rows));
        for image in 0..self.images {
            for first in (0..self.height).step_by(rows) {
                bands.push(Band {
                    images: image..image + 1,
                    rows: first..(first + rows).min(self.height),
                });
            }
        }
        bands
    }

    /// Returns the number of packed rows of a band, with the padding above and below.
    fn packed_rows(self, band: &Band) -> usize {
        band.images.len() * (band.rows.len() + self.pad) + self.pad
    }

    /// Returns the length of one packed plane of a band, including the last unit's lanes.
    pub fn packed_len(self, band: &Band) -> usize {
        (self.packed_rows(band) * self.stride() + self.pad + LANES).next_multiple_of(LANES)
    }

    /// Returns the units that cover a band. If the width allows it, they are exact pieces of rows;
    /// otherwise they are runs over the packed plane that skip as much padding as possible.
    pub fn units(self, band: &Band) -> Vec<Unit> {
        self.cover(band, self.stride())
    }

    /// Returns the units that cover a band of planes without row padding.
    pub fn units_unpadded(self, band: &Band) -> Vec<Unit> {
        self.cover(band, self.width)
    }

    fn cover(self, band: &Band, stride: usize) -> Vec<Unit> {
        let (h, w) = (band.rows.len(), self.width);
        let mut units: Vec<Unit> = Vec::new();
        let mut end = 0;
        for image in 0..band.images.len() {
            for y in 0..h {
                let row = (image * (h + self.pad) + y) * stride;
                let mut x = 0;
                while x < w {
                    let position = row + x;
                    if position >= end {
                        units.push(Unit {
                            at: position,
                            runs: Vec::new(),
                        });
                        end = position + LANES;
                    }
                    let len = (end - position).min(w - x);
                    let unit = units.last_mut().expect("a unit was started");
                    unit.runs.push(Run {
                        lane: position - unit.at,
                        len,
                        image,
                        pixel: y * w + x,
                    });
                    x += len;
                }
            }
        }
        units
    }

    /// Packs one plane of a band: `image(i)` is the plane of image `i`. `to` has
    /// [`Grid::packed_len`] values.
    pub fn pack<'a>(self, band: &Band, image: impl Fn(usize) -> &'a [f32], to: &mut [f32]) {
        let (w, stride, pad) = (self.width, self.stride(), self.pad);
        let mut at = 0;
        for i in band.images.clone() {
            let plane = image(i);
            if pad == 0 {
                let from = &plane[band.rows.start * w..band.rows.end * w];
                to[at..at + from.len()].copy_from_slice(from);
                at += from.len();
                continue;
            }
            let first = i == band.images.start;
            let above = usize::from(first);
            // The row above is packed for the first image only; later images share the zero row in
            // front of them.
            for y in 1 - above..band.rows.len() + 2 {
                let y = band.rows.start + y;
                if y == 0 || y > self.height {
                    to[at..at + stride].fill(0.0);
                } else {
                    to[at] = 0.0;
                    copy(&plane[(y - 1) * w..y * w], &mut to[at + 1..at + stride]);
                }
                at += stride;
            }
        }
        to[at..].fill(0.0);
    }
}

/// Copies a row, without a call if it is short.
#[inline(always)]
fn copy(from: &[f32], to: &mut [f32]) {
    if from.len().is_multiple_of(8) {
        for (from, to) in from.chunks_exact(8).zip(to.chunks_exact_mut(8)) {
            to.copy_from_slice(from);
        }
    } else {
        to.copy_from_slice(from);
    }
}

/// Splits an NCHW tensor into pieces: `parts[band · groups + group]` receives, image by image of
/// the band, the band's rows of each channel of the group.
pub(super) fn split<'a>(
    grid: Grid,
    channels: usize,
    group: usize,
    bands: &[Band],
    tensor: &'a mut [f32],
) -> Vec<Vec<&'a mut [f32]>> {
    let groups = channels.div_ceil(group);
    let mut parts: Vec<Vec<&mut [f32]>> = Vec::new();
    parts.resize_with(bands.len() * groups, Vec::new);
    let mut first = 0;
    let mut planes = tensor.chunks_exact_mut(grid.pixels().max(1));
    for image in 0..grid.images {
        while first < bands.len() && bands[first].images.end <= image {
            first += 1;
        }
        for channel in 0..channels {
            let mut rest = planes.next().expect("a plane for each image and channel");
            for (i, band) in bands.iter().enumerate().skip(first) {
                if band.images.start > image {
                    break;
                }
                let (piece, tail) = rest.split_at_mut(band.rows.len() * grid.width);
                parts[i * groups + channel / group].push(piece);
                rest = tail;
            }
        }
    }
    parts
}
