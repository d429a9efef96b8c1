//! Convolution and its input gradient: a shifted matrix product over padded bands, without im2col.
//!
//! A task is a band of rows and a group of output channels. It packs a chunk of input channels into
//! padded planes that stay in the second-level cache and adds the chunk to its outputs, tile by
//! tile: eight output channels by three units of sixteen pixels. Each output is one chain of fused
//! multiply-adds over input channels, then taps, whatever the tile, chunk or task.

use rayon::prelude::*;

use super::conv_shape::{BLOCK, ConvShape};
use super::plane::{Band, Grid, Unit, split};
use super::scratch::Scratch;
use super::simd::{Kernels, LANES, Lanes, Op, shifted};
use super::winograd;

/// The number of input channels packed at a time.
const CHUNK: usize = 32;
/// The number of pixels of a band.
const BAND: usize = 1024;

impl Kernels {
    /// Computes a 3×3 convolution with zero padding 1. Writes all of `out`.
    pub fn conv3x3(self, s: &ConvShape, x: &[f32], w: &[f32], out: &mut [f32]) {
        self.convolve::<3>(s, x, w, None, out);
    }

    /// Computes the input's gradient of [`Kernels::conv3x3`] from `dy`, which has the output's
    /// shape. Writes all of `dx`.
    pub fn conv3x3_input_grad(self, s: &ConvShape, dy: &[f32], w: &[f32], dx: &mut [f32]) {
        self.input_grad::<3>(s, dy, w, dx);
    }

    /// Computes a 1×1 convolution with an optional bias (one value an output channel). Writes all
    /// of `out`.
    pub fn conv1x1(
        self,
        s: &ConvShape,
        x: &[f32],
        w: &[f32],
        bias: Option<&[f32]>,
        out: &mut [f32],
    ) {
        self.convolve::<1>(s, x, w, bias, out);
    }

    /// Computes the input's gradient of [`Kernels::conv1x1`]. Writes all of `dx`.
    pub fn conv1x1_input_grad(self, s: &ConvShape, dy: &[f32], w: &[f32], dx: &mut [f32]) {
        self.input_grad::<1>(s, dy, w, dx);
    }

    fn convolve<const K: usize>(
        self,
        s: &ConvShape,
        x: &[f32],
        w: &[f32],
        bias: Option<&[f32]>,
        out: &mut [f32],
    ) {
        assert_eq!(x.len(), s.input_len(), "input length");
        assert_eq!(w.len(), s.weight_len(K), "weight length");
        assert_eq!(out.len(), s.output_len(), "output length");
        let packed = pack_weights(s, K * K, w);
        if K == 3 && winograd::pays(s) {
            self.winograd(s, x, &packed, out);
        } else {
            self.product::<K>(s, x, &packed, bias, out);
        }
    }

    fn input_grad<const K: usize>(self, s: &ConvShape, dy: &[f32], w: &[f32], dx: &mut [f32]) {
        assert_eq!(dy.len(), s.output_len(), "output gradient length");
        assert_eq!(w.len(), s.weight_len(K), "weight length");
        assert_eq!(dx.len(), s.input_len(), "input gradient length");
        let packed = pack_transposed::<K>(s, w);
        if K == 3 && winograd::pays(&s.swapped()) {
            self.winograd(&s.swapped(), dy, &packed, dx);
        } else {
            self.product::<K>(&s.swapped(), dy, &packed, None, dx);
        }
    }

    /// Computes the product with packed weights, `[outputs / 8][inputs][K·K][8]`.
    fn product<const K: usize>(
        self,
        s: &ConvShape,
        x: &[f32],
        packed: &[f32],
        bias: Option<&[f32]>,
        out: &mut [f32],
    ) {
        if let Some(b) = bias {
            assert_eq!(b.len(), s.outputs, "bias length");
        }
        let grid = s.grid(K);
        let bands = grid.bands(BAND);
        if bands.is_empty() || s.outputs == 0 {
            return;
        }
        // The division of the work among tasks does not affect the bits.
        let wanted = (4 * rayon::current_num_threads()).div_ceil(bands.len());
        let blocks = s.outputs.div_ceil(BLOCK);
        let group = blocks.div_ceil(wanted).max(blocks.min(2)) * BLOCK;
        let groups = s.outputs.div_ceil(group);
        let parts = split(grid, s.outputs, group, &bands, out);
        let input = Input { s, grid, x };
        // If several tasks share a band, it is packed once in advance.
        let shared = (groups > 1).then(|| input.pack_all(&bands));
        let lens: Vec<usize> = bands
            .iter()
            .map(|b| grid.packed_len(b) * s.inputs)
            .collect();
        parts
            .into_par_iter()
            .enumerate()
            .for_each(|(i, mut pieces)| {
                let band = &bands[i / groups];
                let first = i % groups * group;
                let channels = group.min(s.outputs - first);
                let units = grid.units(band);
                let plane = grid.packed_len(band);
                let mut own = Scratch::take(if groups > 1 { 0 } else { plane * CHUNK });
                let mut chunk = 0;
                loop {
                    let inputs = CHUNK.min(s.inputs - chunk);
                    let x = match &shared {
                        Some(all) => {
                            let start: usize = lens[..i / groups].iter().sum();
                            &all[start + chunk * plane..][..inputs * plane]
                        }
                        None => {
                            for (c, to) in own.chunks_exact_mut(plane).take(inputs).enumerate() {
                                input.pack(band, chunk + c, to);
                            }
                            &own[..]
                        }
                    };
                    self.run(Chunk::<K> {
                        x,
                        inputs,
                        plane,
                        row: grid.stride(),
                        units: &units,
                        weights: &packed[(first / BLOCK * s.inputs + chunk) * K * K * BLOCK..],
                        block: s.inputs * K * K * BLOCK,
                        channels,
                        bias: bias.map(|b| &b[first..]),
                        fresh: chunk == 0,
                        out: &mut pieces,
                    });
                    chunk += inputs;
                    if chunk >= s.inputs {
                        break;
                    }
                }
            });
    }
}

