//! The energy of histograms around the bins predicted for two-bounce light by the geometry.

use std::path::Path;

use super::mask_order::{Masks, flipped};
use super::scene::{Shape, direction};
use super::vector::{distance, norm};
use picofarm_dataset::{Intrinsics, Spot};

/// Approximate maximum number of pixels in the sample.
const SAMPLE: usize = 2048;
/// Number of bins examined before and after the predicted one.
const REACH: isize = 20;
/// Maximum distance of the peak from the prediction, in steps.
pub(super) const TOLERANCE: isize = 1;
/// Length of a step in metres. A step is at least one bin. It may be several, because pulses of
/// real lasers are longer than their bins.
const STEP_M: f64 = 0.0384;
/// Minimum number of pairs of pixel and spot for a verdict.
pub(super) const MIN_PAIRS: usize = 200;
/// Minimum ratio of the peak to its surroundings.
pub(super) const CONTRAST: f64 = 1.3;
/// Minimum ratio by which another interpretation must fit better to be believed.
pub(super) const BETTER: f64 = 1.15;

/// The inputs of a prediction.
pub(super) struct Geometry<'a> {
    pub shape: &'a Shape,
    pub transient: &'a [f32],
    /// z-depth in metres.
    pub depth: &'a [f32],
    /// Whether the depth was computed from distances along the rays.
    pub of_range: bool,
    pub intrinsics: Intrinsics,
    /// Laser origin in metres, in the camera frame.
    pub laser: [f32; 3],
    pub spots: &'a [Option<Spot>],
    /// `[spot][row][column]`, 1 = lit; `None` if unknown.
    pub visibility: Option<&'a [u8]>,
    pub specular: &'a [u8],
}

/// The files to name if the check fails, and the options to override them.
pub(super) struct Blame<'a> {
    pub histogram: &'a Path,
    pub depth: &'a Path,
    pub spots: &'a Path,
    pub visibility: &'a Path,
    /// How the format specifies geometry and gate.
    pub hint: &'a str,
    /// How the format specifies the masks' polarity.
    pub polarity: &'a str,
}

/// Another interpretation of the same files.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Reading {
    /// The depth image contains the other kind of depth.
    pub other_depth: bool,
    pub flip_spots: [bool; 2],
    pub flip_image: [bool; 2],
    pub masks: Masks,
}

/// Energy around the predicted bin, averaged over pairs of pixel and spot.
pub(super) struct Profile {
    energy: Vec<f64>,
    pub pairs: usize,
}

impl Profile {
    pub(super) fn at(&self, shift: isize) -> f64 {
        self.energy[(shift + REACH) as usize] / self.pairs.max(1) as f64
    }

    /// Returns the shift with the most energy.
    pub(super) fn peak(&self) -> isize {
        let all = -REACH..=REACH;
        all.max_by(|a, b| self.at(*a).total_cmp(&self.at(*b)))
            .expect("not empty")
    }

    /// Returns the highest energy among the tolerated shifts.
    pub fn hit(&self) -> f64 {
        let near = (-TOLERANCE..=TOLERANCE).map(|s| self.at(s));
        near.fold(0.0, f64::max)
    }

    /// Returns the excess energy at the prediction.
    pub fn excess(&self) -> f64 {
        self.hit() - self.background()
    }

    /// Returns the median energy of more distant shifts.
    pub fn background(&self) -> f64 {
        let far = (-REACH..=REACH).filter(|s| s.abs() > 2 * TOLERANCE + 2);
        let mut far: Vec<f64> = far.map(|s| self.at(s)).collect();
        far.sort_by(f64::total_cmp);
        far[far.len() / 2]
    }
}

/// A selection of pairs of pixel and spot.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Which {
    All,
    Lit,
    Dark,
}

/// Returns the number of bins in a step.
pub(super) fn step(g: &Geometry<'_>) -> usize {
    let width = g.shape.gate.bin_width_m;
    (libm::round(STEP_M / width) as usize).clamp(1, g.shape.gate.bins as usize)
}

/// Computes the energy around the predictions in a sample of pixels.
pub(super) fn profile(g: &Geometry<'_>, reading: Reading, which: Which) -> Profile {
    let spots = g.spots.iter().enumerate();
    let spots: Vec<(usize, Spot)> = spots.filter_map(|(i, s)| Some((i, (*s)?))).collect();
    profile_of(g, reading, which, &spots)
}

/// Like [`profile`], for these spots only, each with the index of its mask.
pub(super) fn profile_of(
    g: &Geometry<'_>,
    reading: Reading,
    which: Which,
    spots: &[(usize, Spot)],
) -> Profile {
    let shape = g.shape;
    let (w, h, bins) = (
        shape.width as usize,
        shape.height as usize,
        shape.gate.bins as usize,
    );
    let stride = (1..)
        .find(|s| (w / s) * (h / s) <= SAMPLE)
        .expect("some stride is wide enough");
    let step = step(g);
    let mut sum = vec![0.0; 2 * REACH as usize + 1];
    let mut pairs = 0;
    for row in (stride / 2..h).step_by(stride) {
        for column in (stride / 2..w).step_by(stride) {
            let pixel = row * w + column;
            let depth = f64::from(g.depth[pixel]);
            if depth <= 0.0 || g.specular[pixel] != 0 {
                continue;
            }
            let seen = flipped(row, h, reading.flip_image[1]) * w
                + flipped(column, w, reading.flip_image[0]);
            let histogram = &g.transient[seen * bins..][..bins];
            let total: f64 = histogram.iter().map(|x| f64::from(*x)).sum();
            if total <= 0.0 {
                continue;
            }
            let d = direction(g.intrinsics, row, column);
            let z = match (reading.other_depth, g.of_range) {
                (false, _) => depth,
                (true, false) => depth / norm(d),
                (true, true) => depth * norm(d),
            };
            let x = d.map(|c| c * z);
            for &(index, spot) in spots {
                let lit = g.visibility.is_none_or(|v| {
                    let at = reading
                        .masks
                        .place(index, (row, column), (g.spots.len(), h, w));
                    v[at] == 1
                });
                if which != Which::All && lit != (which == Which::Lit) {
                    continue;
                }
                let mut l = spot.position.map(f64::from);
                for (axis, flip) in reading.flip_spots.iter().enumerate() {
                    if *flip {
                        l[axis] = -l[axis];
                    }
                }
                let path = f64::from(spot.path_m) + distance(l, x) + norm(x);
                let bin = libm::floor((path - shape.gate.start_m) / shape.gate.bin_width_m);
                if !(0.0..bins as f64).contains(&bin) {
                    continue;
                }
                let centre = bin as usize / step;
                for (energy, shift) in sum.iter_mut().zip(-REACH..=REACH) {
                    let Some(at) = centre.checked_add_signed(shift) else {
                        continue;
                    };
                    let range = (at * step).min(bins)..((at + 1) * step).min(bins);
                    let there: f64 = histogram[range].iter().map(|x| f64::from(*x)).sum();
                    *energy += there / total;
                }
                pairs += 1;
            }
        }
    }
    Profile { energy: sum, pairs }
}
