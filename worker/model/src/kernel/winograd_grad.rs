//! The weight gradient of the 3×3 convolution by Winograd's tiles: the adjoint of the forward form.
//!
//! dW = Gᵀ [ Σ over tiles (A dy Aᵀ) ⊙ (Bᵀ x B) ] G. Input and output gradient are transposed to
//! sixteen channels a pixel and transformed with lanes over channels. The sum over tiles is divided
//! into chains of outer products, whose sums are added in order. Tasks divide channels and tile
//! values, never tiles.

use rayon::prelude::*;

use super::conv_shape::ConvShape;
use super::scratch::Scratch;
use super::simd::{Kernels, LANES, Lanes, Op, Positions, outer};

/// The number of values of a tile.
const TILE: usize = 16;
/// The approximate size of a band's transformed values in bytes.
const BYTES: usize = 2 << 20;
/// The greatest number of tiles of one chain.
const CHAIN: usize = 128;
/// The number of input channels of one product.
const SCALARS: usize = 8;

/// Returns whether this form is faster than the direct one.
pub(super) fn pays(s: &ConvShape) -> bool {
    let tiles = s.images * s.height.div_ceil(2) * s.width.div_ceil(2);
    // The transforms cost as much as about 24 channels on both sides save.
    s.inputs * s.outputs > 24 * (s.inputs + s.outputs) && tiles >= 64
}

impl Kernels {
    /// Writes all of `dw`.
    pub(super) fn winograd_weight_grad(self, s: &ConvShape, x: &[f32], dy: &[f32], dw: &mut [f32]) {
        let pixels = s.height * s.width;
        let x = self.transposed(s.images, s.inputs, pixels, x, LANES);
        let dy = self.transposed(s.images, s.outputs, pixels, dy, LANES);
        let (inputs, outputs) = (s.inputs.div_ceil(LANES), s.outputs.div_ceil(LANES));
        let pairs = outputs.div_ceil(2);
        let width = s.width.div_ceil(2);
        let all = s.images * s.height.div_ceil(2);
        let row = width * TILE * LANES * (inputs + outputs) * size_of::<f32>();
        let step = (BYTES / row).max(64usize.div_ceil(width)).min(all);

        // The sums as [tile value][pair of output blocks][input][32].
        let depth = inputs * LANES * 2 * LANES;
        let mut sums = Scratch::take(TILE * pairs * depth);
        let mut values = Scratch::take((inputs + outputs) * TILE * (step * width + 1) * LANES);
        for first in (0..all).step_by(step) {
            let rows = step.min(all - first);
            // One extra cache line keeps the sixteen streams out of one cache set.
            let line = rows * width * LANES + LANES;
            let block = TILE * line;
            values[..(inputs + outputs) * block]
                .par_chunks_exact_mut(block)
                .enumerate()
                .for_each(|(b, to)| {
                    let (from, of_gradient) = match b.checked_sub(inputs) {
                        None => (&x[b * s.images * pixels * LANES..], false),
                        Some(b) => (&dy[b * s.images * pixels * LANES..], true),
                    };
                    self.run(Transform {
                        s,
                        from,
                        of_gradient,
                        first,
                        rows,
                        to,
                    });
                });
            let (v, g) = values.split_at(inputs * block);
            sums.par_chunks_exact_mut(depth)
                .enumerate()
                .for_each(|(i, sums)| {
                    let (f, pair) = (i / pairs, i % pairs);
                    self.run(Products {
                        v: &v[f * line..],
                        g: &g[2 * pair * block + f * line..],
                        block,
                        tiles: rows * width,
                        inputs,
                        both: 2 * pair + 1 < outputs,
                        fresh: first == 0,
                        sums,
                    });
                });
        }
        dw.par_chunks_mut(2 * LANES * s.inputs * 9)
            .enumerate()
            .for_each(|(pair, dw)| {
                self.run(Back {
                    sums: &sums[pair * depth..],
                    step: pairs * depth,
                    inputs: s.inputs,
                    dw,
                });
            });
    }
}

