//! Scenes of any size: the constants of the method, and the trees of the learned shadows, are of
//! rooms. A scene that is much smaller or larger is enlarged or reduced first.

use picofarm_scene::Camera;
use picofarm_settings::Gate;

use crate::{Capture, Demultiplexed, Place, Spot, geometry::places};

/// Distances from the camera to the median spot that need no change, metres.
const ROOM_M: std::ops::Range<f32> = 2.0..10.0;
/// The greatest such distance after a change, metres; it is at least half of that.
const MOST_M: f32 = 5.0;

/// Returns the power of two by which a capture's lengths are multiplied; 1 for rooms.
pub fn factor(capture: &Capture) -> f32 {
    let camera = capture.camera;
    let places = places(capture);
    let places = places.iter().flatten();
    room_factor(places.map(|place| camera.to_camera(place.point).length()))
}

/// Returns the power of two that gives a scene the size of a room, from the distances of its spots
/// from the camera, metres; 1 for rooms, and without spots.
pub fn room_factor(spots_m: impl Iterator<Item = f32>) -> f32 {
    let mut all: Vec<f32> = spots_m.collect();
    if all.is_empty() {
        return 1.0;
    }
    let middle = all.len() / 2;
    let median = *all.select_nth_unstable_by(middle, f32::total_cmp).1;
    if ROOM_M.contains(&median) {
        return 1.0;
    }
    let mut factor = 1.0f32;
    // Powers of two change no digits. The limits are far from any scene.
    while median * factor > MOST_M && factor > 1e-3 {
        factor *= 0.5;
    }
    while median * factor <= 0.5 * MOST_M && factor < 1e3 {
        factor *= 2.0;
    }
    factor
}

/// A capture with all lengths multiplied.
pub struct Scaled {
    factor: f32,
    camera: Camera,
    spots: Vec<Spot>,
}

impl Scaled {
    pub fn new(capture: &Capture, factor: f32) -> Self {
        let spot = |spot: &Spot| Spot {
            place: spot.place.map(|place| scaled(place, factor)),
            ..*spot
        };
        Self {
            factor,
            camera: Camera {
                origin: capture.camera.origin * factor,
                ..*capture.camera
            },
            spots: capture.spots.iter().map(spot).collect(),
        }
    }

    /// The larger or smaller capture.
    pub fn capture<'a>(&'a self, of: &Capture<'a>) -> Capture<'a> {
        let factor = f64::from(self.factor);
        Capture {
            gate: Gate {
                start_m: of.gate.start_m * factor,
                bin_width_m: of.gate.bin_width_m * factor,
                ..of.gate
            },
            camera: &self.camera,
            laser: of.laser * self.factor,
            spots: &self.spots,
            ..*of
        }
    }

    /// Depths of the capture in the size of the scaled one.
    pub fn depth(&self, metres: &[f32]) -> Vec<f32> {
        metres.iter().map(|z| z * self.factor).collect()
    }

    /// A result in the size of the capture.
    pub fn back(&self, mut found: Demultiplexed) -> Demultiplexed {
        let back = 1.0 / self.factor;
        found.depth_m.iter_mut().for_each(|z| *z *= back);
        for place in found.places.iter_mut().flatten() {
            *place = scaled(*place, back);
        }
        found
    }
}

fn scaled(place: Place, factor: f32) -> Place {
    Place {
        point: place.point * factor,
        path_m: place.path_m * factor,
    }
}
