//! What goes into a render and what comes out of it. Images are row-major `[row][column]`; histograms
//! are `[row][column][bin]`; per-spot images are `[spot][row][column]`.

use picofarm_scene::Spot;
pub use picofarm_settings::{BeamWidth, Budget, Gate, Strategy, Wavelength};
use serde::{Deserialize, Serialize};

/// Version of the rendered values: part of every task key. Change it whenever any output bit may change.
pub const RENDERER_VERSION: &str = "transient-21";

/// Settings of one render.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// The gate.
    pub gate: Gate,
    /// Multi-bounce budget.
    pub budget: Budget,
    /// Longest path in bounces; `None` = until the gate ends. 2 renders no random walk.
    pub max_bounces: Option<u32>,
    /// Add the analytic one-bounce peaks to the histogram.
    pub one_bounce: bool,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Keep the two-bounce and 3+ parts with their standard errors.
    pub split: bool,
    /// Groups of beams, by index, of which histograms of their own are wanted from the same pass: subsets
    /// of a grid, or each beam alone.
    #[serde(default)]
    pub groups: Vec<Vec<u32>>,
    /// Ways of finding light.
    #[serde(default)]
    pub strategy: Strategy,
    /// The width of the laser's beams; without it they have none. Spots and ground truth are those of the beams' middles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beam: Option<BeamWidth>,
    /// Share of each pixel's area that is sensitive, 10⁻⁶ to 1: a square in its middle. Histograms are means over it; the
    /// ground truth is that of pixels' middles all the same.
    #[serde(default = "whole", skip_serializing_if = "is_whole")]
    pub fill_factor: f64,
    /// Wavelength of the laser. Without one, materials reflect what their [`picofarm_scene::Bsdf`] says.
    #[serde(default, skip_serializing_if = "Wavelength::is_none")]
    pub wavelengths_nm: Wavelength,
}

fn whole() -> f64 {
    1.0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_whole(share: &f64) -> bool {
    *share == 1.0
}

/// Called with the progress of a render; may end it.
pub trait Progress: Sync {
    /// Share done in [0, 1], from any thread, not necessarily increasing. Return `false` to stop the render.
    fn at(&self, done: f32) -> bool;
}

/// Nobody stops it.
pub(crate) struct Unstopped;

impl Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

/// Asks between steps, and within long ones, whether to stop. What is cut short by it is thrown away: whoever uses it
/// ends with [`Stop::check`].
#[derive(Clone, Copy)]
pub(crate) struct Stop<'a>(pub &'a dyn Progress);

impl Stop<'_> {
    /// Whether to stop.
    pub fn asked(self) -> bool {
        !self.0.at(0.0)
    }

    /// The same as an error.
    pub fn check(self) -> Result<(), RenderError> {
        match self.asked() {
            true => Err(RenderError::Stopped),
            false => Ok(()),
        }
    }
}

/// A finished render.
#[derive(Debug, Clone)]
pub struct Rendered {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// The gate.
    pub gate: Gate,
    /// h(p, b), multiplexed over the spots: `[row][col][bin]`, radiance per pulse energy (1/(m² sr)).
    pub transient: Vec<f32>,
    /// The parts, where asked for.
    pub split: Option<Split>,
    /// The histograms of [`Settings::groups`], each as `transient`.
    pub groups: Vec<Vec<f32>>,
    /// Ground truth from the same rays.
    pub truth: GroundTruth,
    /// The spots, world space, in the order of the scene's beams; `None` where a beam meets nothing.
    pub spots: Vec<Option<Spot>>,
    /// What fell outside the gate.
    pub overflow: Overflow,
    /// How noisy it is.
    pub error: ErrorEstimate,
    /// What was done and why.
    pub plan: Plan,
    /// Rays traced.
    pub rays: u64,
    /// Why no light is in the image, where there is none: one of `warnings`.
    pub dark: Option<String>,
    /// What somebody should know before trusting it: beams that meet nothing, an image without light. No part of what is
    /// stored: it says nothing that the stored data do not.
    pub warnings: Vec<String>,
}