/// Transforms one block of sixteen channels in a band of tile rows: `[tile value][tile][16]`.
struct Transform<'a> {
    s: &'a ConvShape,
    /// `[image][pixel][16]`.
    from: &'a [f32],
    of_gradient: bool,
    first: usize,
    rows: usize,
    to: &'a mut [f32],
}

impl Op for Transform<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let (h, w) = (self.s.height, self.s.width);
        let (height, width) = (h.div_ceil(2), w.div_ceil(2));
        let line = self.to.len() / TILE;
        for row in 0..self.rows {
            let (image, ty) = ((self.first + row) / height, (self.first + row) % height);
            let image = &self.from[image * h * w * LANES..][..h * w * LANES];
            // Row −1 wraps to a large number, which also counts as outside.
            let line_of = |y: usize| (y < h).then(|| &image[y * w * LANES..(y + 1) * w * LANES]);
            let to = &mut self.to[row * width * LANES..];
            // Eight streams at a time: sixteen would be as many pages as a core can track for
            // stores.
            for lower in [false, true] {
                if self.of_gradient {
                    let lines = [line_of(2 * ty), line_of(2 * ty + 1)];
                    for tx in 0..width {
                        let a = spread_column::<L>(lines, 2 * tx, lower);
                        let b = spread_column::<L>(lines, 2 * tx + 1, lower);
                        let four = [spread(a[0], b[0]), spread(a[1], b[1])];
                        write(four, lower, tx, line, to);
                    }
                } else {
                    let lines = [0, 1, 2, 3].map(|y| line_of((2 * ty + y).wrapping_sub(1)));
                    let mut a = [L::splat(0.0); 2];
                    let mut b = column::<L>(lines, 0, lower);
                    for tx in 0..width {
                        let c = column::<L>(lines, 2 * tx + 1, lower);
                        let d = column::<L>(lines, 2 * tx + 2, lower);
                        let four = [
                            differences([a[0], b[0], c[0], d[0]]),
                            differences([a[1], b[1], c[1], d[1]]),
                        ];
                        write(four, lower, tx, line, to);
                        (a, b) = (c, d);
                    }
                }
            }
        }
    }
}

/// Writes half of a tile's values.
#[inline(always)]
fn write<L: Lanes>(four: [[L; 4]; 2], lower: bool, tx: usize, line: usize, to: &mut [f32]) {
    for (y, four) in four.iter().enumerate() {
        let y = y + 2 * usize::from(lower);
        for (x, lanes) in four.iter().enumerate() {
            lanes.store(&mut to[(4 * y + x) * line + tx * LANES..]);
        }
    }
}

/// Returns half of Bᵀ d for one column of the input.
#[inline(always)]
fn column<L: Lanes>(lines: [Option<&[f32]>; 4], x: usize, lower: bool) -> [L; 2] {
    let (d1, d2) = (at::<L>(lines[1], x), at::<L>(lines[2], x));
    if lower {
        [d2.sub(d1), d1.sub(at::<L>(lines[3], x))]
    } else {
        [at::<L>(lines[0], x).sub(d2), d1.add(d2)]
    }
}

/// Returns half of A y for one column of the gradient.
#[inline(always)]
fn spread_column<L: Lanes>(lines: [Option<&[f32]>; 2], x: usize, lower: bool) -> [L; 2] {
    halves(spread(at::<L>(lines[0], x), at::<L>(lines[1], x)), lower)
}

/// Returns the first or the last two of four values.
#[inline(always)]
fn halves<L: Lanes>(x: [L; 4], lower: bool) -> [L; 2] {
    if lower { [x[2], x[3]] } else { [x[0], x[1]] }
}

/// Returns sixteen channels of a pixel, zero outside the image.
#[inline(always)]
fn at<L: Lanes>(line: Option<&[f32]>, x: usize) -> L {
    match line {
        Some(line) if x * LANES < line.len() => L::load(&line[x * LANES..]),
        _ => L::splat(0.0),
    }
}

/// Returns A (a, b): the adjoint of the output transform.
#[inline(always)]
fn spread<L: Lanes>(a: L, b: L) -> [L; 4] {
    [a, a.add(b), a.sub(b), L::splat(0.0).sub(b)]
}

