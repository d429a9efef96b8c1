//! The 3×3 convolution by Winograd's F(2×2, 3×3): sixteen small matrix products instead of nine
//! taps, with 2.25 times fewer multiplications.
//!
//! Source: Lavin and Gray, "Fast algorithms for convolutional neural networks" (2016). A tile is
//! 2×2 outputs from 4×4 inputs. A task is a band of tile rows and a group of output channels. It
//! splits the input rows into the tiles' columns, so that lanes are neighbouring tiles, transforms
//! them, multiplies, and transforms back. The products are chains over input channels; the
//! transforms are sums in a fixed order.

use rayon::prelude::*;

use super::conv_shape::{BLOCK, ConvShape};
use super::plane::{Band, Grid, Unit, split};
use super::scratch::Scratch;
use super::simd::{Kernels, LANES, Lanes, Op, shifted};

/// The number of values of a tile, which is also the number of products.
const TILE: usize = 16;
/// The approximate size of a task's transformed input in bytes: half of a second-level cache.
const BYTES: usize = 512 << 10;

/// Returns whether this form is faster than the direct one.
pub(super) fn pays(s: &ConvShape) -> bool {
    s.inputs >= 16 && s.outputs >= 16 && s.height >= 4 && s.width >= 4
}

impl Kernels {
    /// Computes the convolution with weights packed for the direct form,
    /// `[outputs / 8][inputs][9][8]`.
    pub(super) fn winograd(self, s: &ConvShape, x: &[f32], packed: &[f32], out: &mut [f32]) {
        let tiles = Grid {
            images: s.images,
            height: s.height.div_ceil(2),
            width: s.width.div_ceil(2),
            pad: 1,
        };
        let units = (BYTES / (TILE * LANES * 4 * s.inputs)).clamp(8, 12);
        let bands = tiles.bands(units * LANES);
        if bands.is_empty() {
            return;
        }
        let weights = self.transform_weights(s, packed);
        let rows: Vec<Band> = bands
            .iter()
            .map(|b| Band {
                images: b.images.clone(),
                rows: 2 * b.rows.start..(2 * b.rows.end).min(s.height),
            })
            .collect();
        // The division of the work among tasks does not affect the bits.
        let wanted = (2 * rayon::current_num_threads()).div_ceil(bands.len());
        let group = s.outputs.div_ceil(BLOCK).div_ceil(wanted) * BLOCK;
        let groups = s.outputs.div_ceil(group);
        split(s.grid(3), s.outputs, group, &rows, out)
            .into_par_iter()
            .enumerate()
            .for_each(|(i, mut out)| {
                let band = &bands[i / groups];
                let first = i % groups * group;
                let channels = group.min(s.outputs - first);
                let units = tiles.units_unpadded(band);
                let len = units.len() * LANES;
                // One extra cache line keeps the sixteen streams out of one cache set.
                let step = s.inputs * len + LANES;
                let blocks = channels.div_ceil(BLOCK);
                let mut v = Scratch::take(TILE * step);
                let mut m = Scratch::take(TILE * blocks * BLOCK * len);
                let plane = tiles.packed_len(band) + 2 * LANES;
                let mut columns = Scratch::take(8 * plane);
                for c in 0..s.inputs {
                    self.run(Input {
                        s,
                        tiles,
                        band,
                        units: &units,
                        x,
                        channel: c,
                        plane,
                        columns: &mut columns,
                        to: &mut v[c * len..],
                        step,
                    });
                }
                self.run(Multiply {
                    v: &v,
                    step,
                    inputs: s.inputs,
                    len,
                    weights: &weights[first * TILE * s.inputs..],
                    blocks,
                    m: &mut m,
                });
                self.run(Output {
                    m: &m,
                    len,
                    units: &units,
                    width: s.width,
                    rows: rows[i / groups].rows.len(),
                    channels,
                    out: &mut out,
                });
            });
    }

    /// Returns `[outputs / 8][16][inputs][8]`: G g Gᵀ of each 3×3 kernel.
    fn transform_weights(self, s: &ConvShape, packed: &[f32]) -> Scratch {
        let mut to = Scratch::take(s.outputs.div_ceil(BLOCK) * TILE * s.inputs * BLOCK);
        to.par_chunks_exact_mut(TILE * s.inputs * BLOCK)
            .zip(packed.par_chunks_exact(9 * s.inputs * BLOCK))
            .for_each(|(to, from)| self.run(Weights { from, to }));
        to
    }
}

struct Weights<'a> {
    from: &'a [f32],
    to: &'a mut [f32],
}

