//! Scenes of any size: the lengths of the method are those of rooms. A scene that is much smaller
//! or larger is enlarged or reduced first, by a power of two, so that no digit changes, and the
//! result gets its size back.

use picofarm_demultiplex::room_factor;

use crate::{Agreement, Depth, Measured, Plane, field::Field};

/// Returns the power of two by which the lengths of measurements are multiplied; 1 for rooms.
pub(crate) fn factor(measured: &Measured) -> f32 {
    let camera = measured.camera.origin;
    let spots = measured.spots.iter();
    room_factor(spots.map(|spot| (spot.point - camera).length()))
}

/// Runs a step on measurements of the size of a room, with the factor of their lengths.
pub(crate) fn in_room<T>(measured: &mut Measured, step: impl FnOnce(&mut Measured, f32) -> T) -> T {
    let factor = factor(measured);
    measured.scale(factor);
    let result = step(measured, factor);
    measured.scale(1.0 / factor);
    result
}

/// Returns lengths multiplied by a factor.
pub(crate) fn lengths(metres: &[f32], factor: f32) -> Vec<f32> {
    metres.iter().map(|m| m * factor).collect()
}

fn multiply(metres: &mut [f32], factor: f32) {
    metres.iter_mut().for_each(|m| *m *= factor);
}

impl Measured {
    /// Multiplies all lengths by a factor.
    pub(crate) fn scale(&mut self, factor: f32) {
        self.camera.origin = self.camera.origin * factor;
        self.laser = self.laser * factor;
        for spot in &mut self.spots {
            spot.point = spot.point * factor;
            spot.path_m *= factor;
        }
        multiply(&mut self.tau, factor);
        multiply(&mut self.unlit_range_m, factor);
        self.bin_width_m *= factor;
    }
}

impl Depth {
    /// Multiplies all lengths by a factor.
    pub(crate) fn scale(&mut self, factor: f32) {
        multiply(&mut self.range, factor);
        multiply(&mut self.error, factor);
    }
}

impl Field {
    /// Multiplies the positions of the nodes by a factor.
    pub(crate) fn scale(&mut self, factor: f32) {
        self.origin = self.origin * factor;
        self.spacing *= factor;
    }
}

impl Plane {
    /// Returns the plane of a scene whose lengths are multiplied by a factor.
    pub(crate) fn scaled(self, factor: f32) -> Self {
        Self {
            offset: self.offset * factor,
            ..self
        }
    }
}

impl Agreement {
    /// Multiplies the figures that are lengths by a factor.
    pub(crate) fn scale(&mut self, factor: f32) {
        let lengths = [
            &mut self.time_residual_m,
            &mut self.time_offset_m,
            &mut self.spots_off_surface_m,
        ];
        let worst = self.worst_spot.as_mut().map(|(_, m)| m);
        for m in lengths.into_iter().flatten().chain(worst) {
            *m *= factor;
        }
    }
}
