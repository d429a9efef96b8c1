//! Batch norm fused with ReLU: training, its gradient, and evaluation.
//!
//! Each channel is one task: mean, then centred variance, then one pass that normalises and clips.
//! Sums run over four times sixteen lanes in one plane and in `f64` over the planes. The gradient
//! recomputes the clipped value with the forward pass's own operations, so that both see the same
//! pixels as clipped.

use rayon::prelude::*;

use super::simd::{Kernels, LANES, Lanes, Op};

/// A tensor (images, channels, pixels), contiguous in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NormShape {
    /// The number of images in the batch.
    pub images: usize,
    /// The number of channels.
    pub channels: usize,
    /// The number of pixels of a plane.
    pub pixels: usize,
}

impl NormShape {
    /// Returns the number of values of the tensor.
    pub fn len(&self) -> usize {
        self.images * self.channels * self.pixels
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the planes of one channel.
    fn planes<'a>(&self, x: &'a [f32], channel: usize) -> impl Iterator<Item = &'a [f32]> {
        x.chunks_exact(self.pixels)
            .skip(channel)
            .step_by(self.channels)
    }

    /// Returns the planes of each channel for writing.
    fn split<'a>(&self, x: &'a mut [f32]) -> Vec<Vec<&'a mut [f32]>> {
        let mut parts: Vec<Vec<&mut [f32]>> = Vec::new();
        parts.resize_with(self.channels, || Vec::with_capacity(self.images));
        for (i, plane) in x.chunks_exact_mut(self.pixels).enumerate() {
            parts[i % self.channels].push(plane);
        }
        parts
    }
}

/// The parameters and statistics of a batch norm, one value a channel each.
#[derive(Clone, Copy, Debug)]
pub struct BatchNorm<'a> {
    /// The scale.
    pub gamma: &'a [f32],
    /// The shift.
    pub beta: &'a [f32],
    /// The mean: of the batch in training, the running one in evaluation.
    pub mean: &'a [f32],
    /// The variance: biased in training.
    pub var: &'a [f32],
    /// The constant added to the variance.
    pub eps: f32,
}

impl BatchNorm<'_> {
    /// Returns scale and shift of one channel, for `x·scale + shift`, and 1/σ.
    fn affine(&self, c: usize) -> (f32, f32, f32) {
        let inverse = 1.0 / (self.var[c] + self.eps).sqrt();
        let scale = self.gamma[c] * inverse;
        (scale, (-self.mean[c]).mul_add(scale, self.beta[c]), inverse)
    }

    fn check(&self, s: &NormShape) {
        for part in [self.gamma, self.beta, self.mean, self.var] {
            assert_eq!(part.len(), s.channels, "one value a channel");
        }
    }
}

impl Kernels {
    /// Computes the mean and biased variance of each channel over images and pixels.
    pub fn batch_statistics(self, s: &NormShape, x: &[f32], mean: &mut [f32], var: &mut [f32]) {
        assert_eq!(x.len(), s.len(), "input length");
        assert_eq!(
            (mean.len(), var.len()),
            (s.channels, s.channels),
            "one value a channel"
        );
        if s.is_empty() {
            return;
        }
        let count = (s.images * s.pixels) as f64;
        mean.par_iter_mut()
            .zip(var)
            .enumerate()
            .for_each(|(c, (mean, var))| {
                let sum: f64 = s
                    .planes(x, c)
                    .map(|x| f64::from(self.run(Moment::<false> { x, mean: 0.0 })))
                    .sum();
                let m = sum / count;
                *mean = m as f32;
                let sum: f64 = s
                    .planes(x, c)
                    .map(|x| f64::from(self.run(Moment::<true> { x, mean: *mean })))
                    .sum();
                // The mean was rounded, so its error is subtracted from the variance.
                let off = m - f64::from(*mean);
                *var = (sum / count - off * off).max(0.0) as f32;
            });
    }