/// The exactly-two-bounce part and the 3+ part with standard errors, each `[row][col][bin]`.
#[derive(Debug, Clone)]
pub struct Split {
    /// Exactly two bounces.
    pub two: Vec<f32>,
    /// Its standard error.
    pub two_se: Vec<f32>,
    /// A draw of its error: the square of any weighted sum of it estimates the variance of that sum of `two`. What a
    /// path brings falls into one bin or the next, so that sums over bins err far less than `two_se` alone says.
    pub two_noise: Vec<f32>,
    /// Three bounces and more.
    pub multi: Vec<f32>,
    /// Its standard error.
    pub multi_se: Vec<f32>,
    /// A draw of its error, with what pixels and bins have in common: the square of any weighted sum of
    /// it estimates the variance of that sum of `multi`, where `multi_se` alone cannot. Both parts are independent: for sums
    /// of `two` and `multi` together the two squares add up.
    pub multi_noise: Vec<f32>,
}

/// Ground truth. Depth and its kin are those of the ray through the pixel's centre.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundTruth {
    /// z-depth, metres; 0 where the ray leaves the scene.
    pub depth: Vec<f32>,
    /// Distance along the ray, metres; 0 likewise.
    pub range: Vec<f32>,
    /// Unit normals facing the camera, camera frame, `[row][col][3]`.
    pub normal: Vec<f32>,
    /// Object index + 1; 0 = nothing.
    pub instance: Vec<u32>,
    /// Label index + 1; 0 = nothing.
    pub label: Vec<u16>,
    /// 1 where the first surface is a mirror (see `Material::is_specular`).
    pub specular: Vec<u8>,
    /// `[spot][row][col]`: 1 = lit, the segment from spot to surface point is free and both face it.
    pub visibility: Vec<u8>,
    /// Companion image, linear RGB in [0, 1], `[row][col][3]`.
    pub rgb: Vec<f32>,
}

/// Energy outside the gate, same units as the histogram summed over pixels and bins. A lower bound where
/// the plan says that the gate is narrow ([`Strategy::ellipsoidal`]).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Overflow {
    /// Energy dropped.
    pub energy: f64,
    /// Share of all energy found.
    pub share: f64,
}

/// How noisy a render is, estimated from the variance between passes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorEstimate {
    /// Median over pixels of ‖error‖₂ / ‖h‖₂ over the bins (one bounce left out). Where bins of a pixel err together, most
    /// pixels err by less than ‖standard error‖₂ and few by much more, so the standard errors' median is corrected by draws of
    /// the errors of one pixel in nine. Pixels of a neighbourhood share vertices: their errors are alike, and sums over
    /// them err more than by chance.
    pub median_relative: f32,
    /// The same, 95th percentile.
    pub p95_relative: f32,
    /// Standard error of the total energy / total energy, with what pixels have in common.
    pub total_relative: f32,
    /// How far `total_relative` itself can be trusted: the relative standard error of its square, from the fourth moment
    /// of the passes, as far as it exceeds that of normal ones. Near 0 where passes scatter normally, near 1 where a single
    /// bright path holds the variance.
    #[serde(default)]
    pub total_uncertainty: f32,
    /// Camera paths of each pixel.
    pub samples: u32,
}

/// What the renderer decided for this scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Strategies used, e.g. `two-bounce deterministic 4x4`, `mirror images: 2 planar mirrors`.
    pub strategies: Vec<String>,
    /// What is approximated or noisy here, in words; empty if nothing.
    pub approximations: Vec<String>,
}

/// Why a render stopped.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The scene or a setting is unusable.
    #[error("{field}: {what}")]
    Invalid {
        /// Field, e.g. `gate.bin_width_m`.
        field: String,
        /// What was expected and how to correct it.
        what: String,
    },
    /// The scene is unusable.
    #[error(transparent)]
    Scene(#[from] picofarm_scene::SceneError),
    /// The histograms find no room in memory.
    #[error("{what} take {gib:.1} GiB of memory, which this process does not get")]
    Memory {
        /// What they are.
        what: String,
        /// How much they take.
        gib: f64,
    },
    /// [`Progress::at`] asked to stop.
    #[error("render stopped on request")]
    Stopped,
}
