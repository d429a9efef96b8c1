//! Settings of networks: targets, architectures and training (Shoot-Bounce-3D: section 4,
//! appendices A.1 and B, and the released code).

use serde::{Deserialize, Serialize};

/// The target of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// Depth, from which the times of two-bounce light follow.
    Tof,
    /// The pixels that each spot lights.
    Shadow,
    /// The pixels that are mirrors.
    Specular,
}

impl Target {
    /// Returns the name in a job file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tof => "tof",
            Self::Shadow => "shadow",
            Self::Specular => "specular",
        }
    }
}

/// The input of a shadow network for a spot (A.1). m is the measurement, and H_i is the spot's
/// shadow transient: its two-bounce times as a one-hot histogram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShadowVariant {
    /// m and H_i, concatenated, with a random spot at each visit.
    #[default]
    Concat,
    /// H_i − m|.
    Difference,
    /// m, and a plane for each spot, with ones for the requested spot.
    Index,
    /// m alone; predicts the masks of all spots at once.
    All,
    /// What a demultiplex stage knows of the spot. The output is added to the stage's log odds.
    Evidence,
}

impl ShadowVariant {
    /// Returns the name in a job file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Concat => "concat",
            Self::Difference => "difference",
            Self::Index => "index",
            Self::All => "all",
            Self::Evidence => "evidence",
        }
    }

    /// Returns whether the network uses two-bounce times.
    pub fn is_timed(self) -> bool {
        matches!(self, Self::Concat | Self::Difference)
    }

    /// Returns whether spots are known by their number, so that they must be at the same places in
    /// all scenes.
    pub fn is_numbered(self) -> bool {
        matches!(self, Self::Index | Self::All)
    }
}

/// The planes of evidence that a demultiplex stage stores for each spot, and that a network takes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvidenceForm {
    /// Version of the code that makes them.
    pub version: String,
    /// Names of the planes. The last has log odds of being lit.
    pub planes: Vec<String>,
}

impl EvidenceForm {
    /// Codes of the last plane for a difference of one in log odds.
    const STEPS: f32 = 16.0;
    /// The least code of log odds that are not negative.
    const MIDDLE: f32 = 128.0;

    /// Returns the code of log odds: sixteenths, limited to ±8.
    pub fn code(log_odds: f32) -> u8 {
        ((log_odds * Self::STEPS).floor() + Self::MIDDLE).clamp(0.0, 255.0) as u8
    }

    /// Returns the log odds that a code stands for: the middle of its sixteenth, which has the sign
    /// of what was coded.
    pub fn log_odds(code: u8) -> f32 {
        (f32::from(code) + 0.5 - Self::MIDDLE) / Self::STEPS
    }
}

/// The architectures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Architecture {
    /// Bins are channels (released code).
    #[default]
    Unet2d,
    /// Time is a dimension of the encoder; the decoder has none (appendix B).
    Unet25d,
    /// SwinIR: bins are channels, attention within windows (Liang et al., ICCVW 2021).
    Swinir,
    /// Learned feature embeddings: a volume of features, its maxima over time and their moments,
    /// and a network over those images (Chen et al., SIGGRAPH Asia 2020).
    Embeddings,
    /// NLOST: such a volume, attention in it within windows and over all of it, and a network over
    /// images (Li et al., CVPR 2023).
    Nlost,
}

impl Architecture {
    /// Returns the name in a job file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unet2d => "unet2d",
            Self::Unet25d => "unet25d",
            Self::Swinir => "swinir",
            Self::Embeddings => "embeddings",
            Self::Nlost => "nlost",
        }
    }
}

/// The transformer blocks of a SwinIR.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Swin {
    /// Residual groups: blocks, a convolution, and the input. The lightweight SwinIR has 4, the
    /// others 6.
    pub groups: u32,
    /// Blocks of a group. The windows of every second block are shifted by half a window.
    pub depth: u32,
    /// Heads of attention; must divide the width.
    pub heads: u32,
    /// Rows and columns of a window; must divide those of the images.
    pub window: u32,
}

impl Default for Swin {
    fn default() -> Self {
        Self {
            groups: 4,
            depth: 6,
            heads: 6,
            window: 8,
        }
    }
}

impl Swin {
    /// Checks that a network of `width` channels can be built from them.
    ///
    /// # Errors
    /// Returns the field below `net`, and a description of the fault.
    pub fn check(&self, width: usize) -> Result<(), (&'static str, String)> {
        for (field, value, least, most) in [
            ("swin.groups", self.groups, 1, 64),
            ("swin.depth", self.depth, 1, 64),
            ("swin.heads", self.heads, 1, 64),
            ("swin.window", self.window, 2, 64),
        ] {
            if !(least..=most).contains(&value) {
                return Err((field, format!("{value} lies outside {least}..={most}")));
            }
        }
        if !width.is_multiple_of(self.heads as usize) {
            let what = format!(
                "{width} is no multiple of the {} heads (swin.heads), which share it; 60 and 180 are usual",
                self.heads
            );
            return Err(("width", what));
        }
        Ok(())
    }
}

/// The form of the projection before the first level (appendix B only names a convolution to 128
/// channels).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StemForm {
    /// 3×3 convolution, batch norm, ReLU: the first half of a block.
    #[default]
    Block,
    /// 1×1 convolution with a bias, like the layer with that name in the released 2.5D network.
    Linear,
}

/// Whether the two streams of a 2.5D network, measurement and shadow transient, share their first
/// projection of time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeProjection {
    /// One layer for both (released code).
    #[default]
    Shared,
    /// A layer each.
    Each,
}

/// The number format of convolutions. All other values have 32 bits: weights, sums and moments of
/// their gradients, batch norms, losses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32 bits.
    #[default]
    F32,
    /// Inputs, weights and outputs, and their gradients, are rounded to bfloat16 (PyTorch's
    /// autocast). On a CPU only the rounding applies and it is no faster than f32. Products and
    /// sums have 32 bits there, as on tensor cores.
    Bf16,
}

/// The schedule of the learning rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// One cycle over the run's real length: from 1/25 of the rate up to the rate within the first
    /// hundredth of the steps, then down (PyTorch's `OneCycleLR`, cosine).
    #[default]
    Onecycle,
    /// One cycle over a million steps, whatever the length of the run, as in the released code.
    OnecyclePaper,
    /// From the rate to zero on half a cosine.
    Cosine,
    /// From the rate to zero on half a cosine, repeatedly, in cycles of increasing length (SGDR,
    /// Loshchilov and Hutter, ICLR 2017; PyTorch's `CosineAnnealingWarmRestarts`).
    Restarts,
    /// Constant.
    Constant,
}

#[cfg(test)]
mod tests {
    use super::EvidenceForm;

    #[test]
    fn codes_of_log_odds_keep_their_sign_and_are_near() {
        for odds in [-7.9f32, -1.0, -0.06, -1e-6, 0.0, 1e-6, 0.06, 1.0, 7.9] {
            let back = EvidenceForm::log_odds(EvidenceForm::code(odds));
            assert_eq!(back >= 0.0, odds >= 0.0, "{odds}: {back}");
            assert!((back - odds).abs() <= 0.032, "{odds}: {back}");
        }
        assert_eq!(EvidenceForm::code(-1e9), 0);
        assert_eq!(EvidenceForm::code(1e9), 255);
    }
}