/// Returns Bᵀ d.
#[inline(always)]
fn differences<L: Lanes>(d: [L; 4]) -> [L; 4] {
    [
        d[0].sub(d[2]),
        d[1].add(d[2]),
        d[2].sub(d[1]),
        d[1].sub(d[3]),
    ]
}

/// The products of one tile value with two blocks of output channels.
struct Products<'a> {
    v: &'a [f32],
    g: &'a [f32],
    /// The distance between two blocks of channels.
    block: usize,
    tiles: usize,
    inputs: usize,
    both: bool,
    fresh: bool,
    sums: &'a mut [f32],
}

impl Op for Products<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        for first in (0..self.tiles).step_by(CHAIN) {
            let fresh = self.fresh && first == 0;
            let s = Positions {
                rows: 1,
                width: CHAIN.min(self.tiles - first),
                row: 0,
                step: LANES,
                wide: LANES,
                apart: self.block,
            };
            let g = &self.g[first * LANES..];
            for c in (0..self.inputs * LANES).step_by(SCALARS) {
                let x = &self.v[c / LANES * self.block + first * LANES + c % LANES..];
                let sums = &mut self.sums[c * 2 * LANES..][..SCALARS * 2 * LANES];
                if L::WIDE && self.both {
                    keep(outer::<L, 2, 1, SCALARS>(x, [0], g, s), sums, fresh);
                    continue;
                }
                for v in 0..=usize::from(self.both) {
                    let g = &g[v * self.block..];
                    for half in [0, SCALARS / 2] {
                        let sums = &mut sums[half * 2 * LANES + v * LANES..];
                        let acc = outer::<L, 1, 1, { SCALARS / 2 }>(x, [half], g, s);
                        keep(acc, sums, fresh);
                    }
                }
            }
        }
    }
}

/// Adds a chain's sums to the earlier ones.
#[inline(always)]
fn keep<L: Lanes, const V: usize, const C: usize>(
    acc: [[[L; V]; C]; 1],
    sums: &mut [f32],
    fresh: bool,
) {
    for (c, acc) in acc[0].iter().enumerate() {
        for (v, acc) in acc.iter().enumerate() {
            let to = &mut sums[c * 2 * LANES + v * LANES..];
            if fresh {
                acc.store(to);
            } else {
                L::load(to).add(*acc).store(to);
            }
        }
    }
}

/// Computes Gᵀ ŵ G for a pair of output blocks, and writes it as (outputs, inputs, 3, 3).
struct Back<'a> {
    sums: &'a [f32],
    /// The distance between two tile values.
    step: usize,
    inputs: usize,
    dw: &'a mut [f32],
}

impl Op for Back<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let row = self.inputs * 9;
        for (o, dw) in self.dw.chunks_mut(LANES * row).enumerate() {
            for c in 0..self.inputs {
                let from = &self.sums[(c * 2 + o) * LANES..];
                let mut t = [[L::splat(0.0); 4]; 3];
                for x in 0..4 {
                    let mut w = [L::splat(0.0); 4];
                    for (y, w) in w.iter_mut().enumerate() {
                        *w = L::load(&from[(4 * y + x) * self.step..]);
                    }
                    let three = gather(w);
                    for y in 0..3 {
                        t[y][x] = three[y];
                    }
                }
                let mut taps = [L::splat(0.0); LANES];
                for y in 0..3 {
                    let three = gather(t[y]);
                    for x in 0..3 {
                        taps[3 * y + x] = three[x];
                    }
                }
                let channels = L::transpose(taps);
                for (row, taps) in dw.chunks_exact_mut(row).zip(channels) {
                    row[9 * c..9 * c + 9].copy_from_slice(&taps.array()[..9]);
                }
            }
        }
    }
}

/// Returns Gᵀ w.
#[inline(always)]
fn gather<L: Lanes>(w: [L; 4]) -> [L; 3] {
    let half = L::splat(0.5);
    let sum = w[1].add(w[2]).mul(half);
    [w[0].add(sum), w[1].sub(w[2]).mul(half), sum.add(w[3])]
}
