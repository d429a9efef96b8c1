//! The input: one histogram of all spots at once, and its calibration.

use picofarm_scene::{Camera, Vec3};
use picofarm_settings::Gate;

use crate::DemultiplexError;

/// Where a beam meets its first diffuse surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// L, world axes, metres.
    pub point: Vec3,
    /// Optical path from the laser, metres; longer than the straight line where mirrors fold it.
    pub path_m: f32,
}

/// A beam of the laser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// Direction at the laser, world axes; of any length but zero.
    pub direction: Vec3,
    /// Its spot, where that is known. Otherwise it follows from the beam's own one-bounce return.
    pub place: Option<Place>,
}

/// One flash: a multiplexed histogram and its calibration.
#[derive(Debug, Clone, Copy)]
pub struct Capture<'a> {
    /// h, `[row][column][bin]`, linear, in any unit.
    pub histogram: &'a [f32],
    /// Begin, width and number of the bins, metres of optical path.
    pub gate: Gate,
    /// The camera.
    pub camera: &'a Camera,
    /// Where the laser stands, world axes, metres.
    pub laser: Vec3,
    /// Its beams.
    pub spots: &'a [Spot],
}

/// Most pixels a side, and most spots: beyond them an argument is taken for a mistake.
const MOST: usize = 4096;
/// Greatest length that takes part, metres: squares of it stay exact enough in single precision.
const FARTHEST_M: f32 = 1e4;

impl Capture<'_> {
    /// Pixels.
    pub fn pixels(&self) -> usize {
        self.camera.intrinsics.width as usize * self.camera.intrinsics.height as usize
    }

    /// Checks everything that the method relies on.
    ///
    /// # Errors
    /// [`DemultiplexError::Invalid`] names the first argument that cannot be used.
    pub fn check(&self) -> Result<(), DemultiplexError> {
        let no = |argument: &str, what: String| Err(DemultiplexError::invalid(argument, what));
        let i = &self.camera.intrinsics;
        let (w, h) = (i.width as usize, i.height as usize);
        if w == 0 || h == 0 || w > MOST || h > MOST {
            let what = format!("the image has {w}x{h} pixels, expected 1 to {MOST} each way");
            return no("camera.intrinsics", what);
        }
        let focal = [i.fx, i.fy].iter().all(|f| f.is_finite() && *f > 0.0);
        if !focal || !i.cx.is_finite() || !i.cy.is_finite() {
            let what = "focal lengths must be positive and finite, the principal point finite";
            return no("camera.intrinsics", what.into());
        }
        let axes = [self.camera.right, self.camera.down, self.camera.forward];
        let unit = axes.iter().all(|a| (a.length() - 1.0).abs() < 1e-3);
        if !unit || !near(self.camera.origin) {
            let what = "the axes must be of length 1 and the origin within 10 km";
            return no("camera pose", what.into());
        }
        let g = &self.gate;
        if !(g.start_m.is_finite() && g.start_m.abs() <= f64::from(FARTHEST_M)) {
            return no(
                "gate.start_m",
                format!("is {} m, expected within 10 km", g.start_m),
            );
        }
        if !(g.bin_width_m.is_finite() && (1e-5..=10.0).contains(&g.bin_width_m)) {
            let what = format!("is {} m, expected 0.00001 to 10 m", g.bin_width_m);
            return no("gate.bin_width_m", what);
        }
        if !(3..=1 << 16).contains(&g.bins) {
            return no("gate.bins", format!("is {}, expected 3 to 65536", g.bins));
        }
        let bins = g.bins as usize;
        if self.histogram.len() != w * h * bins {
            let what = format!(
                "has {} values, expected {h} rows x {w} columns x {bins} bins = {}",
                self.histogram.len(),
                w * h * bins
            );
            return no("histogram", what);
        }
        if let Some(at) = self.histogram.iter().position(|x| !x.is_finite()) {
            let (p, b) = (at / bins, at % bins);
            let what = format!(
                "is {} at row {}, column {}, bin {b}; expected finite values",
                self.histogram[at],
                p / w,
                p % w
            );
            return no("histogram", what);
        }
        if !near(self.laser) {
            return no("laser", "expected a place within 10 km".into());
        }
        if self.spots.is_empty() {
            return no("spots", "there are none, expected at least one beam".into());
        }
        if self.spots.len() > MOST {
            let what = format!("there are {}, expected at most {MOST}", self.spots.len());
            return no("spots", what);
        }
        for (k, spot) in self.spots.iter().enumerate() {
            let long = spot.direction.length();
            if !(long.is_finite() && long > 1e-6) {
                let what = "has no direction; expected finite values that are not all zero";
                return no(&format!("spots[{k}].direction"), what.into());
            }
            let Some(place) = spot.place else { continue };
            if !near(place.point) {
                let what = "expected a point within 10 km, or none";
                return no(&format!("spots[{k}].place.point"), what.into());
            }
            if !(0.0..=FARTHEST_M).contains(&place.path_m) {
                let what = format!("is {} m, expected 0 to 10 km, or no place", place.path_m);
                return no(&format!("spots[{k}].place.path_m"), what);
            }
        }
        Ok(())
    }
}

fn near(p: Vec3) -> bool {
    p.is_finite() && p.length() <= FARTHEST_M
}
