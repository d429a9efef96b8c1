//! Weight and bias gradients of the convolutions.
//!
//! The output gradient is transposed once to `[block of channels][pixel][32]`, so that the gradient
//! of one weight row is a chain of outer products: scalars of the packed input times vectors over
//! output channels, without a reduction across lanes. The chain runs over a block of
//! [`BLOCK_PIXELS`] pixels of one image; the blocks' sums are added in order. Tasks share out
//! channels, never pixels.

use rayon::prelude::*;

use super::conv::image_band;
use super::conv_shape::ConvShape;
use super::plane::{Band, Grid};
use super::scratch::Scratch;
use super::simd::{Kernels, LANES, Lanes, Op, Positions, outer};
use super::winograd_grad;

/// The least number of pixels of one chain, rounded up to whole rows.
const BLOCK_PIXELS: usize = 128;
/// The number of pixels packed at a time.
const BAND: usize = 1024;
/// The number of adjacent scalars in [`outer`].
const SCALARS: usize = 9;

impl Kernels {
    /// Computes the weights' gradient of [`Kernels::conv3x3`] from the input and the output's
    /// gradient. Writes all of `dw` (outputs, inputs, 3, 3).
    pub fn conv3x3_weight_grad(self, s: &ConvShape, x: &[f32], dy: &[f32], dw: &mut [f32]) {
        self.weight_grad::<3>(s, x, dy, dw);
    }

    /// Computes the weights' gradient of [`Kernels::conv1x1`]. Writes all of `dw` (outputs,
    /// inputs).
    pub fn conv1x1_weight_grad(self, s: &ConvShape, x: &[f32], dy: &[f32], dw: &mut [f32]) {
        self.weight_grad::<1>(s, x, dy, dw);
    }

    /// Computes a convolution's bias gradient: `db` receives one sum over images and pixels for
    /// each channel.
    pub fn bias_grad(self, s: &ConvShape, dy: &[f32], db: &mut [f32]) {
        assert_eq!(dy.len(), s.output_len(), "output gradient length");
        assert_eq!(db.len(), s.outputs, "bias gradient length");
        let pixels = s.height * s.width;
        db.par_iter_mut().enumerate().for_each(|(o, db)| {
            let mut sum = 0.0;
            for n in 0..s.images {
                let at = (n * s.outputs + o) * pixels;
                sum += f64::from(self.run(Sum(&dy[at..at + pixels])));
            }
            *db = sum as f32;
        });
    }

    fn weight_grad<const K: usize>(self, s: &ConvShape, x: &[f32], dy: &[f32], dw: &mut [f32]) {
        assert_eq!(x.len(), s.input_len(), "input length");
        assert_eq!(dy.len(), s.output_len(), "output gradient length");
        assert_eq!(dw.len(), s.weight_len(K), "weight gradient length");
        if s.input_len() == 0 || s.output_len() == 0 {
            dw.fill(0.0);
            return;
        }
        if K == 3 && winograd_grad::pays(s) {
            return self.winograd_weight_grad(s, x, dy, dw);
        }
        let grid = s.grid(K);
        let wide = if s.outputs > LANES { 2 * LANES } else { LANES };
        let blocks = s.outputs.div_ceil(wide);
        let g = self.transposed(s.images, s.outputs, grid.pixels(), dy, wide);

        // One pass of `outer` processes one channel's nine taps, or nine channels.
        let each = if K == 3 { 1 } else { SCALARS };
        let passes = s.inputs.div_ceil(each);
        // The division of the channels among tasks does not affect the bits.
        let wanted = (4 * rayon::current_num_threads()).div_ceil(blocks);
        let share = passes.div_ceil(wanted).clamp(1, 32);
        let shares = passes.div_ceil(share);
        let mut parts: Vec<Vec<&mut [f32]>> = Vec::new();
        parts.resize_with(blocks * shares, Vec::new);
        for (o, row) in dw.chunks_exact_mut(s.inputs * K * K).enumerate() {
            for (i, piece) in row.chunks_mut(share * each * K * K).enumerate() {
                parts[o / wide * shares + i].push(piece);
            }
        }
        parts
            .into_par_iter()
            .enumerate()
            .for_each_init(Vec::new, |scratch, (i, mut rows)| {
                let first = i % shares * share;
                let task = Task {
                    s,
                    grid,
                    x,
                    g: &g[i / shares * s.images * grid.pixels() * wide..],
                    wide,
                    first,
                    passes: share.min(passes - first),
                };
                let mut sums = vec![0.0; task.passes * SCALARS * wide];
                for n in 0..s.images {
                    task.image::<K>(self, n, scratch, &mut sums);
                }
                // Both kernels store their sums as [weight of a row][output channel].
                for (o, row) in rows.iter_mut().enumerate() {
                    for (to, from) in row.iter_mut().zip(sums.chunks_exact(wide)) {
                        *to = from[o];
                    }
                }
            });
    }

