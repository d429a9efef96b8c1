//! The optical paths of a scene's light.

use picofarm_settings::Gate;

use crate::{Scene, Vec3, viewpoint::Surroundings};

/// The number of rays along each side of the image.
const RAYS: u32 = 32;
/// The least number of bins between a scene's first and last light for which the usual gate is
/// kept.
const LEAST_BINS: f64 = 24.0;
/// How far a fitted gate reaches beyond the last light of two bounces, for longer paths.
const BEYOND: f64 = 1.25;

/// A gate for a scene, with the paths that it was fitted to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FittedGate {
    /// The gate, with lengths of about three digits.
    pub gate: Gate,
    /// The shortest and longest optical path of one and two bounces, metres.
    pub path_range_m: [f64; 2],
    /// Whether the usual gate records this range with enough bins, so that it may be kept.
    pub usual_fits: bool,
}

impl Scene {
    /// Returns the shortest and longest optical path of light of one and two bounces, metres, from
    /// a coarse grid of pixels. Mirrors count as surfaces, glass does not, and shadows are lit, so
    /// the true range may be a little narrower or wider. Returns `None` if no beam hits anything
    /// that the camera sees.
    pub fn path_range_m(&self) -> Option<[f64; 2]> {
        let world = Surroundings::opaque(&self.objects)?;
        let hit = |from: Vec3, direction: Vec3| {
            let t = world.closest(from, direction)?.t;
            Some(from + direction * t)
        };
        let i = &self.camera.intrinsics;
        let mut seen = Vec::new();
        for row in 0..RAYS {
            for column in 0..RAYS {
                let x = (column as f32 + 0.5) / RAYS as f32 * i.width as f32;
                let y = (row as f32 + 0.5) / RAYS as f32 * i.height as f32;
                seen.extend(hit(self.camera.origin, self.camera.ray(x, y)));
            }
        }
        let beams = self.laser.beams.iter();
        let spots: Vec<Vec3> = beams
            .filter_map(|beam| hit(self.laser.origin, beam.direction))
            .collect();
        let length = |a: Vec3, b: Vec3| f64::from((a - b).length());
        let (mut first, mut last) = (f64::INFINITY, f64::NEG_INFINITY);
        for spot in &spots {
            let out = length(self.laser.origin, *spot);
            first = first.min(out + length(*spot, self.camera.origin));
            for point in &seen {
                let path = out + length(*spot, *point) + length(*point, self.camera.origin);
                (first, last) = (first.min(path), last.max(path));
            }
        }
        (first.is_finite() && last > first).then_some([first, last])
    }

    /// Returns a gate with the bins of `usual` from shortly before the first light to well after
    /// the last light of two bounces; `None` if no beam hits anything that the camera sees.
    ///
    /// # Examples
    /// ```
    /// use picofarm_scene::primitive::{PrimitiveSettings, generate};
    /// use picofarm_settings::Gate;
    ///
    /// let room = generate(3, &PrimitiveSettings::default())?;
    /// let usual = Gate { start_m: 1.0, bin_width_m: 0.0384, bins: 637 };
    /// let fitted = room.fitted_gate(usual).expect("the laser hits the room");
    /// assert!(fitted.usual_fits);
    /// assert!(fitted.gate.start_m < fitted.path_range_m[0]);
    /// # Ok::<(), picofarm_scene::SceneError>(())
    /// ```
    pub fn fitted_gate(&self, usual: Gate) -> Option<FittedGate> {
        Some(FittedGate::new(self.path_range_m()?, usual))
    }
}

impl FittedGate {
    /// Returns a gate with the bins of `usual` for a range of optical paths of one and two bounces,
    /// metres.
    pub fn new([first, last]: [f64; 2], usual: Gate) -> Self {
        let start = 0.9 * first;
        let width = BEYOND * (last - start) / f64::from(usual.bins);
        // Three digits, rounded up.
        let digits = 10f64.powf(2.0 - width.log10().floor());
        Self {
            gate: Gate {
                start_m: (start * digits).floor() / digits,
                bin_width_m: (width * digits).ceil() / digits,
                bins: usual.bins,
            },
            path_range_m: [first, last],
            usual_fits: first >= usual.start_m
                && last <= usual.end_m()
                && last - first >= LEAST_BINS * usual.bin_width_m,
        }
    }
}
