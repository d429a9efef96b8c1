//! The exponential function, and GELU and its gradient, which use it. Each value is computed in one
//! pass.

use rayon::prelude::*;

use super::simd::{Kernels, LANES, Lanes, Op};

/// The number of values in a task.
const PART: usize = 1 << 14;

/// Returns e^x for x ≤ 0, to two units in the last place. Below −87.3, where results would be
/// subnormal, it is e^−87.3. NaN stays NaN.
///
/// The formula is 2^n·e^r with whole n and |r| ≤ ln 2 / 2; the polynomial is Cephes' (S. L.
/// Moshier, `expf`).
#[inline(always)]
pub(super) fn exp<L: Lanes>(x: L) -> L {
    // Adding and subtracting 1.5·2^23 rounds to whole numbers.
    let (log2_e, round) = (L::splat(std::f32::consts::LOG2_E), L::splat(12_582_912.0));
    let x = L::splat(-87.3).max(x);
    let n = x.fma(log2_e, round).sub(round);
    // ln 2 is split in two parts, so that n·ln 2 is exact enough.
    let r = n.fma(L::splat(-0.693_359_4), x);
    let r = n.fma(L::splat(2.121_944_4e-4), r);
    let polynomial = [
        1.398_199_9e-3,
        8.333_452e-3,
        4.166_579_6e-2,
        1.666_666_5e-1,
        0.5,
    ];
    let mut p = L::splat(1.987_569_1e-4);
    for c in polynomial {
        p = p.fma(r, L::splat(c));
    }
    let one = L::splat(1.0);
    r.mul(r).fma(p, r).add(one).mul(n.power_of_two())
}

/// Returns Φ(x), the standard normal distribution's share below x, to 10⁻⁷, and e^(−x²/2).
///
/// Φ(−|x|) = ½·erfc(u), u = |x|/√2. erfc(u)·e^(u²) is approximated by a polynomial of t = 1/(1 +
/// u/2), fitted for the least greatest error after weighting with e^(−u²): 2·10⁻⁸.
#[inline(always)]
fn normal<L: Lanes>(x: L) -> (L, L) {
    let (one, half) = (L::splat(1.0), L::splat(0.5));
    let size = x.max(L::splat(0.0).sub(x));
    let bell = exp(x.mul(x).mul(L::splat(-0.5)));
    let t = one.div(size.fma(L::splat(0.353_553_4), one));
    let polynomial = [
        -0.232_195_06,
        0.150_309_7,
        0.277_645_47,
        0.148_753_93,
        0.316_044_78,
        0.277_773,
    ];
    let mut p = L::splat(0.061_668_213);
    for c in polynomial {
        p = p.fma(t, L::splat(c));
    }
    let below = p.mul(t).mul(bell).mul(half);
    let above = one.sub(below.add(below)).where_positive(x);
    (above.add(below), bell)
}

impl Kernels {
    /// Computes x·Φ(x), Hendrycks and Gimpel's "Gaussian error linear unit" in its exact form.
    /// Writes all of `y`.
    pub fn gelu(self, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), y.len(), "one length for all");
        let parts = x.par_chunks(PART).zip(y.par_chunks_mut(PART));
        parts.for_each(|(x, y)| self.run(Gelu { x, y }));
    }

    /// Computes the gradient of [`Kernels::gelu`] from its input and the output's gradient. Writes
    /// all of `dx`.
    pub fn gelu_grad(self, x: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert_eq!(
            (x.len(), dy.len()),
            (dx.len(), dx.len()),
            "one length for all"
        );
        let parts = x.par_chunks(PART).zip(dy.par_chunks(PART));
        let parts = parts.zip(dx.par_chunks_mut(PART));
        parts.for_each(|((x, dy), dx)| self.run(GeluGrad { x, dy, dx }));
    }
}

struct Gelu<'a> {
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Op for Gelu<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        for (x, y) in self.x.chunks(LANES).zip(self.y.chunks_mut(LANES)) {
            let x = L::load_part(x, 0.0);
            x.mul(normal(x).0).store_part(y);
        }
    }
}

struct GeluGrad<'a> {
    x: &'a [f32],
    dy: &'a [f32],
    dx: &'a mut [f32],
}

impl Op for GeluGrad<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        // 1/√(2π)
        let density = L::splat(0.398_942_3);
        let parts = self.x.chunks(LANES).zip(self.dy.chunks(LANES));
        for ((x, dy), dx) in parts.zip(self.dx.chunks_mut(LANES)) {
            let x = L::load_part(x, 0.0);
            let (below, bell) = normal(x);
            let slope = x.mul(density).fma(bell, below);
            slope.mul(L::load_part(dy, 0.0)).store_part(dx);
        }
    }
}