    /// Transposes NCHW to `[channels / wide][image][pixel][wide]`; missing channels are zero.
    pub(super) fn transposed(
        self,
        images: usize,
        channels: usize,
        pixels: usize,
        from: &[f32],
        wide: usize,
    ) -> Scratch {
        let mut to = Scratch::take(channels.div_ceil(wide) * images * pixels * wide);
        to.par_chunks_mut(pixels * wide)
            .enumerate()
            .for_each(|(i, to)| {
                let (block, image) = (i / images, i % images);
                let first = block * wide;
                let count = wide.min(channels - first);
                let at = (image * channels + first) * pixels;
                let from = &from[at..at + count * pixels];
                self.run(Transpose {
                    from,
                    pixels,
                    wide,
                    to,
                });
            });
        to
    }
}

/// The gradients of a share of input channels and one block of output channels.
struct Task<'a> {
    s: &'a ConvShape,
    grid: Grid,
    x: &'a [f32],
    g: &'a [f32],
    wide: usize,
    /// The first pass of the share, and the number of passes.
    first: usize,
    passes: usize,
}

impl Task<'_> {
    /// Adds one image's pixels to the sums.
    fn image<const K: usize>(
        &self,
        k: Kernels,
        n: usize,
        scratch: &mut Vec<f32>,
        sums: &mut [f32],
    ) {
        let (grid, pixels) = (self.grid, self.grid.pixels());
        let rows = BLOCK_PIXELS.div_ceil(grid.width).min(grid.height);
        let step = (BAND / (rows * grid.width)).max(1) * rows;
        for start in (0..grid.height).step_by(step) {
            let band = Band {
                rows: start..(start + step).min(grid.height),
                ..image_band(grid, n)
            };
            let plane = |c: usize| {
                let at = (n * self.s.inputs + c) * pixels;
                &self.x[at..at + pixels]
            };
            let len;
            if K == 3 {
                len = grid.packed_len(&band);
                scratch.resize(len * self.passes, 0.0);
                for (c, to) in scratch.chunks_exact_mut(len).enumerate() {
                    grid.pack(&band, |_| plane(self.first + c), to);
                }
            } else {
                let from = band.rows.start * grid.width..band.rows.end * grid.width;
                len = from.len() * SCALARS;
                scratch.clear();
                scratch.resize(len * self.passes, 0.0);
                for (pass, to) in scratch.chunks_exact_mut(len).enumerate() {
                    for j in 0..SCALARS {
                        let c = (self.first + pass) * SCALARS + j;
                        if c < self.s.inputs {
                            let from = &plane(c)[from.clone()];
                            for (to, x) in to[j..].iter_mut().step_by(SCALARS).zip(from) {
                                *to = *x;
                            }
                        }
                    }
                }
            }
            k.run(Blocks::<K> {
                x: scratch,
                plane: len,
                row: if K == 3 {
                    grid.stride()
                } else {
                    grid.width * SCALARS
                },
                g: &self.g[(n * pixels + start * grid.width) * self.wide..],
                wide: self.wide,
                width: grid.width,
                rows,
                all: band.rows.len(),
                sums,
            });
        }
    }
}

