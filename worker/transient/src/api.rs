//! The input and the output of a render. Images are row-major `[row][column]`; histograms are
//! `[row][column][bin]`; per-spot images are `[spot][row][column]`.

use picofarm_scene::Spot;
pub use picofarm_settings::{BeamWidth, Budget, Gate, Optics, Strategy, Wavelength};
use serde::{Deserialize, Serialize};

/// Version of the rendered values. It is part of every task key, so change it whenever any output
/// bit may change.
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
    /// Adds the analytic one-bounce peaks to the histogram.
    pub one_bounce: bool,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Keeps the two-bounce and 3+ parts with their standard errors.
    pub split: bool,
    /// Groups of beams, by index, that get histograms of their own from the same pass: subsets of a
    /// grid, or each beam alone.
    #[serde(default)]
    pub groups: Vec<Vec<u32>>,
    /// The techniques to render with.
    #[serde(default)]
    pub strategy: Strategy,
    /// The optics of laser and pixels.
    #[serde(flatten)]
    pub optics: Optics,
}

impl Settings {
    /// Returns settings without options: all bounces but the analytic one-bounce peaks, whole
    /// pixels, beams without a width, seed 0.
    ///
    /// # Examples
    /// ```
    /// use picofarm_transient::{Budget, Gate, Optics, Settings};
    ///
    /// let gate = Gate { start_m: 1.0, bin_width_m: 0.0384, bins: 637 };
    /// let settings = Settings {
    ///     max_bounces: Some(2),
    ///     ..Settings::new(gate, Budget::Samples(16))
    /// };
    /// assert_eq!(settings.optics, Optics::default());
    /// ```
    pub fn new(gate: Gate, budget: Budget) -> Self {
        Self {
            gate,
            budget,
            max_bounces: None,
            one_bounce: false,
            seed: 0,
            split: false,
            groups: vec![],
            strategy: Strategy::default(),
            optics: Optics::default(),
        }
    }
}

/// Receives the progress of a render and may end it.
pub trait Progress: Sync {
    /// Receives the share done in [0, 1], from any thread and not necessarily increasing. Returns
    /// `false` to stop the render.
    fn at(&self, done: f32) -> bool;
}

/// A [`Progress`] that never stops the render.
pub(crate) struct Unstopped;

impl Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

/// A stop request, polled between steps and within long ones. A step that was cut short returns an
/// unusable result, so the caller discards it and ends with [`Stop::check`].
#[derive(Clone, Copy)]
pub(crate) struct Stop<'a>(pub &'a dyn Progress);

impl Stop<'_> {
    /// Returns whether the render should stop.
    pub fn asked(self) -> bool {
        !self.0.at(0.0)
    }

    /// Returns [`RenderError::Stopped`] if the render should stop.
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
    /// h(p, b), multiplexed over the spots: `[row][col][bin]`, radiance per pulse energy (1/(m²
    /// sr)).
    pub transient: Vec<f32>,
    /// The parts, if [`Settings::split`] is set.
    pub split: Option<Split>,
    /// The histograms of [`Settings::groups`], each in the layout of `transient`.
    pub groups: Vec<Vec<f32>>,
    /// Ground truth from the same rays.
    pub truth: GroundTruth,
    /// The spots, world space, in the order of the scene's beams; `None` if a beam hits nothing.
    pub spots: Vec<Option<Spot>>,
    /// The energy outside the gate.
    pub overflow: Overflow,
    /// The estimated noise.
    pub error: ErrorEstimate,
    /// The decisions of the renderer and the reasons for them.
    pub plan: Plan,
    /// Rays traced.
    pub rays: u64,
    /// The reason for an image without light, if it has none. It is also in `warnings`.
    pub dark: Option<String>,
    /// Warnings for the user: beams that hit nothing, an image without light. They are not stored,
    /// because they can be derived from the stored data.
    pub warnings: Vec<String>,
}

