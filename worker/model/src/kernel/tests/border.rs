//! Borders and leaky ReLU have the same bits everywhere. tests/it/operations.rs compares their
//! values with burn's operations.

use super::*;

#[test]
fn borders_have_the_same_bits_and_what_is_cut_off_was_what_was_added() {
    for volume in [false, true] {
        let s = BorderShape {
            images: 6,
            moments: 3,
            volume,
            channels: 2,
            height: 5,
            width: 37,
        };
        let parts = if volume { 3 } else { 1 };
        let around = s.images * parts * s.channels * (s.height + 2) * (s.width + 2);
        let (x, dy) = (noise(s.len(), 1), noise(around, 2));
        let out = same_bits(|k| {
            let (mut y, mut dx) = (vec![f32::NAN; around], vec![f32::NAN; s.len()]);
            k.surround(&s, &x, &mut y);
            k.surround_grad(&s, &dy, &mut dx);
            vec![y, dx]
        });
        // Every output value comes from exactly one input value.
        let sum = |x: &[f32]| x.iter().map(|x| f64::from(*x)).sum::<f64>();
        assert!((sum(&out[1]) - sum(&dy)).abs() < 1e-3);
        if !volume {
            let cut = same_bits(|k| {
                let (mut y, mut back) = (vec![f32::NAN; s.len()], vec![f32::NAN; around]);
                k.crop(&s, &out[0], &[0.0, 0.0], &mut y);
                k.crop_grad(&s, &x, &mut back);
                vec![y, back]
            });
            assert_eq!(cut[0], x);
            assert!((sum(&cut[1]) - sum(&x)).abs() < 1e-3);
        }
    }
}

#[test]
fn leaky_relu_keeps_what_is_above_nought_and_not_a_number() {
    let x: Vec<f32> = noise(1001, 3).into_iter().chain([0.0, f32::NAN]).collect();
    for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
        if let Some(k) = Kernels::with(isa) {
            let (mut y, mut dx) = (vec![0.0; x.len()], vec![0.0; x.len()]);
            k.leaky_relu(0.2, &x, &mut y);
            k.leaky_relu_grad(0.2, &x, &vec![1.0; x.len()], &mut dx);
            assert!(y[1002].is_nan(), "{isa:?}");
            for ((x, y), dx) in x.iter().zip(&y).zip(&dx).take(1002) {
                let (of, slope) = if *x > 0.0 { (*x, 1.0) } else { (x * 0.2, 0.2) };
                assert_eq!((*y, *dx), (of, slope), "{isa:?}: {x}");
            }
        }
    }
}
