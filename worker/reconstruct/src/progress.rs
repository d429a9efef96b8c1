//! How far a reconstruction is, and the wish to stop it.

use crate::ReconstructError;

/// What a reconstruction does, in this order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// Depth of every pixel from its ellipsoids.
    Depth,
    /// Planes of the room.
    Planes,
    /// The field's start from depth and planes.
    Start,
    /// Carving by light paths.
    Carve,
    /// Selection of the rays that are worth casting.
    Rays,
    /// Optimisation on transmittance.
    Optimise,
}

impl Phase {
    /// Its name, for people.
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

/// Called with the progress of a reconstruction; may end it.
pub trait Progress: Sync {
    /// Share of the phase that is done in [0, 1], and the loss per ray where there is one. Return `false` to stop.
    fn at(&self, phase: Phase, done: f32, loss: Option<f64>) -> bool;
}

/// Nobody watches and nobody stops it.
#[derive(Debug, Clone, Copy, Default)]
pub struct Unwatched;

impl Progress for Unwatched {
    fn at(&self, _: Phase, _: f32, _: Option<f64>) -> bool {
        true
    }
}

/// Begins a phase, unless it shall stop.
pub(crate) fn begin(progress: &dyn Progress, phase: Phase) -> Result<(), ReconstructError> {
    match progress.at(phase, 0.0, None) {
        true => Ok(()),
        false => Err(ReconstructError::Stopped),
    }
}