/// The blocks of one packed band.
struct Blocks<'a, const K: usize> {
    x: &'a [f32],
    plane: usize,
    row: usize,
    g: &'a [f32],
    wide: usize,
    width: usize,
    /// The numbers of rows of a block and of the band.
    rows: usize,
    all: usize,
    sums: &'a mut [f32],
}

impl<const K: usize> Op for Blocks<'_, K> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let wide = self.wide;
        let (step, triple) = if K == 3 { (1, self.row) } else { (SCALARS, 3) };
        for y in (0..self.all).step_by(self.rows) {
            let s = Positions {
                rows: self.rows.min(self.all - y),
                width: self.width,
                row: self.row,
                step,
                wide,
                apart: LANES,
            };
            let g = &self.g[y * self.width * wide..];
            for (x, sums) in self
                .x
                .chunks_exact(self.plane)
                .zip(self.sums.chunks_exact_mut(SCALARS * wide))
            {
                let x = &x[y * self.row..];
                if L::WIDE {
                    let at = [0, triple, 2 * triple];
                    if wide == LANES {
                        add(outer::<L, 1, 3, 3>(x, at, g, s), sums, wide);
                    } else {
                        add(outer::<L, 2, 3, 3>(x, at, g, s), sums, wide);
                    }
                } else {
                    for r in 0..3 {
                        for v in 0..wide / LANES {
                            let sums = &mut sums[3 * r * wide + v * LANES..];
                            add(
                                outer::<L, 1, 1, 3>(x, [r * triple], &g[v * LANES..], s),
                                sums,
                                wide,
                            );
                        }
                    }
                }
            }
        }
    }
}

/// Adds the sums of one pass.
#[inline(always)]
fn add<L: Lanes, const V: usize, const R: usize>(
    acc: [[[L; V]; 3]; R],
    sums: &mut [f32],
    wide: usize,
) {
    for (r, acc) in acc.iter().enumerate() {
        for (k, acc) in acc.iter().enumerate() {
            for (v, acc) in acc.iter().enumerate() {
                let to = &mut sums[(3 * r + k) * wide + v * LANES..];
                L::load(to).add(*acc).store(to);
            }
        }
    }
}

/// The sum of a slice over four times sixteen lanes.
struct Sum<'a>(&'a [f32]);

impl Op for Sum<'_> {
    type Out = f32;

    #[inline(always)]
    fn run<L: Lanes>(self) -> f32 {
        let mut acc = [L::splat(0.0); 4];
        let mut parts = self.0.chunks_exact(4 * LANES);
        for part in parts.by_ref() {
            for (i, acc) in acc.iter_mut().enumerate() {
                *acc = acc.add(L::load(&part[i * LANES..]));
            }
        }
        for (i, part) in parts.remainder().chunks(LANES).enumerate() {
            acc[i] = acc[i].add(L::load_part(part, 0.0));
        }
        acc[0].add(acc[1]).add(acc[2].add(acc[3])).sum()
    }
}

/// The transposition of planes to vectors over channels.
struct Transpose<'a> {
    from: &'a [f32],
    pixels: usize,
    wide: usize,
    to: &'a mut [f32],
}

impl Op for Transpose<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let (pixels, wide) = (self.pixels, self.wide);
        let channels = self.from.len() / pixels;
        for start in (0..pixels).step_by(LANES) {
            let n = LANES.min(pixels - start);
            for first in (0..wide).step_by(LANES) {
                let mut rows = [L::splat(0.0); LANES];
                for (i, row) in rows.iter_mut().enumerate() {
                    if first + i < channels {
                        let at = (first + i) * pixels + start;
                        *row = L::load_part(&self.from[at..at + n], 0.0);
                    }
                }
                let rows = L::transpose(rows);
                for (i, row) in rows.iter().enumerate() {
                    if i < n {
                        row.store(&mut self.to[(start + i) * wide + first..]);
                    }
                }
            }
        }
    }
}