/// The input of a convolution, to be packed.
struct Input<'a> {
    s: &'a ConvShape,
    grid: Grid,
    x: &'a [f32],
}

impl Input<'_> {
    /// Packs one channel of a band.
    fn pack(&self, band: &Band, channel: usize, to: &mut [f32]) {
        let image = |i: usize| {
            let at = (i * self.s.inputs + channel) * self.grid.pixels();
            &self.x[at..at + self.grid.pixels()]
        };
        self.grid.pack(band, image, to);
    }

    /// Packs all bands, each as `[channel][packed plane]`.
    fn pack_all(&self, bands: &[Band]) -> Scratch {
        let each = |band: &Band| self.grid.packed_len(band);
        let total = bands.iter().map(each).sum::<usize>() * self.s.inputs;
        let mut all = Scratch::take(total);
        let mut rest = &mut all[..];
        for band in bands {
            let (part, tail) = rest.split_at_mut(each(band) * self.s.inputs);
            part.par_chunks_exact_mut(each(band))
                .with_min_len(8)
                .enumerate()
                .for_each(|(c, to)| self.pack(band, c, to));
            rest = tail;
        }
        all
    }
}

/// The addition of one chunk of input channels to one task's outputs.
struct Chunk<'a, 'b, const K: usize> {
    x: &'a [f32],
    inputs: usize,
    plane: usize,
    row: usize,
    units: &'a [Unit],
    weights: &'a [f32],
    /// The distance between two blocks of weights.
    block: usize,
    channels: usize,
    bias: Option<&'a [f32]>,
    /// Whether this is the first chunk, in which outputs start from the bias.
    fresh: bool,
    /// The outputs, image by image and channel by channel.
    out: &'a mut [&'b mut [f32]],
}

impl<const K: usize> Op for Chunk<'_, '_, K> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(mut self) {
        let mut u = 0;
        while u < self.units.len() {
            let left = self.units.len() - u;
            if L::WIDE {
                // The last four units are processed as two pairs.
                let n = if left == 4 { 2 } else { left.min(3) };
                for b in 0..self.channels.div_ceil(BLOCK) {
                    match n {
                        3 => self.tile::<L, 8, 3>(b, 0, u),
                        2 => self.tile::<L, 8, 2>(b, 0, u),
                        _ => self.tile::<L, 8, 1>(b, 0, u),
                    }
                }
                u += n;
            } else {
                for b in 0..self.channels.div_ceil(BLOCK) {
                    self.tile::<L, 4, 1>(b, 0, u);
                    self.tile::<L, 4, 1>(b, 4, u);
                }
                u += 1;
            }
        }
    }
}

impl<const K: usize> Chunk<'_, '_, K> {
    /// Computes one register tile: `M` channels from `half` on of block `b`, `V` units from `u` on.
    #[inline(always)]
    fn tile<L: Lanes, const M: usize, const V: usize>(&mut self, b: usize, half: usize, u: usize) {
        let first = b * BLOCK + half;
        let valid = M.min(self.channels.saturating_sub(first));
        let mut acc = [[L::splat(0.0); V]; M];
        if !self.fresh {
            for (m, acc) in acc.iter_mut().enumerate().take(valid) {
                for (v, acc) in acc.iter_mut().enumerate() {
                    *acc = self.fetch(&self.units[u + v], first + m);
                }
            }
        } else if let Some(bias) = self.bias {
            for (m, acc) in acc.iter_mut().enumerate().take(valid) {
                *acc = [L::splat(bias[first + m]); V];
            }
        }
        let mut at = [0; V];
        for (v, at) in at.iter_mut().enumerate() {
            *at = self.units[u + v].at;
        }
        // If there are no inputs, there are no weights.
        let weights = (b * self.block + half).min(self.weights.len());
        let acc = shifted::<L, M, V, K>(
            self.x,
            at,
            (self.inputs, self.plane, self.row),
            &self.weights[weights..],
            acc,
        );
        for (m, acc) in acc.iter().enumerate().take(valid) {
            for (v, acc) in acc.iter().enumerate() {
                self.keep(*acc, u + v, first + m);
            }
        }
    }

