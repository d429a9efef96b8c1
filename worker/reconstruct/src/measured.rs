//! The input of a reconstruction: two-bounce times and shadow masks of K spots, from any source.

use picofarm_scene::{Camera, Vec3};

use crate::ReconstructError;

/// The sine of the least angle between a pixel's ray and a laser beam. Pixels at smaller angles are
/// not used for that spot, because its one-bounce light drowns their light (PlatoNeRF,
/// `src/run_platonerf.py`).
pub const NEAR_SPOT_SINE: f32 = 0.05;

/// An illumination spot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredSpot {
    /// The index of its beam in the scene.
    pub beam: usize,
    /// The unit direction from the laser.
    pub direction: Vec3,
    /// The position L, metres, in world axes.
    pub point: Vec3,
    /// The optical path from laser to spot, metres.
    pub path_m: f32,
    /// Whether a mirror reflected the beam, so that the spot is not along `direction`.
    pub folded: bool,
}

/// An excluded spot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeftOut {
    /// The index of its beam in the scene.
    pub beam: usize,
    /// The reason.
    pub why: String,
}

/// The two-bounce times and shadow masks of one camera. Arrays over pixels are row-major,
/// `[row][column]`; those that are also over spots are `[spot][row][column]`.
#[derive(Debug, Clone)]
pub struct Measured {
    /// The camera.
    pub camera: Camera,
    /// The laser's position, metres.
    pub laser: Vec3,
    /// The K spots.
    pub spots: Vec<MeasuredSpot>,
    /// The two-bounce path laser → spot → surface → camera, metres; undefined for pixels in shadow.
    pub tau: Vec<f32>,
    /// 1 = lit, 0 = in shadow.
    pub lit: Vec<u8>,
    /// 1 = used, 0 = unknown.
    pub used: Vec<u8>,
    /// The width of the bins of the times, metres; 0 = times are exact. A time is the middle of its
    /// bin.
    pub bin_width_m: f32,
    /// Whether times were computed from one depth a pixel, so that they agree by construction.
    pub computed: bool,
    /// The pixels known to see a mirror, which are not used at all; empty = none known.
    pub mirror: Vec<u8>,
    /// How surely each pixel's times are its own, 0 to 1, where times were separated from one
    /// flash; empty = all are.
    pub confidence: Vec<f32>,
    /// The distance along the ray of pixels that no spot lights, metres, as far as other light
    /// shows it; NaN = unknown; empty = no pixel's is known.
    pub unlit_range_m: Vec<f32>,
    /// The spots that are not used.
    pub left_out: Vec<LeftOut>,
}

/// The confidence below which a pixel is no evidence of the room's planes, and below which its
/// light paths are no evidence of matter. Both were chosen on six furnished rooms (seeds 93001 to
/// 93006).
const SURE: f32 = 0.8;
const EVIDENT: f32 = 0.6;

impl Measured {
    /// Returns whether a pixel's times may be another surface's.
    pub fn is_doubtful(&self, pixel: usize) -> bool {
        self.confidence.get(pixel).is_some_and(|c| *c < SURE)
    }

    /// Returns whether a pixel's light paths are evidence: they are not where they may begin at
    /// another surface.
    pub fn is_evident(&self, pixel: usize) -> bool {
        self.confidence.get(pixel).is_none_or(|c| *c >= EVIDENT)
    }

    /// Returns the number of pixels.
    pub fn pixels(&self) -> usize {
        self.camera.intrinsics.width as usize * self.camera.intrinsics.height as usize
    }

    /// Returns the pixel that sees a position, or `None` outside the view.
    pub(crate) fn pixel_of(&self, x: Vec3) -> Option<usize> {
        let i = &self.camera.intrinsics;
        let q = self.camera.to_camera(x);
        let (u, v) = (i.fx * q.x / q.z + i.cx, i.fy * q.y / q.z + i.cy);
        let inside =
            q.z > 0.02 && u >= 0.0 && v >= 0.0 && u < i.width as f32 && v < i.height as f32;
        inside.then(|| v as usize * i.width as usize + u as usize)
    }

    /// Returns the unit direction through the middle of a pixel.
    pub fn ray(&self, pixel: usize) -> Vec3 {
        let width = self.camera.intrinsics.width as usize;
        let (x, y) = ((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5);
        self.camera.ray(x, y).normalized()
    }

    /// Checks the assumptions of the reconstruction, and returns notes on properties that cannot be
    /// determined from these measurements.
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
        if !self.confidence.is_empty() && self.confidence.len() != pixels {
            let what = format!(
                "has {} values, expected {pixels} pixels or none",
                self.confidence.len()
            );
            return Err(ReconstructError::invalid("confidence", what));
        }
        if !self.unlit_range_m.is_empty() && self.unlit_range_m.len() != pixels {
            let what = format!(
                "has {} values, expected {pixels} pixels or none",
                self.unlit_range_m.len()
            );
            return Err(ReconstructError::invalid("unlit_range_m", what));
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
