//! GELU compared with the error function in `f64`, for numbers of all magnitudes.

use super::*;

fn inputs() -> Vec<f32> {
    let mut x: Vec<f32> = (-12_000..=12_000).map(|i| i as f32 / 1000.0).collect();
    x.extend(noise(10_000, 1).iter().map(|x| x * 7.0));
    x.extend([0.0, -0.0, 1e-30, -1e-30, 1e20, -1e20, f32::MIN_POSITIVE]);
    x
}

/// Returns Φ and its slope.
fn normal(x: f64) -> (f64, f64) {
    let below = 0.5 * libm::erfc(-x * std::f64::consts::FRAC_1_SQRT_2);
    let bell = (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt();
    (below, bell)
}

#[test]
fn gelu_equals_the_definition_and_its_gradient_the_slope() {
    let x = inputs();
    let dy = noise(x.len(), 2);
    let y = same_bits(|k| {
        let mut y = vec![f32::NAN; x.len()];
        k.gelu(&x, &mut y);
        vec![y]
    });
    let dx = same_bits(|k| {
        let mut dx = vec![f32::NAN; x.len()];
        k.gelu_grad(&x, &dy, &mut dx);
        vec![dx]
    });
    for (i, x) in x.iter().map(|x| f64::from(*x)).enumerate() {
        let (below, bell) = normal(x);
        let off = (f64::from(y[0][i]) - x * below).abs();
        assert!(
            off <= 2e-7 * x.abs(),
            "gelu({x}): {} is off by {off:e}",
            y[0][i]
        );
        let slope = (below + x * bell) * f64::from(dy[i]);
        let off = (f64::from(dx[0][i]) - slope).abs();
        assert!(off <= 5e-7, "slope at {x}: {} is off by {off:e}", dx[0][i]);
    }
}

#[test]
fn not_a_number_stays_so() {
    for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
        if let Some(k) = Kernels::with(isa) {
            let (mut y, mut dx) = ([0.0; 2], [0.0; 2]);
            k.gelu(&[f32::NAN, 1.0], &mut y);
            k.gelu_grad(&[f32::NAN, 1.0], &[1.0; 2], &mut dx);
            assert!(y[0].is_nan() && dx[0].is_nan(), "{isa:?}");
            assert!(y[1].is_finite() && dx[1].is_finite(), "{isa:?}");
        }
    }
}
