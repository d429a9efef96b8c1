//! A rendered scene for the codecs, and the errors of a codec on it.

use std::ops::Range;

use picofarm_dataset::{Dataset, Gate, Quantity, Spot};
use picofarm_store::StorageError;
use rayon::prelude::*;
use serde::Serialize;

/// A histogram image, with the information for evaluating a code: photons, and where two-bounce
/// light arrives.
pub struct Sample {
    pub scene: u64,
    pub height: usize,
    pub width: usize,
    pub bins: usize,
    /// `[row][column][bin]`.
    pub h: Vec<f32>,
    /// Photons per unit of h.
    pub scale: f32,
    /// For each pixel, the bins in which light of a lit spot arrives after two bounces.
    arrivals: Vec<Vec<u16>>,
}

/// Errors of a code on a scene.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Loss {
    /// Maximum error in σ = √max(N, 1) of N photons.
    pub max_sigma: f64,
    pub rms_sigma: f64,
    /// Fraction of pixels in which another two-bounce bin is now the brightest.
    pub peak_moved: f64,
    /// Rms error of the brightest two-bounce bin's intensity, in σ.
    pub peak_sigma: f64,
}

impl Sample {
    /// Reads a scene of a data set.
    ///
    /// # Errors
    /// Fails if the scene cannot be read.
    pub async fn read(dataset: &Dataset, scene: u64) -> Result<Self, StorageError> {
        let spec = *dataset.spec();
        let depth: Vec<f32> = dataset.read(scene, Quantity::Depth).await?;
        let scale: Vec<f32> = dataset.read(scene, Quantity::Scale).await?;
        let i = dataset.read_intrinsics(scene).await?;
        let lit = dataset.read_visibility(scene).await?;
        let spots = dataset.read_spots(scene).await?;
        let width = spec.width as usize;
        let pixels = spec.pixels();
        let arrivals = (0..pixels)
            .map(|p| {
                let (u, v) = ((p % width) as f32 + 0.5, (p / width) as f32 + 0.5);
                let z = depth[p];
                let x = [z * (u - i.cx) / i.fx, z * (v - i.cy) / i.fy, z];
                let seen = spots
                    .iter()
                    .enumerate()
                    .filter(|(s, _)| lit[s * pixels + p] == 1);
                let each = seen.filter_map(|(_, spot)| Some(path(spot.as_ref()?, x)));
                bins(each.filter(|_| z > 0.0), &spec.gate)
            })
            .collect();
        Ok(Self {
            scene,
            height: spec.height as usize,
            width,
            bins: spec.gate.bins as usize,
            h: dataset.read_transient(scene).await?,
            scale: scale[0],
            arrivals,
        })
    }

    /// Returns the size as 32-bit floats, in bytes.
    pub fn raw_bytes(&self) -> usize {
        self.h.len() * 4
    }

    /// Returns the mean number of bins of a pixel with two-bounce light.
    pub fn arrivals(&self) -> f64 {
        self.arrivals.iter().map(Vec::len).sum::<usize>() as f64 / self.arrivals.len() as f64
    }

    /// Returns the error of a code's decoded values.
    pub fn loss(&self, found: &[f32]) -> Loss {
        assert_eq!(
            found.len(),
            self.h.len(),
            "a code gives back what it was given"
        );
        let scale = f64::from(self.scale);
        let error = |at: usize| {
            let n = f64::from(self.h[at]) * scale;
            (f64::from(found[at]) - f64::from(self.h[at])) * scale / n.max(1.0).sqrt()
        };
        let each = self
            .arrivals
            .par_iter()
            .enumerate()
            .map(|(pixel, arrivals)| {
                let first = pixel * self.bins;
                let mut sums = Sums::default();
                for at in first..first + self.bins {
                    let e = error(at);
                    sums.squares += e * e;
                    sums.worst = sums.worst.max(e.abs());
                }
                if let Some(peak) = brightest(&self.h[first..], arrivals).filter(|(_, h)| *h > 0.0)
                {
                    let now = brightest(&found[first..], arrivals).map(|(bin, _)| bin);
                    let e = error(first + peak.0);
                    sums.peaks = 1.0;
                    sums.moved = f64::from(u8::from(now != Some(peak.0)));
                    sums.peak_squares = e * e;
                }
                sums
            });
        let sums = each.reduce(Sums::default, Sums::and);
        let peaks = sums.peaks.max(1.0);
        Loss {
            max_sigma: sums.worst,
            rms_sigma: (sums.squares / self.h.len() as f64).sqrt(),
            peak_moved: sums.moved / peaks,
            peak_sigma: (sums.peak_squares / peaks).sqrt(),
        }
    }
}

