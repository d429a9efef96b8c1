//! Converts scenes to inputs and true outputs of networks: normalisation, rebinning, shadow
//! transients, flips. The formulas are those of Shoot-Bounce-3D: section 4, appendices A.1 and B.

mod batch;
mod normalise;

pub use picofarm_settings::{EvidenceForm, ShadowVariant, Target};
use serde::{Deserialize, Serialize};

pub(crate) use batch::example_of;
pub use batch::{Batch, Visit, example};
pub use normalise::{intensity, merged, planes, planes_of};

use crate::{ModelError, net::NetSpec};

/// The scaling of histograms (appendix B).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Normalise {
    /// (h − min)/(max − min) for each pixel; a histogram of equal values gives zeros.
    #[default]
    MinMax,
    /// clip((log10(h + 1e-8) + 8)/(log10 h_max + 8), 0, 1), with the greatest value of the data
    /// set.
    Log {
        /// The greatest value in the data set.
        greatest: f32,
    },
}

/// The divisor of depths in furnished rooms, metres.
pub const DEPTH_SCALE_M: f32 = 4.5;

fn of_rooms() -> f32 {
    DEPTH_SCALE_M
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_of_rooms(scale: &f32) -> bool {
    *scale == DEPTH_SCALE_M
}

/// The question that a network answers, and the form of its input.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Question {
    /// The quantity to predict.
    pub target: Target,
    /// For shadows: the form of the question.
    #[serde(default)]
    pub variant: ShadowVariant,
    /// The scaling of histograms.
    #[serde(default)]
    pub normalise: Normalise,
    /// The number of bins after rebinning.
    pub bins: usize,
    /// Whether the input is the time-integrated image instead of histograms.
    #[serde(default)]
    pub intensity_only: bool,
    /// For shadows: the number of spots of each scene.
    #[serde(default)]
    pub spots: usize,
    /// For depths: the divisor in metres that scales depths to 0..1.
    #[serde(default = "of_rooms", skip_serializing_if = "is_of_rooms")]
    pub depth_scale_m: f32,
    /// For [`ShadowVariant::Evidence`]: the planes of a spot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evidence: Option<EvidenceForm>,
}

impl Question {
    /// Returns the numbers of dense channels, one-hot channels and outputs of a network for this
    /// question.
    pub fn channels(&self) -> (usize, usize, usize) {
        let seen = if self.intensity_only { 1 } else { self.bins };
        match (self.target, self.variant) {
            (Target::Tof | Target::Specular, _) | (Target::Shadow, ShadowVariant::Difference) => {
                (seen, 0, 1)
            }
            (Target::Shadow, ShadowVariant::Concat) => (seen, self.bins, 1),
            (Target::Shadow, ShadowVariant::Index) => (seen + self.spots, 0, 1),
            (Target::Shadow, ShadowVariant::All) => (seen, 0, self.spots),
            (Target::Shadow, ShadowVariant::Evidence) => (self.planes(), 0, 1),
        }
    }

    /// Returns the name of this question's network in a combined checkpoint of the released code.
    pub fn part(&self) -> &'static str {
        match self.target {
            Target::Shadow => "shadow",
            Target::Tof | Target::Specular => "depth",
        }
    }

    /// Returns whether a scene is visited once for each spot.
    pub fn by_spot(&self) -> bool {
        self.target == Target::Shadow && self.variant != ShadowVariant::All
    }

    /// Returns whether the input is evidence, and no histogram.
    pub fn sees_evidence(&self) -> bool {
        self.target == Target::Shadow && self.variant == ShadowVariant::Evidence
    }

    /// Returns the number of planes of evidence of a spot.
    pub(crate) fn planes(&self) -> usize {
        self.evidence.as_ref().map_or(0, |form| form.planes.len())
    }

    /// Returns whether the input includes two-bounce times.
    pub fn timed(&self) -> bool {
        self.target == Target::Shadow && self.variant.is_timed()
    }

    /// Returns whether mirrored scenes may be used. They may not if spots are identified by their
    /// number, because a mirrored spot is at the position of another spot.
    pub fn may_flip(&self) -> bool {
        self.target != Target::Shadow || !self.variant.is_numbered()
    }

    /// Checks the question for consistency, and against the network.
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
        if self.sees_evidence() != (self.planes() > 0) || self.sees_evidence() != net.added {
            let what = "\"evidence\" has planes, the last of which is added to the output; other variants have none";
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
