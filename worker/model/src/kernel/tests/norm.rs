//! Batch norm with ReLU, compared with the definition and finite differences.

use proptest::prelude::*;

use super::*;

const EPS: f32 = 1e-5;

/// One step of the kernel on the widest instruction set: y, mean, var.
fn forward(k: Kernels, s: &NormShape, x: &[f32], gamma: &[f32], beta: &[f32]) -> Vec<Vec<f32>> {
    let mut y = vec![f32::NAN; s.len()];
    let (mut mean, mut var) = (vec![f32::NAN; s.channels], vec![f32::NAN; s.channels]);
    k.batch_norm_relu(s, x, gamma, beta, EPS, &mut y, &mut mean, &mut var);
    vec![y, mean, var]
}

fn backward(k: Kernels, s: &NormShape, x: &[f32], norm: &BatchNorm, dy: &[f32]) -> Vec<Vec<f32>> {
    let mut dx = vec![f32::NAN; s.len()];
    let (mut dgamma, mut dbeta) = (vec![f32::NAN; s.channels], vec![f32::NAN; s.channels]);
    k.batch_norm_relu_grad(s, x, norm, dy, &mut dx, &mut dgamma, &mut dbeta);
    vec![dx, dgamma, dbeta]
}

/// The values before ReLU, in `f64`.
fn oracle(s: &NormShape, x: &[f64], gamma: &[f32], beta: &[f32]) -> Vec<f64> {
    let count = (s.images * s.pixels) as f64;
    let of = |i: usize| i / s.pixels % s.channels;
    let (mut mean, mut var) = (vec![0.0; s.channels], vec![0.0; s.channels]);
    for (i, x) in x.iter().enumerate() {
        mean[of(i)] += x / count;
    }
    for (i, x) in x.iter().enumerate() {
        var[of(i)] += (x - mean[of(i)]).powi(2) / count;
    }
    x.iter()
        .enumerate()
        .map(|(i, x)| {
            let c = of(i);
            (x - mean[c]) / (var[c] + f64::from(EPS)).sqrt() * f64::from(gamma[c])
                + f64::from(beta[c])
        })
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn batch_norm_equals_the_definition_and_its_differences(
        images in 1usize..4, channels in 1usize..5, pixels in 2usize..150, seed in 0u64..1000,
    ) {
        let s = NormShape { images, channels, pixels };
        let x: Vec<f32> = noise(s.len(), seed).iter().map(|x| x * 2.0 + 0.5).collect();
        let gamma: Vec<f32> = noise(channels, seed + 1).iter().map(|x| x + 1.5).collect();
        let beta = noise(channels, seed + 2);
        let dy = noise(s.len(), seed + 3);
        let out = same_bits(|k| forward(k, &s, &x, &gamma, &beta));
        let norm = BatchNorm { gamma: &gamma, beta: &beta, mean: &out[1], var: &out[2], eps: EPS };
        let grads = same_bits(|k| backward(k, &s, &x, &norm, &dy));
        let eval = same_bits(|k| {
            let mut y = vec![f32::NAN; s.len()];
            k.norm_relu(&s, &x, &norm, &mut y);
            vec![y]
        });
        prop_assert_eq!(&eval[0], &out[0]);

        let wide: Vec<f64> = x.iter().map(|x| f64::from(*x)).collect();
        let z = oracle(&s, &wide, &gamma, &beta);
        close(&out[0], &z.iter().map(|z| z.max(0.0)).collect::<Vec<_>>(), 1e-5);

        // Central differences of Σ dy·y over the pixels that are let through, in f64.
        let open: Vec<bool> = out[0].iter().map(|y| *y > 0.0).collect();
        let loss = |x: &[f64], gamma: &[f32], beta: &[f32]| -> f64 {
            let z = oracle(&s, x, gamma, beta);
            z.iter().zip(&dy).zip(&open).map(|((z, g), open)| if *open { z * f64::from(*g) } else { 0.0 }).sum()
        };
        for i in [0, s.len() / 2, s.len() - 1] {
            let (mut up, mut down) = (wide.clone(), wide.clone());
            up[i] += 1e-4;
            down[i] -= 1e-4;
            let slope = (loss(&up, &gamma, &beta) - loss(&down, &gamma, &beta)) / 2e-4;
            close(&grads[0][i..=i], &[slope], 1e-3);
        }
        let (mut dgamma, mut dbeta) = (vec![0.0; channels], vec![0.0; channels]);
        for (i, g) in dy.iter().enumerate().filter(|(i, _)| open[*i]) {
            let c = i / pixels % channels;
            dbeta[c] += f64::from(*g);
            dgamma[c] += f64::from(*g) * (z[i] - f64::from(beta[c])) / f64::from(gamma[c]);
        }
        close(&grads[1], &dgamma, 1e-4);
        close(&grads[2], &dbeta, 1e-4);
    }
}

#[test]
fn constant_channels_stay_finite() {
    let s = NormShape {
        images: 2,
        channels: 3,
        pixels: 37,
    };
    let x: Vec<f32> = (0..s.len()).map(|i| [0.0, 1e6, -0.1][i / 37 % 3]).collect();
    let (gamma, beta, dy) = ([1.0; 3], [0.5; 3], noise(s.len(), 1));
    let out = same_bits(|k| forward(k, &s, &x, &gamma, &beta));
    let norm = BatchNorm {
        gamma: &gamma,
        beta: &beta,
        mean: &out[1],
        var: &out[2],
        eps: EPS,
    };
    let grads = same_bits(|k| backward(k, &s, &x, &norm, &dy));
    assert!(out.iter().chain(&grads).flatten().all(|x| x.is_finite()));
}

#[test]
fn not_a_number_is_not_hidden_by_relu() {
    let s = NormShape {
        images: 1,
        channels: 1,
        pixels: 20,
    };
    let mut x = noise(20, 1);
    x[3] = f32::NAN;
    for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
        if let Some(k) = Kernels::with(isa) {
            assert!(
                forward(k, &s, &x, &[1.0], &[0.0])[0]
                    .iter()
                    .all(|y| y.is_nan())
            );
        }
    }
}
