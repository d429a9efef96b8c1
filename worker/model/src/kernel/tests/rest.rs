//! Pooling, upsampling and AdamW, compared with the definitions.

use proptest::prelude::*;

use super::*;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn pooling_takes_the_first_largest_and_returns_its_gradient_there(
        planes in 1usize..4, height in 1usize..9, width in 1usize..40, seed in 0u64..1000,
    ) {
        let s = PlaneShape { planes, height, width };
        // Few values, so that ties are common.
        let x: Vec<f32> = noise(s.len(), seed).iter().map(|x| (x * 3.0).round()).collect();
        let small = s.halved();
        let dy = noise(small.len(), seed + 1);
        let got = same_bits(|k| {
            let (mut y, mut which) = (vec![f32::NAN; small.len()], vec![9; small.len()]);
            let mut dx = vec![f32::NAN; s.len()];
            k.max_pool(&s, &x, &mut y, &mut which);
            k.max_pool_grad(&s, &dy, &which, &mut dx);
            vec![y, dx]
        });
        let (mut y, mut dx) = (Vec::new(), vec![0.0; s.len()]);
        for (i, dy) in dy.iter().enumerate() {
            let (p, r) = (i / (small.height * small.width), i % (small.height * small.width));
            let corner = (p * height + r / small.width * 2) * width + r % small.width * 2;
            let four = [corner, corner + 1, corner + width, corner + width + 1];
            let best = four.into_iter().rev().max_by(|a, b| x[*a].total_cmp(&(x[*b] + 0.0)));
            let best = four.into_iter().find(|a| x[*a] == x[best.unwrap()]).unwrap();
            y.push(x[best]);
            dx[best] = *dy;
        }
        prop_assert_eq!(&got[0], &y);
        prop_assert_eq!(&got[1], &dx);
    }

    #[test]
    fn upsampling_repeats_pixels_and_its_gradient_sums_them(
        planes in 1usize..4, height in 1usize..6, width in 1usize..40, seed in 0u64..1000,
    ) {
        let s = PlaneShape { planes, height, width };
        let large = s.doubled();
        let (x, dy) = (noise(s.len(), seed), noise(large.len(), seed + 1));
        let got = same_bits(|k| {
            let (mut y, mut dx) = (vec![f32::NAN; large.len()], vec![f32::NAN; s.len()]);
            k.upsample(&s, &x, &mut y);
            k.upsample_grad(&s, &dy, &mut dx);
            vec![y, dx]
        });
        let mut dx = vec![0.0; s.len()];
        for (i, y) in got[0].iter().enumerate() {
            let (row, column) = (i / large.width, i % large.width);
            let from = row / 2 * width + column / 2;
            prop_assert_eq!(*y, x[from]);
            dx[from] += f64::from(dy[i]);
        }
        close(&got[1], &dx, 1e-6);
    }

    #[test]
    fn adamw_follows_its_formula(len in 1usize..100, step in 1u32..2000, seed in 0u64..1000) {
        let a = AdamW { learning_rate: 1e-2, beta1: 0.9, beta2: 0.999, eps: 1e-8, decay: 1e-2, step };
        let (p, g, m) = (noise(len, seed), noise(len, seed + 1), noise(len, seed + 2));
        let v: Vec<f32> = noise(len, seed + 3).iter().map(|x| x * x + 0.01).collect();
        let got = same_bits(|k| {
            let (mut p, mut m, mut v) = (p.clone(), m.clone(), v.clone());
            k.adamw(&a, &mut p, &g, &mut m, &mut v);
            vec![p, m, v]
        });
        let mut want = [vec![], vec![], vec![]];
        for i in 0..len {
            let [p, g, m, v] = [p[i], g[i], m[i], v[i]].map(f64::from);
            let m = a.beta1 * m + (1.0 - a.beta1) * g;
            let v = a.beta2 * v + (1.0 - a.beta2) * g * g;
            let fix = |b: f64| 1.0 - b.powi(step as i32);
            let below = (v / fix(a.beta2)).sqrt() + a.eps;
            want[0].push(p * (1.0 - a.learning_rate * a.decay) - a.learning_rate * (m / fix(a.beta1)) / below);
            want[1].push(m);
            want[2].push(v);
        }
        for (got, want) in got.iter().zip(&want) {
            close(got, want, 1e-6);
        }
    }
}
