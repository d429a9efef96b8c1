//! Lossless 16-bit code of whole photon counts.
//!
//! A record contains h = N/scale in single precision, so h·scale differs from N only by rounding:
//! by at most 0.016 below 2¹⁶.

use crate::coding::squareroot::{ErrorSums, SATURATED};

/// A distance from a whole number that rounding cannot explain.
const WHOLE: f32 = 0.05;

/// Encodes `h` as counts. Returns whether a bin saturated (2¹⁶ − 1 photons or more).
///
/// # Errors
/// The first value that is negative, not finite, or not a whole number of photons.
pub(crate) fn encode_run(
    scale: f32,
    h: &[f32],
    q: &mut [u16],
    error: &mut ErrorSums,
) -> Result<bool, usize> {
    let mut saturated = false;
    let mut invalid = false;
    for (h, q) in h.iter().zip(&mut *q) {
        let n = h * scale;
        // The cast floors and saturates: every value from 65535.0 upwards becomes SATURATED.
        *q = (n + 0.5) as u16;
        saturated |= *q == SATURATED;
        invalid |= !fits(*h, n, *q);
    }
    error.add_exact(h.len());
    if !invalid {
        return Ok(saturated);
    }
    let at = h
        .iter()
        .zip(&*q)
        .position(|(h, q)| !fits(*h, h * scale, *q));
    Err(at.expect("one was seen"))
}

fn fits(h: f32, n: f32, q: u16) -> bool {
    let whole = q == SATURATED || (n - f32::from(q)).abs() <= WHOLE;
    (0.0..=f32::MAX).contains(&h) && whole
}

/// Decodes counts into `h`; saturated ones become +∞ until the overflow list is applied. Returns
/// whether there are any.
pub(crate) fn decode_run(scale: f32, q: &[u16], h: &mut [f32]) -> bool {
    let mut top = 0;
    for (q, h) in q.iter().zip(h) {
        top = top.max(*q);
        *h = if *q == SATURATED {
            f32::INFINITY
        } else {
            f32::from(*q) / scale
        };
    }
    top == SATURATED
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_come_back_exactly_whatever_the_scale() {
        for scale in [1.0f32, 0.37, 6.1e-5, 1234.567, 8.1e9] {
            let h: Vec<f32> = (0..SATURATED).map(|n| f32::from(n) / scale).collect();
            let mut q = vec![0; h.len()];
            let mut error = ErrorSums::default();
            assert_eq!(encode_run(scale, &h, &mut q, &mut error), Ok(false));
            assert!(q.iter().copied().eq(0..SATURATED));
            let mut back = vec![0.0; h.len()];
            assert!(!decode_run(scale, &q, &mut back));
            assert_eq!(back, h);
            assert_eq!(error.finish(0).max_sigma, 0.0);
        }
    }

    #[test]
    fn what_is_no_count_is_found() {
        let run = |h: &[f32]| encode_run(2.0, h, &mut vec![0; h.len()], &mut ErrorSums::default());
        assert_eq!(run(&[1.0, 40_000.0]), Ok(true));
        assert_eq!(run(&[1.0, 0.7]), Err(1));
        assert_eq!(run(&[-0.5, 0.0]), Err(0));
        assert_eq!(run(&[0.0, 0.0, f32::NAN]), Err(2));
        assert_eq!(run(&[0.0, f32::INFINITY]), Err(1));
    }
}