    /// Computes batch norm by the batch's own statistics, then ReLU. Writes all of `y`, and the
    /// mean and biased variance of each channel, which the gradient requires.
    #[expect(clippy::too_many_arguments, reason = "three inputs, three outputs")]
    pub fn batch_norm_relu(
        self,
        s: &NormShape,
        x: &[f32],
        gamma: &[f32],
        beta: &[f32],
        eps: f32,
        y: &mut [f32],
        mean: &mut [f32],
        var: &mut [f32],
    ) {
        self.batch_statistics(s, x, mean, var);
        let norm = BatchNorm {
            gamma,
            beta,
            mean,
            var,
            eps,
        };
        self.norm_relu(s, x, &norm, y);
    }

    /// Computes batch norm by given statistics, then ReLU (the evaluation form). Writes all of `y`.
    pub fn norm_relu(self, s: &NormShape, x: &[f32], norm: &BatchNorm, y: &mut [f32]) {
        assert_eq!(x.len(), s.len(), "input length");
        assert_eq!(y.len(), s.len(), "output length");
        norm.check(s);
        if s.is_empty() {
            return;
        }
        s.split(y)
            .into_par_iter()
            .enumerate()
            .for_each(|(c, planes)| {
                let (scale, shift, _) = norm.affine(c);
                for (x, y) in s.planes(x, c).zip(planes) {
                    self.run(Apply { x, scale, shift, y });
                }
            });
    }

    /// Computes the gradient of [`Kernels::batch_norm_relu`] from its input, its statistics and the
    /// output's gradient. Writes all of `dx`, `dgamma` and `dbeta`.
    #[expect(clippy::too_many_arguments, reason = "three inputs, three outputs")]
    pub fn batch_norm_relu_grad(
        self,
        s: &NormShape,
        x: &[f32],
        norm: &BatchNorm,
        dy: &[f32],
        dx: &mut [f32],
        dgamma: &mut [f32],
        dbeta: &mut [f32],
    ) {
        assert_eq!(
            (x.len(), dy.len()),
            (s.len(), s.len()),
            "input and gradient length"
        );
        assert_eq!(dx.len(), s.len(), "input gradient length");
        assert_eq!(
            (dgamma.len(), dbeta.len()),
            (s.channels, s.channels),
            "one value a channel"
        );
        norm.check(s);
        if s.is_empty() {
            dgamma.fill(0.0);
            dbeta.fill(0.0);
            return;
        }
        let count = (s.images * s.pixels) as f64;
        s.split(dx)
            .into_par_iter()
            .zip(dgamma)
            .zip(dbeta)
            .enumerate()
            .for_each(|(c, ((planes, dgamma), dbeta))| {
                let (scale, shift, inverse) = norm.affine(c);
                let mean = norm.mean[c];
                let (mut sum, mut product) = (0.0, 0.0);
                for (x, dy) in s.planes(x, c).zip(s.planes(dy, c)) {
                    let (a, b) = self.run(GradSums {
                        x,
                        dy,
                        scale,
                        shift,
                        mean,
                    });
                    sum += f64::from(a);
                    product += f64::from(b);
                }
                let inverse = f64::from(inverse);
                *dbeta = sum as f32;
                *dgamma = (product * inverse) as f32;
                // dx = scale·(g − mean(g) − (x − mean)·inverse²·mean(g·(x − mean)))
                let slope = (-product / count * inverse * inverse * f64::from(scale)) as f32;
                let offset = (-sum / count * f64::from(scale)) as f32;
                for ((x, dy), dx) in s.planes(x, c).zip(s.planes(dy, c)).zip(planes) {
                    self.run(Grad {
                        x,
                        dy,
                        scale,
                        shift,
                        mean,
                        slope,
                        offset,
                        dx,
                    });
                }
            });
    }
}

/// Σ x, or Σ (x − mean)².
struct Moment<'a, const CENTRED: bool> {
    x: &'a [f32],
    mean: f32,
}

