//! Operations along time, compared with the definition.

use super::*;

#[test]
fn moments_lie_beside_their_neighbours_of_the_same_image_and_gradients_go_back() {
    let s = MomentShape {
        images: 3,
        moments: 4,
        values: 37,
    };
    let (x, dy) = (noise(s.len(), 1), noise(3 * s.len(), 2));
    let out = same_bits(|k| {
        let (mut out, mut dx) = (vec![f32::NAN; 3 * s.len()], vec![f32::NAN; s.len()]);
        k.adjacent(&s, &x, &mut out);
        k.adjacent_grad(&s, &dy, &mut dx);
        vec![out, dx]
    });
    let mut expected = vec![0.0; s.len()];
    for (i, y) in out[0].iter().enumerate() {
        let (row, part, value) = (i / 3 / s.values, i / s.values % 3, i % s.values);
        let (image, moment) = (row / s.moments, row % s.moments + part);
        if moment == 0 || moment > s.moments {
            assert_eq!(*y, 0.0);
            continue;
        }
        let from = (image * s.moments + moment - 1) * s.values + value;
        assert_eq!(*y, x[from]);
        expected[from] += f64::from(dy[i]);
    }
    close(&out[1], &expected, 1e-6);
}

#[test]
fn of_two_moments_the_greater_is_kept_and_the_first_of_equals() {
    let s = MomentShape {
        images: 2,
        moments: 4,
        values: 37,
    };
    // Many values are equal.
    let x: Vec<f32> = noise(s.len(), 1)
        .iter()
        .map(|x| (x * 3.0).round())
        .collect();
    let dy = noise(s.len() / 2, 2);
    let out = same_bits(|k| {
        let (mut y, mut dx) = (vec![f32::NAN; s.len() / 2], vec![f32::NAN; s.len()]);
        k.halve_time(&s, &x, &mut y);
        k.halve_time_grad(&s, &x, &dy, &mut dx);
        vec![y, dx]
    });
    for (i, (y, dy)) in out[0].iter().zip(&dy).enumerate() {
        let first = i / s.values * 2 * s.values + i % s.values;
        let second = first + s.values;
        let (a, b) = (x[first], x[second]);
        assert_eq!(*y, a.max(b));
        let expected = if b > a { (0.0, *dy) } else { (*dy, 0.0) };
        assert_eq!((out[1][first], out[1][second]), expected);
    }
    let mut y = [0.0; 3];
    let whole = MomentShape {
        images: 1,
        moments: 2,
        values: 3,
    };
    for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
        if let Some(k) = Kernels::with(isa) {
            k.halve_time(&whole, &[f32::NAN, 1.0, 2.0, 1.0, f32::NAN, 1.0], &mut y);
            assert!(
                y[0].is_nan() && y[1].is_nan() && y[2] == 2.0,
                "{isa:?}: {y:?}"
            );
        }
    }
}
