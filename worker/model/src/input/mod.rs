//! From scenes to what networks see and what they should say: normalisation, rebinning, shadow transients, flips.
//! Formulas are those of Shoot-Bounce-3D: section 4, appendices A.1 and B.

mod batch;
mod normalise;

pub use picofarm_settings::{ShadowVariant, Target};
use serde::{Deserialize, Serialize};

pub(crate) use batch::example_of;
pub use batch::{Batch, Visit, example};
pub use normalise::{intensity, merged, planes, planes_of};

use crate::{ModelError, net::NetSpec};

/// How histograms are scaled (appendix B).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Normalise {
    /// (h − min)/(max − min) of each pixel; an all-equal histogram gives zeros.
    #[default]
    MinMax,
    /// clip((log10(h + 1e-8) + 8)/(log10 h_max + 8), 0, 1), with the greatest value of the data set.
    Log {
        /// Greatest value in the data set.
        greatest: f32,
    },
}

/// By how many metres depths of furnished rooms are divided.
pub const DEPTH_SCALE_M: f32 = 4.5;

fn of_rooms() -> f32 {
    DEPTH_SCALE_M
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_of_rooms(scale: &f32) -> bool {
    *scale == DEPTH_SCALE_M
}

/// What is asked of a network, and how.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Question {
    /// What.
    pub target: Target,
    /// For shadows: how.
    #[serde(default)]
    pub variant: ShadowVariant,
    /// How histograms are scaled.
    #[serde(default)]
    pub normalise: Normalise,
    /// Bins after rebinning.
    pub bins: usize,
    /// The time-integrated image instead of histograms.
    #[serde(default)]
    pub intensity_only: bool,
    /// Spots of each scene; for shadows.
    #[serde(default)]
    pub spots: usize,
    /// By how many metres depths are divided, so that they lie within 0 to 1; for depths.
    #[serde(default = "of_rooms", skip_serializing_if = "is_of_rooms")]
    pub depth_scale_m: f32,
}

impl Question {
    /// Dense channels, one-hot channels, outputs of a network for it.
    pub fn channels(&self) -> (usize, usize, usize) {
        let seen = if self.intensity_only { 1 } else { self.bins };
        match (self.target, self.variant) {
            (Target::Tof | Target::Specular, _) | (Target::Shadow, ShadowVariant::Difference) => {
                (seen, 0, 1)
            }
            (Target::Shadow, ShadowVariant::Concat) => (seen, self.bins, 1),
            (Target::Shadow, ShadowVariant::Index) => (seen + self.spots, 0, 1),
            (Target::Shadow, ShadowVariant::All) => (seen, 0, self.spots),
        }
    }

    /// What a combined checkpoint of the released code calls the network for it.
    pub fn part(&self) -> &'static str {
        match self.target {
            Target::Shadow => "shadow",
            Target::Tof | Target::Specular => "depth",
        }
    }

    /// Whether a scene is visited once for each spot.
    pub fn by_spot(&self) -> bool {
        self.target == Target::Shadow && self.variant != ShadowVariant::All
    }

    /// Whether it is given two-bounce times.
    pub fn timed(&self) -> bool {
        self.target == Target::Shadow && self.variant.is_timed()
    }

    /// Whether mirrored scenes may be shown: not where spots are known by their number, because a mirrored spot is at
    /// another spot's place.
    pub fn may_flip(&self) -> bool {
        let numbered = matches!(self.variant, ShadowVariant::Index | ShadowVariant::All);
        self.target != Target::Shadow || !numbered
    }

    /// Checks it against itself and the network.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] naming the field.
    pub fn check(&self, net: &NetSpec) -> Result<(), ModelError> {
        if self.bins == 0 {
            return Err(ModelError::invalid("input.bins", "0 bins; give at least 1"));
        }
        if self.target == Target::Shadow && self.spots == 0 {
            let what = "the data set has no spots; shadows are asked spot by spot";
            return Err(ModelError::invalid("shadow", what));
        }
        if self.target == Target::Shadow
            && self.variant == ShadowVariant::Difference
            && self.intensity_only
        {
            let what = "\"difference\" needs histograms; use \"index\" with input.intensity_only";
            return Err(ModelError::invalid("shadow.variant", what));
        }
        let (dense, one_hot, outputs) = self.channels();
        if (net.dense, net.one_hot, net.outputs) != (dense, one_hot, outputs) {
            let what = format!(
                "the network has {} + {} inputs and {} outputs, the target wants {dense} + {one_hot} and {outputs}",
                net.dense, net.one_hot, net.outputs
            );
            return Err(ModelError::invalid("net", what));
        }
        Ok(())
    }
}
