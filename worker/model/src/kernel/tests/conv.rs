//! Convolutions compared with the definition.

use proptest::prelude::*;

use super::*;

/// Calls `f(weight, input, output)` with the indices of each product of a K×K convolution.
fn products(s: &ConvShape, k: usize, mut f: impl FnMut(usize, usize, usize)) {
    let (h, w, pad) = (s.height, s.width, k / 2);
    for n in 0..s.images {
        for o in 0..s.outputs {
            for y in 0..h {
                for x in 0..w {
                    for i in 0..s.inputs {
                        for t in 0..k * k {
                            let (v, u) = (y + t / k, x + t % k);
                            if v >= pad && v - pad < h && u >= pad && u - pad < w {
                                f(
                                    (o * s.inputs + i) * k * k + t,
                                    ((n * s.inputs + i) * h + v - pad) * w + u - pad,
                                    ((n * s.outputs + o) * h + y) * w + x,
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}

fn check(s: ConvShape, k: usize, seed: u64) {
    let x = noise(s.input_len(), seed);
    let w = noise(s.weight_len(k), seed + 1);
    let b = noise(s.outputs, seed + 2);
    let dy = noise(s.output_len(), seed + 3);
    let got = same_bits(|kernels| {
        let mut y = vec![f32::NAN; s.output_len()];
        let mut dx = vec![f32::NAN; s.input_len()];
        let mut dw = vec![f32::NAN; s.weight_len(k)];
        let mut db = vec![f32::NAN; s.outputs];
        if k == 3 {
            kernels.conv3x3(&s, &x, &w, &mut y);
            kernels.conv3x3_input_grad(&s, &dy, &w, &mut dx);
            kernels.conv3x3_weight_grad(&s, &x, &dy, &mut dw);
        } else {
            kernels.conv1x1(&s, &x, &w, Some(&b), &mut y);
            kernels.conv1x1_input_grad(&s, &dy, &w, &mut dx);
            kernels.conv1x1_weight_grad(&s, &x, &dy, &mut dw);
        }
        kernels.bias_grad(&s, &dy, &mut db);
        vec![y, dx, dw, db]
    });
    let mut y = vec![0.0; s.output_len()];
    let mut dx = vec![0.0; s.input_len()];
    let mut dw = vec![0.0; s.weight_len(k)];
    let mut db = vec![0.0; s.outputs];
    let pixels = s.height * s.width;
    for (i, dy) in dy.iter().enumerate() {
        db[i / pixels % s.outputs] += f64::from(*dy);
        if k == 1 {
            y[i] = f64::from(b[i / pixels % s.outputs]);
        }
    }
    products(&s, k, |a, b, c| {
        y[c] += f64::from(w[a]) * f64::from(x[b]);
        dx[b] += f64::from(w[a]) * f64::from(dy[c]);
        dw[a] += f64::from(x[b]) * f64::from(dy[c]);
    });
    // Tolerances are relative to the sums' magnitudes, which are those of random walks.
    let walks = [
        s.inputs * k * k,
        s.outputs * k * k,
        s.images * pixels,
        s.images * pixels,
    ];
    for ((got, want), steps) in got.iter().zip([y, dx, dw, db]).zip(walks) {
        close(got, &want, 4e-6 * (steps as f64).sqrt().max(4.0));
    }
}

fn shape(images: usize, inputs: usize, outputs: usize, height: usize, width: usize) -> ConvShape {
    ConvShape {
        images,
        inputs,
        outputs,
        height,
        width,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn convolutions_equal_the_plain_sums_with_the_same_bits_everywhere(
        images in 1usize..4, inputs in 1usize..20, outputs in 1usize..20,
        height in 1usize..12, width in 1usize..20, k in prop::sample::select(vec![1usize, 3]),
        seed in 0u64..1000,
    ) {
        check(shape(images, inputs, outputs, height, width), k, seed);
    }
}

#[test]
fn odd_and_exact_sizes_agree() {
    for (i, s) in [
        shape(1, 1, 1, 1, 1),
        shape(2, 3, 2, 3, 5),
        shape(1, 19, 17, 7, 9),
        shape(3, 2, 33, 4, 4),
        shape(2, 4, 8, 16, 16),
        shape(1, 3, 9, 5, 32),
        // More input channels than one chunk, more rows than one band.
        shape(1, 67, 5, 3, 16),
        shape(1, 2, 3, 70, 33),
        shape(2, 1, 40, 33, 48),
        shape(5, 70, 40, 2, 2),
        // Winograd's form: odd planes, planes of several images, bands of one image, groups of
        // channels.
        shape(3, 17, 19, 5, 7),
        shape(5, 33, 40, 4, 4),
        shape(1, 40, 16, 33, 64),
        shape(2, 16, 24, 66, 35),
        shape(2, 16, 70, 8, 8),
        shape(1, 50, 64, 21, 24),
        shape(7, 70, 49, 6, 8),
    ]
    .into_iter()
    .enumerate()
    {
        for k in [1, 3] {
            check(s, k, 7 * i as u64);
        }
    }
}

#[test]
fn no_input_channels_give_the_bias() {
    for (height, width) in [(2, 3), (19, 18)] {
        let pixels = height * width;
        let s = shape(1, 0, 2, height, width);
        let found = same_bits(|k| {
            let (mut one, mut three) = (vec![9.0; 2 * pixels], vec![9.0; 2 * pixels]);
            k.conv1x1(&s, &[], &[], Some(&[1.0, 2.0]), &mut one);
            k.conv3x3(&s, &[], &[], &mut three);
            vec![one, three]
        });
        assert_eq!(found[0], [vec![1.0; pixels], vec![2.0; pixels]].concat());
        assert_eq!(found[1], vec![0.0; 2 * pixels]);
    }
}

#[test]
fn one_hot_convolution_equals_the_dense_one() {
    for (images, bins, outputs, height, width) in [
        (1, 1, 1, 1, 1),
        (2, 5, 19, 7, 9),
        (1, 37, 33, 3, 16),
        (3, 64, 8, 20, 17),
    ] {
        let s = OneHotShape {
            images,
            bins,
            outputs,
            height,
            width,
        };
        let d = s.dense();
        let pixels = height * width;
        // Some pixels have no bin, encoded in both ways.
        let hot: Vec<u16> = noise(images * pixels, 5)
            .iter()
            .map(|x| match ((x + 1.0) * 0.5 * (bins + 2) as f32) as usize {
                b if b <= bins => b as u16,
                _ => u16::MAX,
            })
            .collect();
        let mut x = vec![0.0; d.input_len()];
        for (i, b) in hot
            .iter()
            .enumerate()
            .filter(|(_, b)| usize::from(**b) < bins)
        {
            x[(i / pixels * bins + usize::from(*b)) * pixels + i % pixels] = 1.0;
        }
        let w = noise(d.weight_len(3), 1);
        let start = noise(d.output_len(), 2);
        let dy = noise(d.output_len(), 3);
        let got = same_bits(|k| {
            let mut y = start.clone();
            let mut dw = vec![f32::NAN; w.len()];
            k.onehot_conv3x3(&s, &hot, &w, &mut y);
            k.onehot_conv3x3_weight_grad(&s, &hot, &dy, &mut dw);
            vec![y, dw]
        });
        let mut y: Vec<f64> = start.iter().map(|x| f64::from(*x)).collect();
        let mut dw = vec![0.0; w.len()];
        products(&d, 3, |a, b, c| {
            y[c] += f64::from(w[a]) * x[b];
            dw[a] += x[b] * f64::from(dy[c]);
        });
        close(&got[0], &y, 1e-6);
        close(&got[1], &dw, 1e-5);
    }
}
