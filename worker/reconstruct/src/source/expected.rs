//! Shadow masks computed from the light that a lit pixel is expected to return.
//!
//! A threshold on the share of a pixel's light in its strongest return has two errors: it
//! classifies a pixel as lit if only its edge is, and it accepts light of three bounces in a
//! corner. Here, depth and normals in closed form give the time of the two-bounce light of each
//! spot and, up to a factor of the pixel and one of the spot (their albedos), its amount: cos · cos
//! / r². The factors are medians over the returns that agree in time. A pixel is in shadow if less
//! than half of that light arrives, and lit if at least seven tenths do.

use rayon::prelude::*;

use crate::{
    Measured,
    closed_form::{closed_form, smooth},
    paths::Paths,
    scale::in_room,
};

/// The share of the expected light below which a pixel is in shadow.
const DARK: f32 = 0.5;
/// The share of the expected light from which a pixel is lit. A pixel in between is partly lit and
/// is not used.
const BRIGHT: f32 = 0.7;
/// A return belongs to the depth if it is within this number of bins of the expected time.
const BINS: f32 = 2.0;
/// A return with a lower share of a pixel's light is not a peak.
const LEAST_SHARE: f32 = 0.05;
/// For counted photons: if noise exceeds this share of the expected light, the pixel is undecided.
const UNDECIDED: f32 = 0.25;
/// The number of alternations between factors of pixels and of spots.
const ROUNDS: usize = 2;

/// The strongest return of a histogram.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Return {
    /// The path, metres.
    pub path_m: f32,
    /// The light in its bin and in the adjacent ones that are part of it.
    pub energy: f32,
    /// The share of all light.
    pub share: f32,
    /// The path of the first light, metres; NaN without light.
    pub first_m: f32,
    /// The standard deviation of the light, if photons were counted.
    pub noise: f32,
}

impl Return {
    /// Returns the same with lengths multiplied by a factor.
    fn scaled(&self, factor: f32) -> Self {
        Self {
            path_m: self.path_m * factor,
            first_m: self.first_m * factor,
            ..*self
        }
    }
}

/// Replaces masks and times by those that agree with the depth from all spots. `returns`:
/// `[spot][row][column]`.
pub(super) fn expected(mut measured: Measured, returns: &[Return]) -> Measured {
    in_room(&mut measured, |measured, factor| {
        let scaled = returns.iter().map(|r| r.scaled(factor));
        decide_all(measured, &scaled.collect::<Vec<_>>());
    });
    measured
}

fn decide_all(measured: &mut Measured, returns: &[Return]) {
    let (pixels, k) = (measured.pixels(), measured.spots.len());
    let tolerance = BINS * measured.bin_width_m;
    let mut refined = measured.clone();
    let raw = closed_form(&mut refined).0;
    let depth = smooth(&refined, &raw);
    let paths = Paths::new(&refined, &depth);
    // The ratio of the return to the geometry, if both are known and agree in time.
    let agrees = |s: usize, p: usize| {
        (paths.length(s, p) - returns[s * pixels + p].path_m).abs() <= tolerance
    };
    let sample = |s: usize, p: usize| -> Option<f32> {
        let q = s * pixels + p;
        let usable = measured.lit[q] != 0 && measured.used[q] != 0 && agrees(s, p);
        let g = paths.geometry(s, p).filter(|_| usable)?;
        Some(returns[q].energy / g)
    };
    let mut of_spot = vec![1.0f32; k];
    let mut of_pixel = vec![f32::NAN; pixels];
    for round in 0..=ROUNDS {
        of_pixel = (0..pixels)
            .into_par_iter()
            .map(|p| {
                median(
                    (0..k)
                        .filter_map(|s| Some(sample(s, p)? / of_spot[s]))
                        .collect(),
                )
            })
            .collect();
        if round < ROUNDS {
            of_spot = (0..k)
                .into_par_iter()
                .map(|s| {
                    let found = (0..pixels).filter_map(|p| Some(sample(s, p)? / of_pixel[p]));
                    let factor = median(found.filter(|x| x.is_finite()).collect());
                    if factor > 0.0 { factor } else { 1.0 }
                })
                .collect();
        }
    }
    let decide = |q: usize| -> (u8, u8) {
        let (s, p) = (q / pixels, q % pixels);
        let (lit, used) = (measured.lit[q], measured.used[q]);
        if used == 0 || paths.grazes(s, p) {
            return (lit, used);
        }
        let found = &returns[q];
        let agrees = agrees(s, p) && found.path_m > measured.spots[s].path_m;
        let expected = paths.geometry(s, p).map(|g| g * of_pixel[p] * of_spot[s]);
        let share = expected.map_or(f32::NAN, |e| found.energy / e);
        match agrees {
            // Without a normal, the pixel is on an edge, and its depth and light belong to both
            // sides.
            _ if !share.is_finite() => (0, 0),
            _ if expected.is_some_and(|e| found.noise > UNDECIDED * e) => (0, 0),
            true if share < DARK => (0, 1),
            true if share >= BRIGHT && found.share >= LEAST_SHARE => (1, 1),
            true => (0, 0),
            // Two-bounce light would have been the strongest return.
            false if share < DARK => (0, 1),
            false => (0, 0),
        }
    };
    let decided: Vec<(u8, u8)> = (0..k * pixels).into_par_iter().map(decide).collect();
    if !decided.contains(&(1, 1)) {
        // The image is too coarse for normals, or no times agree, so only the threshold is
        // available.
        return;
    }
    for (q, (lit, used)) in decided.into_iter().enumerate() {
        measured.tau[q] = if lit != 0 { returns[q].path_m } else { 0.0 };
        measured.lit[q] = lit;
        measured.used[q] = used;
    }
}

/// Returns the lower median, or NaN if there are no values.
fn median(mut of: Vec<f32>) -> f32 {
    if of.is_empty() {
        return f32::NAN;
    }
    let middle = (of.len() - 1) / 2;
    *of.select_nth_unstable_by(middle, f32::total_cmp).1
}
