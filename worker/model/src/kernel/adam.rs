//! The AdamW update of one parameter, in one pass.
//!
//! Source: Loshchilov and Hutter, "Decoupled weight decay regularization", with PyTorch's order of
//! operations (`torch.optim.AdamW`: decay first, separate bias corrections, ε outside the root).

use rayon::prelude::*;

use super::simd::{Kernels, LANES, Lanes, Op};

/// The number of values in a task.
const PART: usize = 1 << 16;

/// The settings of one update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamW {
    /// The learning rate of this step.
    pub learning_rate: f64,
    /// The decay of the first moment.
    pub beta1: f64,
    /// The decay of the second moment.
    pub beta2: f64,
    /// The constant added to the root of the second moment.
    pub eps: f64,
    /// The weight decay.
    pub decay: f64,
    /// The number of this step, from 1.
    pub step: u32,
}

impl Kernels {
    /// Updates a parameter and its two moments from its gradient.
    pub fn adamw(self, a: &AdamW, p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32]) {
        assert_eq!(
            (p.len(), m.len(), v.len()),
            (g.len(), g.len(), g.len()),
            "one length for all"
        );
        assert!(a.step > 0, "steps count from 1");
        let factors = Factors {
            keep: (1.0 - a.learning_rate * a.decay) as f32,
            lean: (1.0 - a.beta1) as f32,
            beta2: a.beta2 as f32,
            square: (1.0 - a.beta2) as f32,
            root: (1.0 / (1.0 - power(a.beta2, a.step)).sqrt()) as f32,
            eps: a.eps as f32,
            rate: (-a.learning_rate / (1.0 - power(a.beta1, a.step))) as f32,
        };
        p.par_chunks_mut(PART)
            .zip(g.par_chunks(PART))
            .zip(m.par_chunks_mut(PART).zip(v.par_chunks_mut(PART)))
            .for_each(|((p, g), (m, v))| {
                self.run(Update {
                    factors,
                    p,
                    g,
                    m,
                    v,
                })
            });
    }
}

/// Returns x^n by squaring. It has the same bits on every machine.
fn power(x: f64, mut n: u32) -> f64 {
    let (mut square, mut result) = (x, 1.0);
    while n > 0 {
        if n & 1 == 1 {
            result *= square;
        }
        square *= square;
        n >>= 1;
    }
    result
}

/// The settings in the form that the inner loop uses.
#[derive(Clone, Copy)]
struct Factors {
    keep: f32,
    lean: f32,
    beta2: f32,
    square: f32,
    root: f32,
    eps: f32,
    rate: f32,
}

struct Update<'a> {
    factors: Factors,
    p: &'a mut [f32],
    g: &'a [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
}

impl Op for Update<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let f = self.factors;
        let (keep, lean, beta2) = (L::splat(f.keep), L::splat(f.lean), L::splat(f.beta2));
        let (square, root) = (L::splat(f.square), L::splat(f.root));
        let (eps, rate) = (L::splat(f.eps), L::splat(f.rate));
        let moments = self.m.chunks_mut(LANES).zip(self.v.chunks_mut(LANES));
        let values = self.p.chunks_mut(LANES).zip(self.g.chunks(LANES));
        for ((p, g), (m, v)) in values.zip(moments) {
            let grad = L::load_part(g, 0.0);
            let old = L::load_part(m, 0.0);
            let first = grad.sub(old).fma(lean, old);
            let second = L::load_part(v, 0.0).mul(beta2);
            let second = grad.mul(square).fma(grad, second);
            first.store_part(m);
            second.store_part(v);
            let below = second.sqrt().fma(root, eps);
            let step = first.mul(rate).div(below);
            L::load_part(p, 0.0).fma(keep, step).store_part(p);
        }
    }
}
