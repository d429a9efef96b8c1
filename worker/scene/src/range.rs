//! The optical paths of a scene's light.

use crate::{Scene, Vec3, viewpoint::Surroundings};

/// The number of rays along each side of the image.
const RAYS: u32 = 32;

impl Scene {
    /// Returns the shortest and longest optical path of light of one and two bounces, metres, from
    /// a coarse grid of pixels. Mirrors count as surfaces, and shadows are lit, so the true range
    /// may be a little narrower or wider. Returns `None` if no beam hits anything that the camera
    /// sees.
    pub fn path_range_m(&self) -> Option<[f64; 2]> {
        let world = Surroundings::new(&self.objects)?;
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
}