#[derive(Default)]
struct Sums {
    squares: f64,
    worst: f64,
    peaks: f64,
    moved: f64,
    peak_squares: f64,
}

impl Sums {
    fn and(self, other: Self) -> Self {
        Self {
            squares: self.squares + other.squares,
            worst: self.worst.max(other.worst),
            peaks: self.peaks + other.peaks,
            moved: self.moved + other.moved,
            peak_squares: self.peak_squares + other.peak_squares,
        }
    }
}

/// Returns τ of two-bounce light in metres: laser to spot to `x` to camera.
fn path(spot: &Spot, x: [f32; 3]) -> f64 {
    let norm = |v: [f32; 3]| {
        v.map(|c| f64::from(c) * f64::from(c))
            .iter()
            .sum::<f64>()
            .sqrt()
    };
    let p = spot.position;
    f64::from(spot.path_m) + norm([x[0] - p[0], x[1] - p[1], x[2] - p[2]]) + norm(x)
}

/// Returns the bins of these paths and their neighbours (because a pixel has an extent), in
/// ascending order.
fn bins(paths: impl Iterator<Item = f64>, gate: &Gate) -> Vec<u16> {
    let last = i64::from(gate.bins) - 1;
    let around = |tau: f64| {
        let bin = ((tau - gate.start_m) / gate.bin_width_m).floor() as i64;
        (bin - 1).max(0)..(bin + 2).min(last + 1)
    };
    let mut bins: Vec<u16> = paths
        .flat_map(|tau| -> Range<i64> { around(tau) })
        .map(|bin| bin as u16)
        .collect();
    bins.sort_unstable();
    bins.dedup();
    bins
}

/// Returns the first of the brightest of some bins.
fn brightest(h: &[f32], bins: &[u16]) -> Option<(usize, f32)> {
    let all = bins.iter().map(|b| (usize::from(*b), h[usize::from(*b)]));
    all.reduce(|best, one| if one.1 > best.1 { one } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_moved_peak_and_a_wrong_intensity_are_seen() {
        let sample = Sample {
            scene: 0,
            height: 1,
            width: 2,
            bins: 4,
            h: vec![0.0, 4.0, 9.0, 100.0, 1.0, 1.0, 16.0, 0.0],
            scale: 1.0,
            arrivals: vec![vec![1, 2], vec![2]],
        };
        let none = sample.loss(&sample.h.clone());
        assert_eq!((none.max_sigma, none.peak_moved), (0.0, 0.0));
        let mut found = sample.h.clone();
        // The peak of the first pixel is bin 2: bin 3 has no two-bounce light.
        found[1] = 10.0;
        found[6] = 18.0;
        let loss = sample.loss(&found);
        assert_eq!(loss.max_sigma, 3.0);
        assert_eq!(loss.peak_moved, 0.5);
        assert!((loss.peak_sigma - (0.125f64).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn bins_of_paths_are_cut_at_the_gate() {
        let gate = Gate {
            start_m: 1.0,
            bin_width_m: 0.5,
            bins: 10,
        };
        let found = bins([1.1, 5.9, 0.2, 3.1, 3.2].into_iter(), &gate);
        assert_eq!(found, [0, 1, 3, 4, 5, 8, 9]);
    }
}
