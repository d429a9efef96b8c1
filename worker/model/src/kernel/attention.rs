//! Multi-head attention within windows of an image, and its gradient, window by window: scores
//! never leave the cache.
//!
//! A window's scores are w²×w² a head. If heads are narrow, this is ten times its features, so the
//! composed form spends its time on passes over scores. Here sixteen queries are processed at once,
//! one a lane: scores, their largest, the exponentials and the sums run along the keys, without
//! sums across lanes. The gradient computes the scores again (Dao et al., FlashAttention, 2022) and
//! transposes blocks of sixteen queries by sixteen keys for the gradients of keys and values.
//!
//! The windows are offset cyclically by `shift` rows and columns from the image's first pixel. The
//! pixels are read and written in place, whereas other implementations shift the image, cut it into
//! windows, join them and shift back.

use rayon::prelude::*;

use super::{
    attention_shape::AttentionShape,
    exp::exp,
    scratch::Scratch,
    simd::{Kernels, LANES, Lanes, Op, Positions, outer},
};

/// The number of windows in a group for the sum of bias gradients. It is fixed, so the number of
/// threads does not affect the bits.
const TOGETHER: usize = 16;

impl Kernels {
    /// Computes attention: a head's scores are ⟨q, k⟩·size^−½ + `bias` (heads, queries, keys),
    /// softmax over the keys. Writes all of `out`.
    pub fn window_attention(self, s: &AttentionShape, qkv: &[f32], bias: &[f32], out: &mut [f32]) {
        s.check();
        let (tokens, channels) = (s.tokens(), s.channels());
        assert_eq!(qkv.len(), s.pixels() * 3 * channels, "input length");
        assert_eq!(bias.len(), s.heads * tokens * tokens, "bias length");
        assert_eq!(out.len(), s.pixels() * channels, "output length");
        if out.is_empty() {
            return;
        }
        let bias = s.turned(bias);
        let mut windows = Scratch::take(out.len());
        let each = windows.par_chunks_mut(tokens * channels).enumerate();
        each.for_each(|(window, out)| {
            let mut rows = Scratch::take(tokens * 3 * channels);
            s.gather(qkv, 3 * channels, window, &mut rows);
            let mask = s.mask(window);
            self.run(Attend {
                s,
                qkv: &rows,
                bias: &bias,
                mask: mask.as_deref(),
                out,
            });
        });
        s.scatter(&windows, channels, out);
    }

    /// Computes the gradient of [`Kernels::window_attention`] from its inputs and the output's
    /// gradient. Writes all of `dqkv` and `dbias`.
    pub fn window_attention_grad(
        self,
        s: &AttentionShape,
        qkv: &[f32],
        bias: &[f32],
        dy: &[f32],
        dqkv: &mut [f32],
        dbias: &mut [f32],
    ) {
        s.check();
        let (tokens, padded, channels) = (s.tokens(), s.padded(), s.channels());
        assert_eq!(
            (qkv.len(), dqkv.len()),
            (s.pixels() * 3 * channels, s.pixels() * 3 * channels),
            "input length"
        );
        assert_eq!(
            (bias.len(), dbias.len()),
            (s.heads * tokens * tokens, s.heads * tokens * tokens),
            "bias length"
        );
        assert_eq!(dy.len(), s.pixels() * channels, "output length");
        dbias.fill(0.0);
        if dqkv.is_empty() {
            return;
        }
        let bias = s.turned(bias);
        let mut windows = Scratch::take(dqkv.len());
        let parts = windows.par_chunks_mut(TOGETHER * tokens * 3 * channels);
        let sums: Vec<Vec<f32>> = parts
            .enumerate()
            .map(|(part, dqkv)| {
                let mut dbias = vec![0.0; s.heads * tokens * padded];
                let (mut rows, mut drows) = (
                    Scratch::take(tokens * 3 * channels),
                    Scratch::take(tokens * channels),
                );
                for (i, dqkv) in dqkv.chunks_exact_mut(tokens * 3 * channels).enumerate() {
                    let window = part * TOGETHER + i;
                    s.gather(qkv, 3 * channels, window, &mut rows);
                    s.gather(dy, channels, window, &mut drows);
                    let mask = s.mask(window);
                    self.run(AttendGrad {
                        of: Attend {
                            s,
                            qkv: &rows,
                            bias: &bias,
                            mask: mask.as_deref(),
                            out: dqkv,
                        },
                        dy: &drows,
                        dbias: &mut dbias,
                    });
                }
                dbias
            })
            .collect();
        s.scatter(&windows, 3 * channels, dqkv);
        let each = dbias.par_chunks_mut(tokens).enumerate();
        each.for_each(|(row, to)| {
            let (head, query) = (row / tokens, row % tokens);
            for (key, to) in to.iter_mut().enumerate() {
                let at = (head * tokens + key) * padded + query;
                *to = sums.iter().fold(0.0, |sum, part| sum + part[at]);
            }
        });
    }
}

