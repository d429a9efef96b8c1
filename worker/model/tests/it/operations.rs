//! Our kernels, as operations with gradients, compared with compositions of burn's operations.

use burn::tensor::{Device, Distribution, Int, Tensor, TensorData};
use picofarm_model::{AdamW, Random, ops, ops::plain};

fn random<const D: usize>(dims: [usize; D], stream: u64) -> Tensor<D> {
    let mut random = Random::new(7, &[stream]);
    let len = dims.iter().product();
    let values: Vec<f32> = (0..len).map(|_| 2.0 * random.unit() - 1.0).collect();
    Tensor::from_data(TensorData::new(values, dims), &Device::flex().autodiff()).require_grad()
}

fn close<const D: usize>(a: Tensor<D>, b: Tensor<D>, what: &str) {
    let (a, b) = (a.into_data_as::<f32>(), b.into_data_as::<f32>());
    assert_eq!(a.shape(), b.shape(), "{what}");
    let greatest = b.iter::<f32>().fold(1e-3f32, |m, x| m.max(x.abs()));
    for (i, (a, b)) in a.iter::<f32>().zip(b.iter::<f32>()).enumerate() {
        assert!((a - b).abs() <= 2e-5 * greatest, "{what}[{i}]: {a} and {b}");
    }
}

/// Returns the same scalar function of both forms' outputs, so that their gradients can be
/// compared.
fn summed<const D: usize>(y: &Tensor<D>) -> Tensor<1> {
    let weight = random(y.dims(), 99).detach();
    (y.clone() * weight).sum()
}

macro_rules! equal {
    ($ours:expr, $plain:expr, $($input:ident),+) => {{
        let (ours, plain) = ($ours, $plain);
        close(ours.clone().inner(), plain.clone().inner(), "output");
        let (a, b) = (summed(&ours).backward(), summed(&plain).backward());
        $(close(
            $input.grad(&a).expect(stringify!($input)),
            $input.grad(&b).expect(stringify!($input)),
            concat!("gradient by ", stringify!($input)),
        );)+
    }};
}

#[test]
fn convolutions_equal_burns_and_so_do_their_gradients() {
    for (n, c, o, h, w) in [
        (1, 1, 1, 4, 4),
        (2, 5, 9, 8, 6),
        (3, 17, 4, 2, 2),
        (2, 19, 35, 4, 6),
        (1, 16, 32, 2, 2),
    ] {
        let (x, k) = (random([n, c, h, w], 1), random([o, c, 3, 3], 2));
        equal!(
            ops::conv3x3(x.clone(), k.clone()),
            plain::conv3x3(x.clone(), k.clone()),
            x,
            k
        );
        let (k, b) = (random([o, c, 1, 1], 3), random([o], 4));
        equal!(
            ops::conv1x1(x.clone(), k.clone(), b.clone()),
            plain::conv1x1(x.clone(), k.clone(), b.clone()),
            x,
            k,
            b
        );
    }
}

#[test]
fn what_transformers_are_made_of_equals_burns_and_so_do_its_gradients() {
    for (window, shift, heads, size) in [(4, 2, 2, 3), (8, 0, 1, 5), (2, 1, 3, 1)] {
        let (h, w) = (2 * window, 3 * window);
        let qkv = random([2, h, w, 3 * heads * size], 1);
        let tokens = window * window;
        let bias = random([heads, tokens, tokens], 2);
        let windows = ops::Windows::new([h, w], window, shift, &qkv.device());
        let mask = ops::window_mask([h, w], window, shift);
        let mask = TensorData::new(mask, [h * w / tokens, tokens, tokens]);
        let mask = (shift > 0).then(|| Tensor::from_data(mask, &qkv.device()));
        equal!(
            ops::window_attention(qkv.clone(), bias.clone(), &windows),
            plain::window_attention(qkv.clone(), bias.clone(), window, shift, mask),
            qkv,
            bias
        );
    }
    for (rows, wide) in [(7, 24), (3, 5), (600, 16), (2, 33)] {
        let (x, gamma, beta) = (
            random([2, rows, wide], 1),
            random([wide], 2),
            random([wide], 3),
        );
        equal!(
            ops::layer_norm(x.clone(), gamma.clone(), beta.clone()),
            plain::layer_norm(x.clone(), gamma.clone(), beta.clone()),
            x,
            gamma,
            beta
        );
    }
    let x = random([3, 5, 7], 3);
    equal!(
        ops::gelu(x.clone() * 4.0),
        burn::tensor::activation::gelu(x.clone() * 4.0),
        x
    );
}

#[test]
fn what_is_done_along_time_equals_burns_and_so_do_its_gradients() {
    for (images, moments, c, h, w) in [(2, 4, 3, 5, 2), (1, 2, 1, 4, 6), (3, 6, 2, 3, 3)] {
        let x = random([images * moments, c, h, w], 1);
        equal!(
            ops::adjacent(x.clone(), moments),
            plain::adjacent(x.clone(), moments),
            x
        );
        equal!(ops::halve_time(x.clone()), plain::halve_time(x.clone()), x);
    }
    let x = random([3, 2, 2, 2], 2);
    equal!(
        ops::adjacent(x.clone(), 1),
        plain::adjacent(x.clone(), 1),
        x
    );
}

