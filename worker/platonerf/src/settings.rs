//! The settings for fitting networks to a scene. The defaults are the paper's for its simulated
//! scenes.

use picofarm_reconstruct::{ReconstructError, Reconstructed};
use picofarm_settings::{GridSettings, MlpSettings, ShadowLoss, Shadows};
use serde::Serialize;

/// Returns the settings of the grid on which networks are sampled. It has no planes, and the
/// networks themselves learn from shadows. Its evidence comes from carving.
pub fn grid(settings: GridSettings) -> GridSettings {
    GridSettings {
        planes: false,
        shadows: Shadows::Carve,
        ..settings
    }
}

/// The settings of a fit. Lengths are metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Settings {
    /// The width of the layers.
    pub width: usize,
    /// The number of layers before the density. The encoded position is joined again after the
    /// middle one.
    pub layers: usize,
    /// The number of stratified samples of a ray, for the coarse network.
    pub coarse: usize,
    /// The number of further samples of a ray where the coarse network has matter; the fine network
    /// uses both.
    pub fine: usize,
    /// The start of samples, metres from the origin of a ray.
    pub near_m: f32,
    /// The end of samples of camera rays, metres. Samples of light paths end at the spot.
    pub far_m: f32,
    /// The divisor of lengths in the losses, metres: the paper's gate.
    pub scale_m: f32,
    /// The weight of the distances in stage 2; each mean of transmittances has the weight 1.
    pub distance_weight: f32,
    /// Stage 2's comparison of transmittances.
    pub shadow_loss: ShadowLoss,
    /// The number of steps of stage 1: distances of lit pixels.
    pub distance_steps: u32,
    /// The number of steps of stage 2: distances and shadows.
    pub shadow_steps: u32,
    /// The number of rays of a step.
    pub batch: usize,
    /// Adam's learning rate at the first step.
    pub learning_rate: f64,
    /// The number of steps over which the learning rate decreases to a tenth.
    pub decay_steps: f64,
    /// The seed of weights, batches and samples.
    pub seed: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            width: 256,
            layers: 8,
            coarse: 64,
            fine: 128,
            near_m: 0.1,
            far_m: 6.0,
            scale_m: 15.0,
            distance_weight: 6000.0,
            shadow_loss: ShadowLoss::Squares,
            distance_steps: 24_999,
            shadow_steps: 175_001,
            batch: 1024,
            learning_rate: 5e-4,
            decay_steps: 500_000.0,
            seed: 0,
        }
    }
}

impl Settings {
    /// Returns the settings from those of a job or command. Camera rays end at the diagonal of the
    /// box of [`grid`], because no visible surface is farther away.
    pub fn of(asked: &MlpSettings, start: &Reconstructed, seed: u64) -> Self {
        let paper = Self {
            width: asked.width as usize,
            batch: asked.batch as usize,
            shadow_loss: asked.shadow_loss,
            far_m: (start.field.end() - start.field.origin).length(),
            seed,
            ..Self::default()
        };
        paper.with_steps(asked.steps)
    }

    /// Sets the total number of steps: an eighth for stage 1, as in the paper.
    #[must_use]
    pub fn with_steps(self, steps: u32) -> Self {
        let distance_steps = steps / 8;
        Self {
            distance_steps,
            shadow_steps: steps - distance_steps,
            ..self
        }
    }

    /// Returns the number of steps of both stages.
    pub fn steps(&self) -> u32 {
        self.distance_steps.saturating_add(self.shadow_steps)
    }

    /// Returns the learning rate of a step, counted from 0.
    pub fn rate(&self, step: u32) -> f64 {
        self.learning_rate * libm::pow(0.1, f64::from(step) / self.decay_steps)
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] naming the first setting out of range.
    pub fn check(&self) -> Result<(), ReconstructError> {
        for (field, value, least, most) in [
            ("width", self.width, 1, 4096),
            ("layers", self.layers, 2, 64),
            ("coarse", self.coarse, 4, 4096),
            ("fine", self.fine, 1, 4096),
            ("batch", self.batch, 1, 1 << 20),
            ("steps", self.steps() as usize, 1, 100_000_000),
        ] {
            if !(least..=most).contains(&value) {
                let what = format!("is {value}, expected {least} to {most}");
                return Err(invalid(field, what));
            }
        }
        let lengths = self.near_m > 0.0 && self.near_m < self.far_m && self.far_m.is_finite();
        if !lengths {
            let what = format!(
                "is {} m to {} m, expected 0 < near_m < far_m",
                self.near_m, self.far_m
            );
            return Err(invalid("near_m", what));
        }
        for (field, value) in [
            ("scale_m", f64::from(self.scale_m)),
            ("distance_weight", f64::from(self.distance_weight)),
            ("learning_rate", self.learning_rate),
            ("decay_steps", self.decay_steps),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(invalid(field, format!("is {value}, expected more than 0")));
            }
        }
        Ok(())
    }
}

pub(crate) fn invalid(field: &str, what: impl Into<String>) -> ReconstructError {
    ReconstructError::Invalid {
        field: field.to_owned(),
        what: what.into(),
    }
}
