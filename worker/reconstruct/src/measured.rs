//! What a reconstruction is made from: two-bounce times and shadow masks of K spots, whatever their source.

use picofarm_scene::{Camera, Vec3};

use crate::ReconstructError;

/// Pixels whose ray is nearer to a laser beam than this (sine of the angle) take no part for that spot: its one-bounce
/// light drowns theirs (PlatoNeRF, `src/run_platonerf.py`).
pub const NEAR_SPOT_SINE: f32 = 0.05;

/// An illumination spot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredSpot {
    /// Index of its beam in the scene.
    pub beam: usize,
    /// Unit direction from the laser.
    pub direction: Vec3,
    /// Position L, metres, world axes.
    pub point: Vec3,
    /// Optical path from laser to spot, metres.
    pub path_m: f32,
    /// The beam came by way of a mirror: the spot does not lie along `direction`.
    pub folded: bool,
}

/// A spot that takes no part.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeftOut {
    /// Index of its beam in the scene.
    pub beam: usize,
    /// Why.
    pub why: String,
}

/// Two-bounce times and shadow masks of one camera. Arrays over pixels are row-major, `[row][column]`; those over spots
/// too are `[spot][row][column]`.
#[derive(Debug, Clone)]
pub struct Measured {
    /// The camera.
    pub camera: Camera,
    /// Where the laser stands, metres.
    pub laser: Vec3,
    /// The K spots.
    pub spots: Vec<MeasuredSpot>,
    /// Two-bounce path laser → spot → surface → camera, metres; meaningless where not lit.
    pub tau: Vec<f32>,
    /// 1 = lit, 0 = in shadow.
    pub lit: Vec<u8>,
    /// 1 = takes part, 0 = unknown.
    pub used: Vec<u8>,
    /// Width of the bins that the times were read from, metres; 0 = times are exact. A time is the middle of its bin.
    pub bin_width_m: f32,
    /// Pixels that see a mirror, where that is known, and take no part in anything; empty = none known.
    pub mirror: Vec<u8>,
    /// Spots that take no part.
    pub left_out: Vec<LeftOut>,
}

impl Measured {
    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.camera.intrinsics.width as usize * self.camera.intrinsics.height as usize
    }

    /// Unit direction through the middle of a pixel.
    pub fn ray(&self, pixel: usize) -> Vec3 {
        let width = self.camera.intrinsics.width as usize;
        let (x, y) = ((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5);
        self.camera.ray(x, y).normalized()
    }

    /// Checks what the reconstruction relies on, and says what cannot be found from these measurements.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] naming the first unusable field.
    pub fn check(&self) -> Result<Vec<String>, ReconstructError> {
        let (pixels, k) = (self.pixels(), self.spots.len());
        if pixels == 0 {
            let what = "has no pixels; expected at least one each way";
            return Err(ReconstructError::invalid("camera", what));
        }
        if k == 0 {
            let why: Vec<String> = self.left_out.iter().map(reason).collect();
            let what = format!(
                "there is no usable spot, expected at least one; {}",
                if why.is_empty() {
                    "give the scene a laser beam".into()
                } else {
                    why.join("; ")
                }
            );
            return Err(ReconstructError::invalid("spots", what));
        }
        for (name, length) in [
            ("tau", self.tau.len()),
            ("lit", self.lit.len()),
            ("used", self.used.len()),
        ] {
            if length != k * pixels {
                let what = format!("has {length} values, expected {k} spots x {pixels} pixels");
                return Err(ReconstructError::invalid(name, what));
            }
        }
        for (i, spot) in self.spots.iter().enumerate() {
            if !(spot.point.is_finite() && spot.path_m.is_finite() && spot.path_m >= 0.0) {
                let what = "is not finite; expected a position and a path in metres";
                return Err(ReconstructError::invalid(format!("spots[{i}]"), what));
            }
        }
        let mut counts = [0usize; 2];
        for (q, &tau) in self.tau.iter().enumerate() {
            if self.used[q] == 0 {
                continue;
            }
            counts[usize::from(self.lit[q] != 0)] += 1;
            if self.lit[q] != 0 && !(tau.is_finite() && tau > self.spots[q / pixels].path_m) {
                let field = format!("tau[{}][{}]", q / pixels, q % pixels);
                let what = format!(
                    "is {tau} m at a lit pixel, expected more than the path to the spot ({} m); mark the pixel as unused",
                    self.spots[q / pixels].path_m
                );
                return Err(ReconstructError::invalid(field, what));
            }
        }
        let [shadow, lit] = counts;
        if lit == 0 {
            let what = "no pixel is lit by any spot: there are no times to find depth from; check gate, threshold and spots";
            return Err(ReconstructError::invalid("lit", what));
        }
        let mut notes: Vec<String> = self.left_out.iter().map(reason).collect();
        if shadow == 0 {
            notes.push(
                "no pixel is in shadow: nothing can be found of what the camera does not see"
                    .into(),
            );
        }
        if k == 1 {
            notes.push("one spot: pixels in its shadow have no depth".into());
        }
        Ok(notes)
    }
}

fn reason(left: &LeftOut) -> String {
    format!("beam {} is left out: {}", left.beam, left.why)
}
