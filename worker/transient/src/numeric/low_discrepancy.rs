//! Evenly spread numbers: the R₂ sequence, and positions in a pixel.

use crate::numeric::rng::{Rng, Stream};

/// Returns point `k` of the R₂ sequence (Roberts 2018) in the unit square, from a start in units of
/// 2⁻³².
#[inline]
pub(crate) fn r2(start: (u32, u32), k: u64) -> (f32, f32) {
    // 1/g and 1/g² in units of 2⁻⁶⁴, g³ = g + 1.
    const STEPS: (u64, u64) = (0xc13f_a9a9_02a6_328f, 0x91e1_0da5_c79e_7b1d);
    let turn = |start: u32, step: u64| {
        let at = (u64::from(start) << 32).wrapping_add(k.wrapping_mul(step));
        (at >> 40) as f32 * (1.0 / 16_777_216.0)
    };
    (turn(start.0, STEPS.0), turn(start.1, STEPS.1))
}

/// Levels of nested quarters that the paths of a pixel visit in turn. Within the smallest quarter,
/// positions are random. With eight levels, light seen via two mirrors had an error of 0.83 of the
/// one stated by the spread of passes.
const QUARTERS: u32 = 3;

/// Returns the position in a pixel at which path `k` of `stream` begins, over all passes. Positions
/// are spread evenly, because much of the light in a bin depends on them.
///
/// Four consecutive paths take the quarters of the pixel in random order, sixteen the quarters of
/// those, and 64 once more: nested scrambling of the van der Corput sequence in base 4 (Owen 1995),
/// arranged along a Z curve and restarted every 64 paths. For any image, passes are never more
/// alike than random ones would be, so their spread states no less than the error of their mean.
/// Sequences with a step, such as R₂, agree from pass to pass if the image within a pixel repeats
/// at that step.
#[inline]
pub(crate) fn place(seed: u64, stream: Stream, pixel: u64, k: u64) -> (f32, f32) {
    let mut rng = Rng::new(seed, stream, pixel, k);
    let random = |rng: &mut Rng| rng.next_u32() >> (8 + QUARTERS);
    let (mut x, mut y) = (random(&mut rng), random(&mut rng));
    // The group of 64 paths, a one, and the digits of `k` in base 4 from the last one on.
    let mut path = (k >> (2 * QUARTERS)) << 8 | 1;
    for level in 0..QUARTERS {
        let digit = (k >> (2 * level)) & 3;
        let turn = Rng::new(seed, stream, pixel, !path).next_u32();
        let quarter = permuted(turn, digit as u32);
        x |= (quarter & 1) << (23 - level);
        y |= (quarter >> 1) << (23 - level);
        path = 4 * path + digit;
    }
    let unit = |x: u32| x as f32 * (1.0 / 16_777_216.0);
    (unit(x), unit(y))
}

/// Returns the image of `digit` under one of the 24 permutations of 0 to 3, chosen by `turn`.
#[inline]
fn permuted(turn: u32, digit: u32) -> u32 {
    // All permutations are affine over two bits: two different images of the bits, and a shift.
    let first = turn % 3;
    let second = (first + 1 + turn / 3 % 2) % 3;
    let shift = turn / 6 % 4;
    let of = |bit: u32, image: u32| (digit >> bit & 1) * (image + 1);
    shift ^ of(0, first) ^ of(1, second)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use crate::numeric::low_discrepancy::place;
    use crate::numeric::rng::Stream;

    proptest! {
        #[test]
        fn paths_take_every_part_of_a_pixel_before_they_take_one_again(
            seed in any::<u64>(), pixel in 0u64..1 << 24, block in 0u64..1 << 30, level in 0u32..=3,
        ) {
            let (count, side) = (1u64 << (2 * level), 1usize << level);
            let mut taken = vec![false; count as usize];
            for k in block * count..(block + 1) * count {
                let (x, y) = place(seed, Stream::Place, pixel, k);
                prop_assert!((0.0..1.0).contains(&x) && (0.0..1.0).contains(&y));
                let part = |x: f32| (x * side as f32) as usize;
                let taken = &mut taken[part(y) * side + part(x)];
                prop_assert!(!std::mem::replace(taken, true));
            }
        }
    }

    #[test]
    fn any_two_of_four_paths_are_in_any_two_quarters_alike() {
        const PIXELS: u64 = 24_000;
        for (i, j) in [(0, 1), (0, 3), (1, 2), (2, 3)] {
            let mut pairs = [[0u32; 4]; 4];
            for pixel in 0..PIXELS {
                let quarter = |k| {
                    let (x, y) = place(3, Stream::Place, pixel, k);
                    (2.0 * x) as usize + 2 * (2.0 * y) as usize
                };
                pairs[quarter(i)][quarter(j)] += 1;
            }
            for (a, row) in pairs.iter().enumerate() {
                for (b, &count) in row.iter().enumerate() {
                    // 2000 each, with a standard deviation of 43.
                    let expected = if a == b { 0.0 } else { PIXELS as f64 / 12.0 };
                    assert!((f64::from(count) - expected).abs() < 200.0, "{pairs:?}");
                }
            }
        }
    }

    /// Returns the variance of the mean over passes of the pixels' values, divided by the variance
    /// stated by the spread of those passes. Half of each pixel is white.
    fn true_over_stated(passes: u64, sees: impl Fn((f32, f32), (f32, f32)) -> f32) -> f64 {
        const PIXELS: u64 = 8000;
        let (mut found, mut stated) = (0.0, 0.0);
        for pixel in 0..PIXELS {
            let phase = place(77, Stream::Place, pixel, 0);
            let see = |at| f64::from(sees(at, phase));
            let each: Vec<f64> = (0..passes)
                .map(|k| see(place(1, Stream::Place, pixel, k)))
                .collect();
            let n = passes as f64;
            let mean = each.iter().sum::<f64>() / n;
            let square = each.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
            stated += square / (n * (n - 1.0));
            found += (mean - 0.5).powi(2);
        }
        found / stated
    }

    #[test]
    fn the_spread_of_passes_over_stripes_and_squares_states_no_less_than_their_error() {
        let odd = |x: f32| x.rem_euclid(1.0) >= 0.5;
        for times in [1.0f32, 2.0, 3.0, 4.0, 6.0, 7.0, 8.0] {
            for passes in [2, 3, 4, 8, 13] {
                let stripes =
                    true_over_stated(passes, |at, phase| f32::from(odd(at.1 * times + phase.1)));
                let squares = true_over_stated(passes, |at, phase| {
                    let (x, y) = (at.0 * times + phase.0, at.1 * times + phase.1);
                    f32::from(odd(x) != odd(y))
                });
                // Random positions give 1. With R₂, stripes that repeat seven times per pixel gave
                // 40.
                let most = stripes.max(squares);
                assert!(
                    most < 1.15,
                    "{times} times, {passes} passes: {stripes} {squares}"
                );
            }
        }
    }

    #[test]
    fn pixels_seeds_and_streams_begin_elsewhere() {
        let all = [
            place(1, Stream::Place, 0, 0),
            place(1, Stream::Place, 1, 0),
            place(2, Stream::Place, 0, 0),
            place(1, Stream::GlassPlace, 0, 0),
        ];
        for (i, a) in all.iter().enumerate() {
            assert!(all[..i].iter().all(|b| a != b), "{all:?}");
        }
    }
}
