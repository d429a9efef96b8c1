//! Layer norm over the last dimension, and its gradient, row by row in one pass each over memory.
//!
//! The gradient computes mean and deviation of a row again. Sums over rows are computed over runs
//! of [`ROWS`], and then over the runs in order, so the number of threads does not affect the bits.

use rayon::prelude::*;

use super::simd::{Kernels, LANES, Lanes, Op};

/// The number of rows in a task.
const ROWS: usize = 512;

/// The scale and shift of each value of a row.
#[derive(Clone, Copy, Debug)]
pub struct LayerNorm<'a> {
    /// The scale.
    pub gamma: &'a [f32],
    /// The shift.
    pub beta: &'a [f32],
    /// The constant added to the variance.
    pub eps: f32,
}

impl Kernels {
    /// Computes (x − mean)/√(variance + ε)·γ + β of each row, which is as long as γ. Writes all of
    /// `y`.
    pub fn layer_norm(self, norm: &LayerNorm, x: &[f32], y: &mut [f32]) {
        let wide = norm.gamma.len();
        assert_eq!(norm.beta.len(), wide, "one shift for each scale");
        assert_eq!(x.len(), y.len(), "one length for all");
        assert!(wide > 0 && x.len().is_multiple_of(wide), "whole rows");
        let runs = x.par_chunks(ROWS * wide).zip(y.par_chunks_mut(ROWS * wide));
        runs.for_each(|(x, y)| self.run(Apply { norm, x, y }));
    }

    /// Computes the gradient of [`Kernels::layer_norm`] from its input and the output's gradient.
    /// Writes all of `dx`, `dgamma` and `dbeta`.
    pub fn layer_norm_grad(
        self,
        norm: &LayerNorm,
        x: &[f32],
        dy: &[f32],
        dx: &mut [f32],
        dgamma: &mut [f32],
        dbeta: &mut [f32],
    ) {
        let wide = norm.gamma.len();
        assert_eq!((dgamma.len(), dbeta.len()), (wide, wide), "parameters");
        assert_eq!(
            (x.len(), dy.len()),
            (dx.len(), dx.len()),
            "one length for all"
        );
        assert!(wide > 0 && x.len().is_multiple_of(wide), "whole rows");
        let runs = x.par_chunks(ROWS * wide).zip(dy.par_chunks(ROWS * wide));
        let sums: Vec<Vec<f32>> = runs
            .zip(dx.par_chunks_mut(ROWS * wide))
            .map(|((x, dy), dx)| {
                let padded = wide.next_multiple_of(LANES);
                let mut sums = vec![0.0; 2 * padded];
                self.run(Grad {
                    norm,
                    x,
                    dy,
                    dx,
                    sums: &mut sums,
                });
                sums
            })
            .collect();
        let half = wide.next_multiple_of(LANES);
        for (to, from) in [(dgamma, 0), (dbeta, half)] {
            for (i, to) in to.iter_mut().enumerate() {
                let sum: f64 = sums.iter().map(|run| f64::from(run[from + i])).sum();
                *to = sum as f32;
            }
        }
    }
}

/// Returns the mean of a row, and the reciprocal of its deviation.
#[inline(always)]
fn statistics<L: Lanes>(row: &[f32], eps: f32) -> (f32, f32) {
    let over = 1.0 / row.len() as f32;
    let mut sum = L::splat(0.0);
    for part in row.chunks(LANES) {
        sum = sum.add(L::load_part(part, 0.0));
    }
    let mean = sum.sum() * over;
    let (wide, mut squares) = (L::splat(mean), L::splat(0.0));
    for part in row.chunks(LANES) {
        let off = L::load_part(part, mean).sub(wide);
        squares = off.fma(off, squares);
    }
    (mean, 1.0 / (squares.sum().mul_add(over, eps)).sqrt())
}

struct Apply<'a> {
    norm: &'a LayerNorm<'a>,
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Op for Apply<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let LayerNorm { gamma, beta, eps } = *self.norm;
        let wide = gamma.len();
        for (x, y) in self.x.chunks_exact(wide).zip(self.y.chunks_exact_mut(wide)) {
            let (mean, inverse) = statistics::<L>(x, eps);
            let (mean, inverse) = (L::splat(mean), L::splat(inverse));
            let parameters = gamma.chunks(LANES).zip(beta.chunks(LANES));
            let values = x.chunks(LANES).zip(y.chunks_mut(LANES));
            for ((gamma, beta), (x, y)) in parameters.zip(values) {
                let scale = L::load_part(gamma, 0.0);
                let normed = L::load_part(x, 0.0).sub(mean).mul(inverse);
                normed.fma(scale, L::load_part(beta, 0.0)).store_part(y);
            }
        }
    }
}

/// Adds the gradients of γ and β to `sums`, which has two padded rows.
struct Grad<'a> {
    norm: &'a LayerNorm<'a>,
    x: &'a [f32],
    dy: &'a [f32],
    dx: &'a mut [f32],
    sums: &'a mut [f32],
}

impl Op for Grad<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let LayerNorm { gamma, eps, .. } = *self.norm;
        let wide = gamma.len();
        let over = 1.0 / wide as f32;
        let (by_gamma, by_beta) = self.sums.split_at_mut(wide.next_multiple_of(LANES));
        let rows = self.x.chunks_exact(wide).zip(self.dy.chunks_exact(wide));
        for ((x, dy), dx) in rows.zip(self.dx.chunks_exact_mut(wide)) {
            let (mean, inverse) = statistics::<L>(x, eps);
            let (mean, inverse) = (L::splat(mean), L::splat(inverse));
            let (mut sum, mut product) = (L::splat(0.0), L::splat(0.0));
            let sums = by_gamma.chunks_exact_mut(LANES);
            let sums = sums.zip(by_beta.chunks_exact_mut(LANES));
            let values = x.chunks(LANES).zip(dy.chunks(LANES));
            for ((gamma, (x, dy)), (by_gamma, by_beta)) in gamma.chunks(LANES).zip(values).zip(sums)
            {
                let normed = L::load_part(x, 0.0).sub(mean).mul(inverse);
                let dy = L::load_part(dy, 0.0);
                normed.fma(dy, L::load(by_gamma)).store(by_gamma);
                L::load(by_beta).add(dy).store(by_beta);
                let slope = dy.mul(L::load_part(gamma, 0.0));
                sum = sum.add(slope);
                product = slope.fma(normed, product);
            }
            // dx = (g − mean(g) − x̂·mean(g·x̂))/deviation with g = dy·γ
            let (sum, product) = (L::splat(sum.sum() * over), L::splat(-product.sum() * over));
            let values = x.chunks(LANES).zip(dy.chunks(LANES));
            for ((gamma, (x, dy)), dx) in gamma.chunks(LANES).zip(values).zip(dx.chunks_mut(LANES))
            {
                let normed = L::load_part(x, 0.0).sub(mean).mul(inverse);
                let slope = L::load_part(dy, 0.0).mul(L::load_part(gamma, 0.0));
                let centred = normed.fma(product, slope.sub(sum));
                centred.mul(inverse).store_part(dx);
            }
        }
    }
}