/// The attention of one window: queries, keys and values [tokens][3·channels] to
/// [tokens][channels].
struct Attend<'a> {
    s: &'a AttentionShape,
    qkv: &'a [f32],
    bias: &'a [f32],
    mask: Option<&'a [f32]>,
    out: &'a mut [f32],
}

/// `sum[n] = Σ_k scalars[at + n·apart + k·step] · vectors[k·wide..]`, in order of k.
#[inline(always)]
fn sums<L: Lanes, const N: usize>(
    scalars: &[f32],
    [at, apart, step]: [usize; 3],
    vectors: &[f32],
    wide: usize,
    count: usize,
) -> [L; N] {
    let positions = Positions {
        rows: 1,
        width: count,
        row: 0,
        step,
        wide,
        apart: 0,
    };
    let at = std::array::from_fn(|n| at + n * apart);
    let sums = outer::<L, 1, N, 1>(scalars, at, vectors, positions);
    sums.map(|[[sum]]| sum)
}

/// Computes [`sums`] for any number of results, some at a time: the n-th is stored at `to[16·n..]`.
#[inline(always)]
fn products<L: Lanes>(
    scalars: &[f32],
    [at, apart, step]: [usize; 3],
    vectors: &[f32],
    wide: usize,
    count: usize,
    to: &mut [f32],
) {
    let results = to.len() / LANES;
    let mut done = 0;
    while done < results {
        let from = [at + done * apart, apart, step];
        macro_rules! some {
            ($n:literal) => {{
                let found = sums::<L, $n>(scalars, from, vectors, wide, count);
                for (i, sum) in found.into_iter().enumerate() {
                    sum.store(&mut to[(done + i) * LANES..]);
                }
                done += $n;
            }};
        }
        match results - done {
            8.. => some!(8),
            4.. => some!(4),
            2.. => some!(2),
            _ => some!(1),
        }
    }
}

impl Attend<'_> {
    /// Computes the exponentials of sixteen queries' scores minus their largest, [keys][16].
    /// Returns the reciprocals of their sums.
    #[inline(always)]
    fn exponentials<L: Lanes>(
        &self,
        head: usize,
        queries: &[f32],
        group: usize,
        to: &mut [f32],
    ) -> L {
        let s = self.s;
        let (tokens, padded, channels) = (s.tokens(), s.padded(), s.channels());
        let to = &mut to[..tokens * LANES];
        let keys = [channels + head * s.size, 3 * channels, 1];
        products::<L>(self.qkv, keys, &queries[group..], padded, s.size, to);
        let bias = &self.bias[head * tokens * padded..][..tokens * padded];
        let mut largest = L::splat(f32::NEG_INFINITY);
        for (key, row) in to.chunks_exact_mut(LANES).enumerate() {
            let at = key * padded + group;
            let mut score = L::load(row).add(L::load(&bias[at..]));
            if let Some(mask) = self.mask {
                score = score.add(L::load(&mask[at..]));
            }
            largest = largest.max(score);
            score.store(row);
        }
        let mut sum = L::splat(0.0);
        for row in to.chunks_exact_mut(LANES) {
            let value = exp(L::load(row).sub(largest));
            sum = sum.add(value);
            value.store(row);
        }
        L::splat(1.0).div(sum)
    }

    /// Transposes a head's part of rows to [size][padded tokens] and multiplies it by `factor`.
    #[inline(always)]
    fn turn(&self, rows: &[f32], wide: usize, at: usize, factor: f32, to: &mut [f32]) {
        let padded = self.s.padded();
        to[..self.s.size * padded].fill(0.0);
        for (token, row) in rows.chunks_exact(wide).enumerate() {
            for (d, value) in row[at..at + self.s.size].iter().enumerate() {
                to[d * padded + token] = value * factor;
            }
        }
    }

    fn factor(&self) -> f32 {
        1.0 / (self.s.size as f32).sqrt()
    }
}

/// Multiplies [features][16] by `factor` and transposes it into up to sixteen rows of tokens from
/// `group` on, starting at feature `at`.
#[inline(always)]
fn spread<L: Lanes>(from: &[f32], factor: L, to: &mut [f32], group: usize, wide: usize, at: usize) {
    for (d, row) in from.chunks_exact(LANES).enumerate() {
        let values = L::load(row).mul(factor).array();
        for (row, value) in to.chunks_exact_mut(wide).skip(group).zip(values) {
            row[at + d] = value;
        }
    }
}

impl Op for Attend<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let s = self.s;
        let (tokens, padded, channels) = (s.tokens(), s.padded(), s.channels());
        let mut queries = Scratch::take(s.size * padded);
        let mut weights = Scratch::take(tokens * LANES);
        let mut said = Scratch::take(s.size * LANES);
        for head in 0..s.heads {
            let at = head * s.size;
            self.turn(self.qkv, 3 * channels, at, self.factor(), &mut queries);
            for group in (0..padded).step_by(LANES) {
                let over = self.exponentials::<L>(head, &queries, group, &mut weights);
                let values = [2 * channels + at, 1, 3 * channels];
                products::<L>(self.qkv, values, &weights, LANES, tokens, &mut said);
                spread(&said, over, self.out, group, channels, at);
            }
        }
    }
}

