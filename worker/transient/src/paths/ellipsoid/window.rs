//! The window of path lengths of a narrow gate.

use crate::{api::Gate, scene::world::World};

/// Margin for rounding when paths are left out, as a share of the gate's end.
const ROUNDING: f64 = 1e-5;

/// Largest length of a gate, in scene diagonals, for ellipsoidal connections to pay, by error² ×
/// CPU time on furnished rooms with 1 and 25 spots: gains of 0.8 to 2.6 at 1/200 to 1/50, of 0.9 to
/// 1.1 at 1/12 and losses beyond.
const NARROW: f64 = 1.0 / 40.0;

/// Returns whether ellipsoidal connections pay.
pub(crate) fn pays(gate: &Gate, world: &World) -> bool {
    let length = gate.bin_width_m * f64::from(gate.bins);
    length < NARROW * world.metres(world.diagonal)
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