impl Op for Weights<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let step = self.to.len() / TILE;
        for (c, g) in self.from.chunks_exact(9 * BLOCK).enumerate() {
            let mut rows = [[[0.0; BLOCK]; 3]; 4];
            for x in 0..3 {
                for m in 0..BLOCK {
                    let [a, b, c] = [0, 3, 6].map(|y| g[(y + x) * BLOCK + m]);
                    let (sum, middle) = (0.5 * (a + c), 0.5 * b);
                    rows[0][x][m] = a;
                    rows[1][x][m] = sum + middle;
                    rows[2][x][m] = sum - middle;
                    rows[3][x][m] = c;
                }
            }
            for (y, row) in rows.iter().enumerate() {
                let mut four = [[0.0; BLOCK]; 4];
                for m in 0..BLOCK {
                    let (sum, middle) = (0.5 * (row[0][m] + row[2][m]), 0.5 * row[1][m]);
                    four[0][m] = row[0][m];
                    four[1][m] = sum + middle;
                    four[2][m] = sum - middle;
                    four[3][m] = row[2][m];
                }
                for (x, lanes) in four.iter().enumerate() {
                    let at = (4 * y + x) * step + c * BLOCK;
                    self.to[at..at + BLOCK].copy_from_slice(lanes);
                }
            }
        }
    }
}

/// Splits one channel of a band into columns and transforms its tiles: Bᵀ d B.
struct Input<'a> {
    s: &'a ConvShape,
    tiles: Grid,
    band: &'a Band,
    units: &'a [Unit],
    x: &'a [f32],
    channel: usize,
    /// The length of one plane of columns, with slack at both ends.
    plane: usize,
    columns: &'a mut [f32],
    to: &'a mut [f32],
    step: usize,
}

impl Op for Input<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let (s, width, plane) = (self.s, self.tiles.width, self.plane);
        let pixels = s.height * s.width;
        let mut at = LANES;
        for image in self.band.images.clone() {
            let from = &self.x[(image * s.inputs + self.channel) * pixels..][..pixels];
            for q in 0..=self.band.rows.len() {
                for odd in 0..2 {
                    let y = 2 * (self.band.rows.start + q) + odd;
                    let columns = &mut self.columns[4 * odd * plane..][..4 * plane];
                    if y == 0 || y > s.height {
                        for column in columns.chunks_exact_mut(plane) {
                            column[at..at + width].fill(0.0);
                        }
                    } else {
                        let row = &from[(y - 1) * s.width..y * s.width];
                        columns_of::<L>(row, at, width, columns);
                    }
                }
                at += width;
            }
        }
        // Eight streams at a time: sixteen would be as many pages as a core can track for stores.
        for lower in [false, true] {
            let (columns, to) = (&*self.columns, &mut *self.to);
            for (u, unit) in self.units.iter().enumerate() {
                let from = |y: usize, x: usize| {
                    (4 * (y % 2) + x) * plane + LANES + unit.at + y / 2 * width
                };
                let mut t = [[L::splat(0.0); 4]; 2];
                for x in 0..4 {
                    let d1 = L::load(&columns[from(1, x)..]);
                    let d2 = L::load(&columns[from(2, x)..]);
                    if lower {
                        t[0][x] = d2.sub(d1);
                        t[1][x] = d1.sub(L::load(&columns[from(3, x)..]));
                    } else {
                        t[0][x] = L::load(&columns[from(0, x)..]).sub(d2);
                        t[1][x] = d1.add(d2);
                    }
                }
                for (y, t) in t.iter().enumerate() {
                    let y = y + 2 * usize::from(lower);
                    let row = [
                        t[0].sub(t[2]),
                        t[1].add(t[2]),
                        t[2].sub(t[1]),
                        t[1].sub(t[3]),
                    ];
                    for (x, lanes) in row.iter().enumerate() {
                        lanes.store(&mut to[(4 * y + x) * self.step + u * LANES..]);
                    }
                }
            }
        }
    }
}

/// Writes the four columns of a row's tiles, each at `at` of its plane: pixels 2j − 1, 2j, 2j + 1
/// and 2j + 2 of tile j. May write one value before and, in the first plane, up to one after.
#[inline(always)]
fn columns_of<L: Lanes>(row: &[f32], at: usize, width: usize, columns: &mut [f32]) {
    let plane = columns.len() / 4;
    let [a, b, c, d] = [0, 1, 2, 3].map(|i| i * plane + at);
    let mut parts = row.chunks_exact(2 * LANES);
    let mut j = 0;
    for part in parts.by_ref() {
        let (even, odd) = L::unzip(L::load(part), L::load(&part[LANES..]));
        odd.store(&mut columns[a + 1 + j..]);
        even.store(&mut columns[b + j..]);
        odd.store(&mut columns[c + j..]);
        even.store(&mut columns[d + j - 1..]);
        j += LANES;
    }
    for pair in parts.remainder().chunks(2) {
        let (even, odd) = (pair[0], pair.get(1).copied().unwrap_or(0.0));
        columns[a + 1 + j] = odd;
        columns[b + j] = even;
        columns[c + j] = odd;
        columns[d + j - 1] = even;
        j += 1;
    }
    // These values are outside the row, where the end of the previous row was written.
    columns[a] = 0.0;
    columns[d - 1] = 0.0;
    columns[d + width - 1] = 0.0;
}