/// The exactly-two-bounce part and the 3+ part with standard errors, each `[row][col][bin]`.
#[derive(Debug, Clone)]
pub struct Split {
    /// Exactly two bounces.
    pub two: Vec<f32>,
    /// Its standard error.
    pub two_se: Vec<f32>,
    /// A draw of its error: the square of any weighted sum of it estimates the variance of that sum
    /// of `two`. A path's contribution falls into one bin or the next, so sums over bins have a far
    /// smaller error than `two_se` alone suggests.
    pub two_noise: Vec<f32>,
    /// Three bounces and more.
    pub multi: Vec<f32>,
    /// Its standard error.
    pub multi_se: Vec<f32>,
    /// A draw of its error, including correlations between pixels and bins: the square of any
    /// weighted sum of it estimates the variance of that sum of `multi`, which `multi_se` alone
    /// cannot. Both parts are independent: for sums of `two` and `multi` together the two squares
    /// add up.
    pub multi_noise: Vec<f32>,
}

/// Ground truth. Depth, range, normal, indices and masks are for the ray through the pixel's
/// centre.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundTruth {
    /// z-depth, metres; 0 if the ray leaves the scene.
    pub depth: Vec<f32>,
    /// Distance along the ray, metres; 0 if the ray leaves the scene.
    pub range: Vec<f32>,
    /// Unit normals facing the camera, camera frame, `[row][col][3]`.
    pub normal: Vec<f32>,
    /// Object index + 1; 0 = nothing.
    pub instance: Vec<u32>,
    /// Label index + 1; 0 = nothing.
    pub label: Vec<u16>,
    /// 1 if the first surface is a mirror (see `Material::is_specular`).
    pub specular: Vec<u8>,
    /// `[spot][row][col]`: 1 = lit: the segment from the spot to the surface point is free and both
    /// face it.
    pub visibility: Vec<u8>,
    /// Companion image, linear RGB in [0, 1], `[row][col][3]`.
    pub rgb: Vec<f32>,
}

/// Energy outside the gate, in the units of the histogram summed over pixels and bins. It is a
/// lower bound if the plan reports a narrow gate ([`Strategy::ellipsoidal`]).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Overflow {
    /// Energy dropped.
    pub energy: f64,
    /// The dropped energy as a share of all sampled energy.
    pub share: f64,
}

/// The noise of a render, estimated from the variance between passes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorEstimate {
    /// Median over pixels of ‖error‖₂ / ‖h‖₂ over the bins, without one-bounce light. If the errors
    /// of a pixel's bins are correlated, most pixels have an error below ‖standard error‖₂ and a
    /// few have a much larger one. The median of the standard errors is therefore corrected by
    /// draws of the errors of one pixel in nine. Neighbouring pixels share vertices, so their
    /// errors are correlated, and sums over them have larger errors than independent pixels would.
    pub median_relative: f32,
    /// The same, 95th percentile.
    pub p95_relative: f32,
    /// Standard error of the total energy / total energy, including correlations between pixels.
    pub total_relative: f32,
    /// The uncertainty of `total_relative`: the relative standard error of its square, from the
    /// fourth moment of the passes, as far as it exceeds that of normally distributed passes. It is
    /// near 0 if passes scatter normally, and near 1 if a single bright path dominates the
    /// variance.
    #[serde(default)]
    pub total_uncertainty: f32,
    /// Camera paths per pixel.
    pub samples: u32,
}

/// The renderer's decisions for this scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Strategies used, e.g. `two-bounce deterministic 4x4`, `mirror images: 2 planar mirrors`.
    pub strategies: Vec<String>,
    /// The approximations and noise sources in this scene, in words; empty if there are none.
    pub approximations: Vec<String>,
}

/// The reason why a render stopped.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The scene or a setting is unusable.
    #[error("{field}: {what}")]
    Invalid {
        /// The field, e.g. `gate.bin_width_m`.
        field: String,
        /// The expected value and how to correct the field.
        what: String,
    },
    /// The scene is unusable.
    #[error(transparent)]
    Scene(#[from] picofarm_scene::SceneError),
    /// There is not enough memory for the histograms.
    #[error("{what} take {gib:.1} GiB of memory, which this process does not get")]
    Memory {
        /// The buffers in question.
        what: String,
        /// Their size, GiB.
        gib: f64,
    },
    /// [`Progress::at`] requested a stop.
    #[error("render stopped on request")]
    Stopped,
}