#[test]
fn borders_and_leaky_relu_equal_burns_and_so_do_their_gradients() {
    for (images, moments, c, h, w) in [(2, 4, 3, 5, 2), (1, 1, 2, 1, 1), (3, 2, 2, 4, 37)] {
        let x = random([images * moments, c, h, w], 1);
        for volume in [false, true] {
            equal!(
                ops::surround(x.clone(), moments, volume),
                plain::surround(x.clone(), moments, volume),
                x
            );
        }
        let (x, b) = (random([images, c, h + 2, w + 2], 2), random([c], 3));
        equal!(
            ops::crop(x.clone(), b.clone()),
            plain::crop(x.clone(), b.clone()),
            x,
            b
        );
        equal!(
            ops::leaky_relu(x.clone(), 0.2),
            burn::tensor::activation::leaky_relu(x.clone(), 0.2),
            x
        );
    }
}

#[test]
fn taps_with_stride_two_equal_burns() {
    for [n, t, s, h, w] in [[2, 5, 2, 4, 6], [1, 4, 1, 6, 2], [1, 1, 3, 2, 40]] {
        let x = random([n, t, s, h, w], 1);
        for repeated in [false, true] {
            let (ours, plain) = (
                ops::taps(x.clone(), repeated),
                plain::taps(x.clone(), repeated),
            );
            close(ours.inner(), plain.inner(), "taps");
        }
    }
}

#[test]
fn a_projection_of_bins_equals_that_of_their_one_hot_tensor() {
    let (n, h, w, channels, outputs) = (2, 3, 5, 7, 4);
    // -1 and bins beyond the channels give pixels of zeros.
    let bins: Vec<i64> = (0..n * h * w).map(|i| i as i64 * 5 % 10 - 1).collect();
    let bins = TensorData::new(bins, [n, h, w]);
    let bins = Tensor::<3, Int>::from_data(bins, &Device::flex().autodiff());
    let (k, b) = (random([outputs, channels, 1, 1], 1), random([outputs], 2));
    equal!(
        ops::one_hot_conv1x1(bins.clone(), k.clone(), b.clone()),
        plain::conv1x1(plain::one_hot(bins.clone(), channels), k.clone(), b.clone()),
        k,
        b
    );
}

#[test]
fn batch_norm_with_relu_equals_burns_and_so_do_its_gradients_and_statistics() {
    let (x, gamma, beta) = (random([3, 5, 4, 6], 1), random([5], 2), random([5], 3));
    let ours = ops::batch_norm_relu(x.clone(), gamma.clone(), beta.clone());
    let plain = plain::batch_norm_relu(x.clone(), gamma.clone(), beta.clone());
    close(ours.mean.clone(), plain.mean, "mean");
    close(ours.variance.clone(), plain.variance, "variance");
    let evaluated = ops::norm_relu(
        x.clone().inner(),
        gamma.clone().inner(),
        beta.clone().inner(),
        ours.mean,
        ours.variance,
    );
    close(
        evaluated,
        ours.y.clone().inner(),
        "evaluation by the same statistics",
    );
    equal!(ours.y, plain.y, x, gamma, beta);
}

#[test]
fn pooling_and_joining_equal_burns_and_so_do_their_gradients() {
    let (x, skip, small) = (
        random([2, 3, 8, 4], 1),
        random([2, 5, 8, 4], 2),
        random([2, 3, 4, 2], 3),
    );
    equal!(ops::max_pool(x.clone()), plain::max_pool(x.clone()), x);
    equal!(
        ops::join_upsampled(skip.clone(), small.clone()),
        plain::join_upsampled(skip.clone(), small.clone()),
        skip,
        small
    );
}

#[test]
fn the_gather_over_one_hot_bins_equals_the_dense_convolution_and_bins_outside_are_zeros() {
    let (n, channels, o, h, w) = (2, 11, 7, 6, 5);
    let mut random_bin = Random::new(3, &[]);
    let bins: Vec<i32> = (0..n * h * w)
        .map(|_| random_bin.below(13) as i32 - 1)
        .collect();
    let bins =
        Tensor::<3, Int>::from_data(TensorData::new(bins, [n, h, w]), &Device::flex().autodiff());
    let k = random([o, channels, 3, 3], 1);
    equal!(
        ops::one_hot_conv3x3(bins.clone(), k.clone()),
        plain::one_hot_conv3x3(bins.clone(), k.clone()),
        k
    );
}

#[test]
fn twenty_steps_of_adamw_equal_the_formula() {
    let device = Device::flex();
    let mut ours = (
        Tensor::<1>::random([77], Distribution::Default, &device),
        [(); 2].map(|()| Tensor::zeros([77], &device)),
    );
    let mut plain = ours.clone();
    for step in 1..=20 {
        let settings = AdamW {
            learning_rate: 1e-2,
            beta1: 0.9,
            beta2: 0.999,
            eps: 1e-8,
            decay: 1e-3,
            step,
        };
        let gradient = random([77], u64::from(step)).inner();
        ours = ops::adamw(settings, ours.0, gradient.clone(), ours.1);
        plain = plain::adamw(settings, plain.0, gradient, plain.1);
    }
    close(ours.0, plain.0, "parameter");
}
