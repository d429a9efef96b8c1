//! Attention within windows compared with a loop over pairs of pixels in `f64`, and its gradient
//! compared with that loop's slopes.

use proptest::prelude::*;

use super::*;

/// Computes attention pixel by pixel. A window contains the pixels within its rows and columns
/// after the shift is undone. Pixels from different ends of the image are masked.
fn oracle(s: &AttentionShape, qkv: &[f64], bias: &[f64]) -> Vec<f64> {
    let (tokens, channels, w) = (s.tokens(), s.channels(), s.window);
    let mut out = vec![0.0; s.pixels() * channels];
    let image = s.height * s.width;
    let place = |pixel: usize| {
        let (row, column) = (pixel % image / s.width, pixel % s.width);
        let turn = |at: usize, len: usize| (at + len - s.shift) % len;
        (turn(row, s.height), turn(column, s.width))
    };
    for asked in 0..s.pixels() {
        let (row, column) = place(asked);
        let ends =
            |row: usize, column: usize| (row + s.shift >= s.height, column + s.shift >= s.width);
        let within = (0..s.pixels()).filter(|other| {
            let (r, c) = place(*other);
            *other / image == asked / image && (r / w, c / w) == (row / w, column / w)
        });
        let within: Vec<usize> = within.collect();
        for head in 0..s.heads {
            let of = |pixel: usize, part: usize, d: usize| {
                qkv[(pixel * 3 + part) * channels + head * s.size + d]
            };
            let score = |key: usize| {
                let (r, c) = place(key);
                let product: f64 = (0..s.size).map(|d| of(asked, 0, d) * of(key, 1, d)).sum();
                let token = |row: usize, column: usize| row % w * w + column % w;
                let pair = (head * tokens + token(row, column)) * tokens + token(r, c);
                let apart = ends(row, column) != ends(r, c);
                product / (s.size as f64).sqrt()
                    + bias[pair]
                    + if apart { f64::from(s.apart) } else { 0.0 }
            };
            let largest = within
                .iter()
                .map(|key| score(*key))
                .fold(f64::MIN, f64::max);
            let shares: Vec<f64> = within
                .iter()
                .map(|key| (score(*key) - largest).exp())
                .collect();
            let whole: f64 = shares.iter().sum();
            for d in 0..s.size {
                let sum = within
                    .iter()
                    .zip(&shares)
                    .map(|(key, share)| share * of(*key, 2, d));
                out[asked * channels + head * s.size + d] = sum.sum::<f64>() / whole;
            }
        }
    }
    out
}

fn wide(x: &[f32]) -> Vec<f64> {
    x.iter().map(|x| f64::from(*x)).collect()
}

fn forward(k: Kernels, s: &AttentionShape, qkv: &[f32], bias: &[f32]) -> Vec<Vec<f32>> {
    let mut out = vec![f32::NAN; s.pixels() * s.channels()];
    k.window_attention(s, qkv, bias, &mut out);
    vec![out]
}

fn backward(
    k: Kernels,
    s: &AttentionShape,
    qkv: &[f32],
    bias: &[f32],
    dy: &[f32],
) -> Vec<Vec<f32>> {
    let (mut dqkv, mut dbias) = (vec![f32::NAN; qkv.len()], vec![f32::NAN; bias.len()]);
    k.window_attention_grad(s, qkv, bias, dy, &mut dqkv, &mut dbias);
    vec![dqkv, dbias]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn attention_equals_a_loop_over_pixels_and_its_gradient_the_slopes_of_that(
        images in 1usize..3, rows in 1usize..4, columns in 1usize..4, window in 1usize..6,
        shifted in 0usize..6, heads in 1usize..4, size in 1usize..20, seed in 0u64..1000,
    ) {
        let s = AttentionShape {
            images,
            height: rows * window,
            width: columns * window,
            window,
            shift: shifted % window,
            heads,
            size,
            apart: -100.0,
        };
        let qkv: Vec<f32> = noise(s.pixels() * 3 * s.channels(), seed).iter().map(|x| 2.0 * x).collect();
        let bias = noise(heads * s.tokens() * s.tokens(), seed + 1);
        let dy = noise(s.pixels() * s.channels(), seed + 2);
        let out = same_bits(|k| forward(k, &s, &qkv, &bias));
        let grads = same_bits(|k| backward(k, &s, &qkv, &bias, &dy));
        close(&out[0], &oracle(&s, &wide(&qkv), &wide(&bias)), 3e-6);

        let loss = |qkv: &[f64], bias: &[f64]| -> f64 {
            let y = oracle(&s, qkv, bias);
            y.iter().zip(&dy).map(|(y, g)| y * f64::from(*g)).sum()
        };
        let step = 1e-5;
        for i in [0, qkv.len() / 3, qkv.len() / 2, qkv.len() - 1] {
            let moved = |by: f64| {
                let mut qkv = wide(&qkv);
                qkv[i] += by;
                loss(&qkv, &wide(&bias))
            };
            close(&grads[0][i..=i], &[(moved(step) - moved(-step)) / (2.0 * step)], 2e-5);
        }
        for i in [0, bias.len() / 2, bias.len() - 1] {
            let moved = |by: f64| {
                let mut bias = wide(&bias);
                bias[i] += by;
                loss(&wide(&qkv), &bias)
            };
            close(&grads[1][i..=i], &[(moved(step) - moved(-step)) / (2.0 * step)], 2e-5);
        }
    }
}

/// There are more windows than are summed together, and the size is that of real networks.
#[test]
fn many_windows_have_the_same_bits_for_any_number_of_threads() {
    let s = AttentionShape {
        images: 2,
        height: 32,
        width: 40,
        window: 8,
        shift: 4,
        heads: 4,
        size: 6,
        apart: -100.0,
    };
    let qkv = noise(s.pixels() * 3 * s.channels(), 1);
    let bias = noise(s.heads * s.tokens() * s.tokens(), 2);
    let dy = noise(s.pixels() * s.channels(), 3);
    let out = same_bits(|k| forward(k, &s, &qkv, &bias));
    let grads = same_bits(|k| backward(k, &s, &qkv, &bias, &dy));
    assert!(out.iter().chain(&grads).flatten().all(|x| x.is_finite()));
    // A softmax does not change if all scores increase by the same amount.
    let zero: f64 = grads[1].iter().map(|x| f64::from(*x)).sum();
    assert!(zero.abs() < 1e-3, "{zero}");
}

#[test]
fn scores_of_any_size_give_shares_and_not_a_number_is_not_hidden() {
    let s = AttentionShape {
        images: 1,
        height: 4,
        width: 4,
        window: 4,
        shift: 0,
        heads: 1,
        size: 2,
        apart: -100.0,
    };
    let bias = vec![0.0; 256];
    let mut qkv: Vec<f32> = noise(s.pixels() * 6, 4).iter().map(|x| x * 1e4).collect();
    let out = same_bits(|k| forward(k, &s, &qkv, &bias));
    assert!(out[0].iter().all(|y| y.abs() <= 1e4), "{out:?}");
    qkv[0] = f32::NAN;
    for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
        if let Some(k) = Kernels::with(isa) {
            let out = forward(k, &s, &qkv, &bias);
            assert!(out[0][..2].iter().all(|y| y.is_nan()), "{isa:?}");
        }
    }
}
