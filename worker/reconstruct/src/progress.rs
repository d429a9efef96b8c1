//! The progress of a reconstruction, and requests to stop it.

use crate::ReconstructError;

/// The phases of a reconstruction, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// Computing the depth of every pixel from its ellipsoids.
    Depth,
    /// Finding planes of the room.
    Planes,
    /// Setting the field's start from depth and planes.
    Start,
    /// Carving by light paths.
    Carve,
    /// Selecting the rays for optimisation.
    Rays,
    /// Optimising on transmittance.
    Optimise,
}

impl Phase {
    /// Returns the phase's name, for people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Depth => "depth",
            Self::Planes => "planes",
            Self::Start => "start",
            Self::Carve => "carving",
            Self::Rays => "rays",
            Self::Optimise => "optimisation",
        }
    }
}

/// Receives the progress of a reconstruction, and may stop it.
pub trait Progress: Sync {
    /// Receives the finished share of the phase in [0, 1], and the loss per ray if there is one.
    /// Returns `false` to stop.
    fn at(&self, phase: Phase, done: f32, loss: Option<f64>) -> bool;
}

/// A [`Progress`] that ignores reports and never stops.
#[derive(Debug, Clone, Copy, Default)]
pub struct Unwatched;

impl Progress for Unwatched {
    fn at(&self, _: Phase, _: f32, _: Option<f64>) -> bool {
        true
    }
}

/// Begins a phase, unless `progress` stops it.
pub(crate) fn begin(progress: &dyn Progress, phase: Phase) -> Result<(), ReconstructError> {
    match progress.at(phase, 0.0, None) {
        true => Ok(()),
        false => Err(ReconstructError::Stopped),
    }
}