impl<const CENTRED: bool> Op for Moment<'_, CENTRED> {
    type Out = f32;

    #[inline(always)]
    fn run<L: Lanes>(self) -> f32 {
        let mean = L::splat(self.mean);
        let mut acc = [L::splat(0.0); 4];
        let mut parts = self.x.chunks_exact(4 * LANES);
        for part in parts.by_ref() {
            for (i, acc) in acc.iter_mut().enumerate() {
                let x = L::load(&part[i * LANES..]);
                *acc = moment::<L, CENTRED>(x, mean, *acc);
            }
        }
        for (i, part) in parts.remainder().chunks(LANES).enumerate() {
            let x = L::load_part(part, self.mean);
            acc[i] = moment::<L, CENTRED>(x, mean, acc[i]);
        }
        acc[0].add(acc[1]).add(acc[2].add(acc[3])).sum()
    }
}

#[inline(always)]
fn moment<L: Lanes, const CENTRED: bool>(x: L, mean: L, acc: L) -> L {
    if CENTRED {
        let d = x.sub(mean);
        d.fma(d, acc)
    } else {
        acc.add(x)
    }
}

/// y = relu(x·scale + shift).
struct Apply<'a> {
    x: &'a [f32],
    scale: f32,
    shift: f32,
    y: &'a mut [f32],
}

impl Op for Apply<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let (scale, shift) = (L::splat(self.scale), L::splat(self.shift));
        for (x, y) in self.x.chunks(LANES).zip(self.y.chunks_mut(LANES)) {
            L::load_part(x, 0.0).fma(scale, shift).relu().store_part(y);
        }
    }
}

/// Σ g and Σ g·(x − mean) over the pixels that ReLU let through.
struct GradSums<'a> {
    x: &'a [f32],
    dy: &'a [f32],
    scale: f32,
    shift: f32,
    mean: f32,
}

impl Op for GradSums<'_> {
    type Out = (f32, f32);

    #[inline(always)]
    fn run<L: Lanes>(self) -> (f32, f32) {
        let (scale, shift) = (L::splat(self.scale), L::splat(self.shift));
        let mean = L::splat(self.mean);
        let mut acc = [[L::splat(0.0); 2]; 4];
        let mut parts = self.x.chunks_exact(4 * LANES);
        let mut grads = self.dy.chunks_exact(4 * LANES);
        for (x, dy) in parts.by_ref().zip(grads.by_ref()) {
            for (i, [a, b]) in acc.iter_mut().enumerate() {
                let x = L::load(&x[i * LANES..]);
                let g = L::load(&dy[i * LANES..]).where_positive(x.fma(scale, shift));
                *a = a.add(g);
                *b = g.fma(x.sub(mean), *b);
            }
        }
        let tail = parts.remainder().chunks(LANES);
        for ((x, dy), [a, b]) in tail
            .zip(grads.remainder().chunks(LANES))
            .zip(acc.iter_mut())
        {
            let x = L::load_part(x, self.mean);
            let g = L::load_part(dy, 0.0).where_positive(x.fma(scale, shift));
            *a = a.add(g);
            *b = g.fma(x.sub(mean), *b);
        }
        let [a, b, c, d] = acc;
        (
            a[0].add(b[0]).add(c[0].add(d[0])).sum(),
            a[1].add(b[1]).add(c[1].add(d[1])).sum(),
        )
    }
}

/// dx = g·scale + (x − mean)·slope + offset.
struct Grad<'a> {
    x: &'a [f32],
    dy: &'a [f32],
    scale: f32,
    shift: f32,
    mean: f32,
    slope: f32,
    offset: f32,
    dx: &'a mut [f32],
}

impl Op for Grad<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let (scale, shift) = (L::splat(self.scale), L::splat(self.shift));
        let (mean, slope) = (L::splat(self.mean), L::splat(self.slope));
        let offset = L::splat(self.offset);
        let parts = self.x.chunks(LANES).zip(self.dy.chunks(LANES));
        for ((x, dy), dx) in parts.zip(self.dx.chunks_mut(LANES)) {
            let x = L::load_part(x, 0.0);
            let g = L::load_part(dy, 0.0).where_positive(x.fma(scale, shift));
            let rest = x.sub(mean).fma(slope, offset);
            g.fma(scale, rest).store_part(dx);
        }
    }
}
