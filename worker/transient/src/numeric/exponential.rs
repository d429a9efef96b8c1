//! An exponential that gives the same bits on every machine.

/// Returns e⁻ˣ for x ≥ 0, with a relative error of 10⁻⁷. Returns 0 for x ≥ 80, below the resolution
/// of any f32 sum, and for NaN. It has no branches and gives the same bits on any machine.
#[inline(always)]
pub(crate) fn exp_minus(x: f32) -> f32 {
    // Adding 1.5·2²³ leaves the nearest integer in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // ln 2 in two parts; the first has few bits.
    const LN_2: (f32, f32) = (0.693_359_4, -2.121_944_4e-4);
    let near = x < 80.0;
    let y = if near { -x } else { 0.0 };
    let shifted = y * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (y - n * LN_2.0) - n * LN_2.1;
    let p = 1.0 / 5040.0;
    let p = p * r + 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = p * r + 1.0;
    let p = p * r + 1.0;
    let power = shifted
        .to_bits()
        .wrapping_sub(ROUND.to_bits())
        .wrapping_add(127)
        << 23;
    let e = p * f32::from_bits(power);
    if near { e } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::exp_minus;

    #[test]
    fn the_exponential_is_right_to_the_last_digits() {
        for k in 0..80_000 {
            let x = k as f32 / 1000.0;
            let (found, right) = (f64::from(exp_minus(x)), (-f64::from(x)).exp());
            assert!((found / right - 1.0).abs() < 1e-7, "{x}: {found} {right}");
        }
        assert_eq!(exp_minus(0.0), 1.0);
        assert_eq!([80.0, f32::INFINITY, f32::NAN].map(exp_minus), [0.0; 3]);
    }
}