    #[inline(always)]
    fn fetch<L: Lanes>(&self, unit: &Unit, channel: usize) -> L {
        if let [run] = &unit.runs[..]
            && run.len == LANES
        {
            return L::load(&self.out[run.image * self.channels + channel][run.pixel..]);
        }
        let mut t = [0.0; LANES];
        for run in &unit.runs {
            let from = &self.out[run.image * self.channels + channel];
            t[run.lane..run.lane + run.len].copy_from_slice(&from[run.pixel..run.pixel + run.len]);
        }
        L::load(&t)
    }

    #[inline(always)]
    fn keep<L: Lanes>(&mut self, lanes: L, u: usize, channel: usize) {
        let unit = &self.units[u];
        if let [run] = &unit.runs[..]
            && run.len == LANES
        {
            let to = &mut self.out[run.image * self.channels + channel];
            return lanes.store(&mut to[run.pixel..]);
        }
        let t = lanes.array();
        for run in &unit.runs {
            let to = &mut self.out[run.image * self.channels + channel];
            to[run.pixel..run.pixel + run.len].copy_from_slice(&t[run.lane..run.lane + run.len]);
        }
    }
}

/// Packs weights as `[outputs / 8][inputs][taps][8]`; missing channels are zero.
fn pack_weights(s: &ConvShape, taps: usize, w: &[f32]) -> Scratch {
    let depth = s.inputs * taps;
    let mut packed = Scratch::take(s.outputs.div_ceil(BLOCK) * depth * BLOCK);
    if depth == 0 {
        return packed;
    }
    packed
        .par_chunks_mut(depth * BLOCK)
        .zip(w.par_chunks(depth * BLOCK))
        .for_each(|(to, from)| {
            // Missing rows repeat the first one and are cleared afterwards.
            let rows: [&[f32]; BLOCK] = std::array::from_fn(|m| {
                let m = if m * depth < from.len() { m } else { 0 };
                &from[m * depth..][..depth]
            });
            for (i, to) in to.chunks_exact_mut(BLOCK).enumerate() {
                for (to, row) in to.iter_mut().zip(rows) {
                    *to = row[i];
                }
            }
            let valid = from.len() / depth;
            if valid < BLOCK {
                to.chunks_exact_mut(BLOCK)
                    .for_each(|to| to[valid..].fill(0.0));
            }
        });
    packed
}

/// Packs the weights of the input gradient, transposed and with the taps reversed:
/// `[inputs / 8][outputs][taps][8]`.
fn pack_transposed<const K: usize>(s: &ConvShape, w: &[f32]) -> Scratch {
    let taps = K * K;
    let depth = s.outputs * taps;
    let mut packed = Scratch::take(s.inputs.div_ceil(BLOCK) * depth * BLOCK);
    if depth == 0 {
        return packed;
    }
    // Four blocks at a time give longer pieces of each output's weights.
    packed
        .par_chunks_mut(4 * depth * BLOCK)
        .enumerate()
        .for_each(|(four, to)| {
            for o in 0..s.outputs {
                for (b, to) in to.chunks_exact_mut(depth * BLOCK).enumerate() {
                    let first = (4 * four + b) * BLOCK;
                    let valid = BLOCK.min(s.inputs - first);
                    let to = &mut to[o * taps * BLOCK..][..taps * BLOCK];
                    let from = &w[(o * s.inputs + first) * taps..][..valid * taps];
                    if valid == BLOCK {
                        let from = &from[..BLOCK * taps];
                        for t in 0..taps {
                            for m in 0..BLOCK {
                                to[(taps - 1 - t) * BLOCK + m] = from[m * taps + t];
                            }
                        }
                        continue;
                    }
                    to.fill(0.0);
                    for (m, from) in from.chunks_exact(taps).enumerate() {
                        for (t, x) in from.iter().rev().enumerate() {
                            to[t * BLOCK + m] = *x;
                        }
                    }
                }
            }
        });
    packed
}

/// Returns the band of all rows of one image.
pub(super) fn image_band(grid: Grid, image: usize) -> Band {
    Band {
        images: image..image + 1,
        rows: 0..grid.height,
    }
}
