//! Layer norm compared with the definition in `f64`, and its gradient compared with the
//! definition's slopes.

use proptest::prelude::*;

use super::*;

const EPS: f32 = 1e-5;

fn oracle(x: &[f64], gamma: &[f64], beta: &[f64]) -> Vec<f64> {
    let wide = gamma.len();
    let row = |row: &[f64]| {
        let mean = row.iter().sum::<f64>() / wide as f64;
        let inverse = 1.0 / deviation(row);
        let of = |(i, x): (usize, &f64)| (x - mean) * inverse * gamma[i] + beta[i];
        row.iter().enumerate().map(of).collect::<Vec<_>>()
    };
    x.chunks_exact(wide).flat_map(row).collect()
}

/// Returns the divisor of a row.
fn deviation(row: &[f64]) -> f64 {
    let n = row.len() as f64;
    let mean = row.iter().sum::<f64>() / n;
    (row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n + f64::from(EPS)).sqrt()
}

fn wide(x: &[f32]) -> Vec<f64> {
    x.iter().map(|x| f64::from(*x)).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn layer_norm_equals_the_definition_and_its_differences(
        rows in 1usize..1100, columns in 2usize..50, seed in 0u64..1000,
    ) {
        let x: Vec<f32> = noise(rows * columns, seed).iter().map(|x| x * 3.0 - 1.0).collect();
        let gamma: Vec<f32> = noise(columns, seed + 1).iter().map(|x| x + 1.5).collect();
        let (beta, dy) = (noise(columns, seed + 2), noise(x.len(), seed + 3));
        let norm = LayerNorm { gamma: &gamma, beta: &beta, eps: EPS };
        let out = same_bits(|k| {
            let (mut y, mut dx) = (vec![f32::NAN; x.len()], vec![f32::NAN; x.len()]);
            let (mut dgamma, mut dbeta) = (vec![f32::NAN; columns], vec![f32::NAN; columns]);
            k.layer_norm(&norm, &x, &mut y);
            k.layer_norm_grad(&norm, &x, &dy, &mut dx, &mut dgamma, &mut dbeta);
            vec![y, dx, dgamma, dbeta]
        });
        let (x, gamma, beta) = (wide(&x), wide(&gamma), wide(&beta));
        // In a row of almost equal values, rounding errors are divided by its small deviation.
        let least = x.chunks_exact(columns).map(deviation).fold(f64::INFINITY, f64::min);
        let rounding = 1e-6 / least;
        close(&out[0], &oracle(&x, &gamma, &beta), rounding.max(1e-5));
        let loss = |x: &[f64], gamma: &[f64], beta: &[f64]| -> f64 {
            oracle(x, gamma, beta).iter().zip(&dy).map(|(y, g)| y * f64::from(*g)).sum()
        };
        let step = 1e-5;
        let moved = |of: &[f64], at: usize, by: f64| {
            let mut of = of.to_vec();
            of[at] += by;
            of
        };
        for i in [0, x.len() / 2, x.len() - 1] {
            let at = |by: f64| loss(&moved(&x, i, by), &gamma, &beta);
            // Slopes are steep if two values in a row are almost equal.
            close(&out[1][i..=i], &[(at(step) - at(-step)) / (2.0 * step)], 2e-2);
        }
        for i in [0, columns - 1] {
            let at = |by: f64| loss(&x, &moved(&gamma, i, by), &beta);
            close(&out[2][i..=i], &[(at(step) - at(-step)) / (2.0 * step)], rounding.max(1e-4));
            let at = |by: f64| loss(&x, &gamma, &moved(&beta, i, by));
            close(&out[3][i..=i], &[(at(step) - at(-step)) / (2.0 * step)], 1e-4);
        }
    }
}

#[test]
fn rows_that_do_not_change_stay_finite_and_not_a_number_is_not_hidden() {
    let (gamma, beta) = ([1.0; 20], [0.5; 20]);
    let norm = LayerNorm {
        gamma: &gamma,
        beta: &beta,
        eps: EPS,
    };
    let mut x = [3.0; 40];
    let out = same_bits(|k| {
        let (mut y, mut dx) = (vec![f32::NAN; 40], vec![f32::NAN; 40]);
        let (mut dgamma, mut dbeta) = (vec![0.0; 20], vec![0.0; 20]);
        k.layer_norm(&norm, &x, &mut y);
        k.layer_norm_grad(&norm, &x, &[1.0; 40], &mut dx, &mut dgamma, &mut dbeta);
        vec![y, dx, dgamma, dbeta]
    });
    assert!(out.iter().flatten().all(|x| x.is_finite()));
    x[3] = f32::NAN;
    for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
        if let Some(k) = Kernels::with(isa) {
            let mut y = [0.0; 40];
            k.layer_norm(&norm, &x, &mut y);
            assert!(
                y[..20].iter().all(|y| y.is_nan()) && y[20] == 0.5,
                "{isa:?}"
            );
        }
    }
}
