//! The update of a node: Adam (Kingma and Ba 2015), and the pulls on it other than the rays.

use super::Kind;
use crate::field::{EMPTY, sigmoid};

/// The learning rate, and that of the last third.
const RATES: [f32; 2] = [0.2, 0.06];
const FIRST: f32 = 0.9;
const SECOND: f32 = 0.99;
const SMALL: f32 = 1e-3;
/// The pull towards emptiness: more erodes the backs of objects, less leaves mist.
const SPARSE: f32 = 0.003;
/// The pull of visible surfaces towards their start.
const ANCHOR: f32 = 0.05;
/// The logit beyond which the gradient almost vanishes.
const FULL: f32 = 6.0;

/// The values common to all updates of an iteration.
pub(super) struct Rate {
    rate: f32,
    first: f32,
    second: f32,
}

impl Rate {
    pub fn new(done: u32, late: bool) -> Self {
        let n = done as f32 + 1.0;
        Self {
            rate: RATES[usize::from(late)],
            first: 1.0 / (1.0 - libm::powf(FIRST, n)),
            second: 1.0 / (1.0 - libm::powf(SECOND, n)),
        }
    }
}

/// Returns the derivative of the pulls on a node other than the rays.
#[inline(always)]
pub(super) fn pull(kind: Kind, u: f32, start: f32) -> f32 {
    match kind {
        Kind::Anchored => ANCHOR * (u - start),
        Kind::Unknown => {
            let s = sigmoid(u);
            4.0 * SPARSE * s * (1.0 - s).max(0.02)
        }
    }
}

/// Returns the new logit.
#[inline(always)]
pub(super) fn step(u: f32, g: f32, (m, v): (&mut f32, &mut f32), rate: &Rate) -> f32 {
    *m = FIRST * *m + (1.0 - FIRST) * g;
    *v = SECOND * *v + (1.0 - SECOND) * g * g;
    let to = rate.rate * *m * rate.first / ((*v * rate.second).sqrt() + SMALL);
    (u - to).clamp(EMPTY, FULL.max(u))
}
