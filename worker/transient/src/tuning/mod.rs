//! The numbers that techniques are tuned by.
//!
//! They trade noise against time. Most were chosen by error² × CPU time on furnished rooms. Vary
//! them with [`render_tuned`](crate::render_tuned). The expectation of a render does not depend on
//! them, with these exceptions: limits on turns and branches (`most_turns`, `least_branch`) drop
//! light that hardly counts, photons blur, and [`ErrorTuning`] changes the stated error.
//!
//! Margins of float arithmetic, sizes of arrays and limits of memory are constants where they are
//! used. So is the roughness from which pixels share a conductor's vertices, because every hit asks
//! for it.

mod glass;
mod light;
mod paths;
mod render;

use serde::{Deserialize, Serialize};

pub use self::{
    glass::GlassTuning,
    light::{BeamTuning, CausticTuning, ContactTuning, MirrorTuning, ReflectorTuning},
    paths::{EllipsoidTuning, PathReuseTuning, TileEffort, TwoBounceTuning, WalkTuning},
    render::{ErrorTuning, RoundTuning},
};

/// All numbers, by technique. The default is what [`render`](crate::render()) uses.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Tuning {
    /// Beams on their way to a spot.
    pub beams: BeamTuning,
    /// Exactly two bounces.
    pub two_bounce: TwoBounceTuning,
    /// Walks onward from a vertex.
    pub walk: WalkTuning,
    /// Vertices that the pixels of a tile share.
    pub path_reuse: PathReuseTuning,
    /// Images of spots in planar near-mirrors.
    pub mirrors: MirrorTuning,
    /// Near-mirrors that gather points aim at.
    pub reflectors: ReflectorTuning,
    /// Light paths by near-mirrors.
    pub caustics: CausticTuning,
    /// Light paths near spots that are close to other surfaces.
    pub contacts: ContactTuning,
    /// Ellipsoidal connections for narrow gates.
    pub ellipsoid: EllipsoidTuning,
    /// Light that glass turns.
    pub glass: GlassTuning,
    /// Rounds of passes, and tiles.
    pub rounds: RoundTuning,
    /// The error estimate.
    pub error: ErrorTuning,
}