/// The gradient of one window: writes `of.out`, [tokens][3·channels], and adds to `dbias`,
/// [heads][keys][padded queries].
struct AttendGrad<'a> {
    of: Attend<'a>,
    dy: &'a [f32],
    dbias: &'a mut [f32],
}

impl Op for AttendGrad<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let Self { of, dy, dbias } = self;
        let s = of.s;
        let (tokens, padded, channels) = (s.tokens(), s.padded(), s.channels());
        let (wide, factor) = (3 * channels, of.factor());
        let mut queries = Scratch::take(s.size * padded);
        let mut given = Scratch::take(s.size * padded);
        let mut weights = Scratch::take(padded * LANES);
        let mut slopes = Scratch::take(padded * LANES);
        let mut part = Scratch::take(s.size * LANES);
        // The gradients of keys and of values, [groups of keys][size][16].
        let mut by_key = Scratch::take(s.size * padded);
        let mut by_value = Scratch::take(s.size * padded);
        weights[tokens * LANES..].fill(0.0);
        slopes[tokens * LANES..].fill(0.0);
        let mut turned = [0.0; LANES * LANES];
        for head in 0..s.heads {
            let at = head * s.size;
            of.turn(of.qkv, wide, at, factor, &mut queries);
            of.turn(dy, channels, at, 1.0, &mut given);
            by_key.fill(0.0);
            by_value.fill(0.0);
            let dbias = &mut dbias[head * tokens * padded..][..tokens * padded];
            for group in (0..padded).step_by(LANES) {
                let over = of.exponentials::<L>(head, &queries, group, &mut weights);
                let (values, rows) = ([2 * channels + at, wide, 1], tokens * LANES);
                let by_weight = &mut slopes[..rows];
                products::<L>(of.qkv, values, &given[group..], padded, s.size, by_weight);
                // Softmax: dS = P·(dP − Σ P·dP).
                let mut sum = L::splat(0.0);
                let both = weights[..rows].chunks_exact_mut(LANES);
                for (weight, slope) in both.zip(slopes.chunks_exact(LANES)) {
                    let share = L::load(weight).mul(over);
                    share.store(weight);
                    sum = share.fma(L::load(slope), sum);
                }
                let both = weights[..rows].chunks_exact(LANES);
                let both = both.zip(slopes.chunks_exact_mut(LANES));
                for ((weight, slope), to) in both.zip(dbias.chunks_exact_mut(padded)) {
                    let by_score = L::load(weight).mul(L::load(slope).sub(sum));
                    by_score.store(slope);
                    let to = &mut to[group..];
                    L::load(to).add(by_score).store(to);
                }
                let keys = [channels + at, 1, wide];
                products::<L>(of.qkv, keys, &slopes, LANES, tokens, &mut part);
                spread(&part, L::splat(factor), of.out, group, wide, at);
                let asked = LANES.min(tokens - group);
                let blocks = weights.chunks_exact(LANES * LANES);
                let blocks = blocks.zip(by_value.chunks_exact_mut(s.size * LANES));
                for (block, to) in blocks {
                    turn_block::<L>(block, &mut turned);
                    let rows = [group * channels + at, 1, channels];
                    products::<L>(dy, rows, &turned, LANES, asked, &mut part);
                    add_to::<L>(&part, to);
                }
                let blocks = slopes.chunks_exact(LANES * LANES);
                let blocks = blocks.zip(by_key.chunks_exact_mut(s.size * LANES));
                for (block, to) in blocks {
                    turn_block::<L>(block, &mut turned);
                    let rows = [group * wide + at, 1, wide];
                    products::<L>(of.qkv, rows, &turned, LANES, asked, &mut part);
                    add_to::<L>(&part, to);
                }
            }
            let groups = (0..padded).step_by(LANES);
            let both = by_key
                .chunks_exact(s.size * LANES)
                .zip(by_value.chunks_exact(s.size * LANES));
            for (group, (key, value)) in groups.zip(both) {
                spread(key, L::splat(factor), of.out, group, wide, channels + at);
                spread(value, L::splat(1.0), of.out, group, wide, 2 * channels + at);
            }
        }
    }
}

/// Transposes sixteen rows of sixteen lanes.
#[inline(always)]
fn turn_block<L: Lanes>(from: &[f32], to: &mut [f32; LANES * LANES]) {
    let mut rows = [L::splat(0.0); LANES];
    for (row, from) in rows.iter_mut().zip(from.chunks_exact(LANES)) {
        *row = L::load(from);
    }
    let rows = L::transpose(rows);
    for (row, to) in rows.iter().zip(to.chunks_exact_mut(LANES)) {
        row.store(to);
    }
}

#[inline(always)]
fn add_to<L: Lanes>(part: &[f32], to: &mut [f32]) {
    for (part, to) in part.chunks_exact(LANES).zip(to.chunks_exact_mut(LANES)) {
        L::load(to).add(L::load(part)).store(to);
    }
}