/// The sixteen products: `m[block][channel][tile value][tile]`.
struct Multiply<'a> {
    v: &'a [f32],
    step: usize,
    inputs: usize,
    len: usize,
    weights: &'a [f32],
    blocks: usize,
    m: &'a mut [f32],
}

impl Op for Multiply<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(mut self) {
        for f in 0..TILE {
            let mut at = 0;
            while at < self.len {
                let left = (self.len - at) / LANES;
                if L::WIDE {
                    // The last four units are processed as two pairs.
                    let n = if left == 4 { 2 } else { left.min(3) };
                    for b in 0..self.blocks {
                        match n {
                            3 => self.tile::<L, 8, 3>(f, b, 0, at),
                            2 => self.tile::<L, 8, 2>(f, b, 0, at),
                            _ => self.tile::<L, 8, 1>(f, b, 0, at),
                        }
                    }
                    at += n * LANES;
                } else {
                    for b in 0..self.blocks {
                        self.tile::<L, 4, 1>(f, b, 0, at);
                        self.tile::<L, 4, 1>(f, b, 4, at);
                    }
                    at += LANES;
                }
            }
        }
    }
}

impl Multiply<'_> {
    #[inline(always)]
    fn tile<L: Lanes, const M: usize, const V: usize>(
        &mut self,
        f: usize,
        b: usize,
        half: usize,
        at: usize,
    ) {
        let mut starts = [0; V];
        for (v, start) in starts.iter_mut().enumerate() {
            *start = at + v * LANES;
        }
        // If there are no inputs, there are no weights.
        let weights = ((b * TILE + f) * self.inputs * BLOCK + half).min(self.weights.len());
        let acc = shifted::<L, M, V, 1>(
            &self.v[f * self.step..],
            starts,
            (self.inputs, self.len, 0),
            &self.weights[weights..],
            [[L::splat(0.0); V]; M],
        );
        for (m, acc) in acc.iter().enumerate() {
            let row = ((b * BLOCK + half + m) * TILE + f) * self.len;
            for (v, acc) in acc.iter().enumerate() {
                acc.store(&mut self.m[row + at + v * LANES..]);
            }
        }
    }
}

/// Transforms the products back, Aᵀ m A, and writes the pixels.
struct Output<'a, 'b> {
    m: &'a [f32],
    len: usize,
    units: &'a [Unit],
    width: usize,
    rows: usize,
    channels: usize,
    out: &'a mut [&'b mut [f32]],
}

impl Op for Output<'_, '_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let tiles = self.width.div_ceil(2);
        for c in 0..self.channels {
            let from = &self.m[c * TILE * self.len..][..TILE * self.len];
            for (u, unit) in self.units.iter().enumerate() {
                let mut t = [[L::splat(0.0); 4]; 2];
                for x in 0..4 {
                    let mut m = [L::splat(0.0); 4];
                    for (y, m) in m.iter_mut().enumerate() {
                        *m = L::load(&from[(4 * y + x) * self.len + u * LANES..]);
                    }
                    t[0][x] = m[0].add(m[1]).add(m[2]);
                    t[1][x] = m[1].sub(m[2]).sub(m[3]);
                }
                for (y, t) in t.iter().enumerate() {
                    let left = t[0].add(t[1]).add(t[2]);
                    let right = t[1].sub(t[2]).sub(t[3]);
                    let (a, b) = L::zip(left, right);
                    let mut pixels = [0.0; 2 * LANES];
                    let whole = matches!(&unit.runs[..], [run] if run.len == LANES);
                    if !whole {
                        a.store(&mut pixels);
                        b.store(&mut pixels[LANES..]);
                    }
                    for run in &unit.runs {
                        let y = 2 * (run.pixel / tiles) + y;
                        let x = 2 * (run.pixel % tiles);
                        if y >= self.rows {
                            continue;
                        }
                        let n = (2 * run.len).min(self.width - x);
                        let out = &mut self.out[run.image * self.channels + c];
                        let to = &mut out[y * self.width + x..][..n];
                        if whole && n == 2 * LANES {
                            a.store(to);
                            b.store(&mut to[LANES..]);
                        } else {
                            if whole {
                                a.store(&mut pixels);
                                b.store(&mut pixels[LANES..]);
                            }
                            to.copy_from_slice(&pixels[2 * run.lane..][..n]);
                        }
                    }
                }
            }
        }
    }
}
