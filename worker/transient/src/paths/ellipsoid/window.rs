//! The window of path lengths of a narrow gate.

use crate::{api::Gate, scene::world::World, tuning::EllipsoidTuning};

/// Margin for rounding when paths are left out, as a share of the gate's end.
const ROUNDING: f64 = 1e-5;

/// Returns whether ellipsoidal connections pay.
pub(crate) fn pays(gate: &Gate, world: &World, tuning: &EllipsoidTuning) -> bool {
    let length = gate.bin_width_m * f64::from(gate.bins);
    length < tuning.narrow * world.metres(world.diagonal)
}

/// A range of optical path, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Window {
    pub start_m: f64,
    pub end_m: f64,
}

impl Window {
    /// Returns the gate's range, with a margin for rounding.
    pub fn new(gate: &Gate) -> Self {
        let more = ROUNDING * gate.end_m() + 0.01 * gate.bin_width_m;
        Self {
            start_m: gate.start_m - more,
            end_m: gate.end_m() + more,
        }
    }

    #[inline]
    pub fn holds(&self, path_m: f64) -> bool {
        path_m >= self.start_m && path_m < self.end_m
    }
}
