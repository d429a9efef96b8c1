//! What a network learns, what it is built of and how it is trained (Shoot-Bounce-3D: section 4, appendices A.1 and B, and
//! the released code).

use serde::{Deserialize, Serialize};

/// What a network predicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// Depth, from which the times of two-bounce light follow.
    Tof,
    /// Which pixels each spot lights.
    Shadow,
    /// Which pixels are mirrors.
    Specular,
}

impl Target {
    /// Its name, as in a job file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tof => "tof",
            Self::Shadow => "shadow",
            Self::Specular => "specular",
        }
    }
}

/// How a shadow network is asked for a spot (A.1): with m the measurement and H_i the spot's two-bounce times as a one-hot
/// histogram, its shadow transient.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShadowVariant {
    /// m and H_i, side by side; a spot at random each visit.
    #[default]
    Concat,
    /// |H_i − m|.
    Difference,
    /// m, and a plane for each spot, all ones for the spot in question.
    Index,
    /// m alone; the masks of all spots at once.
    All,
}

impl ShadowVariant {
    /// Its name, as in a job file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Concat => "concat",
            Self::Difference => "difference",
            Self::Index => "index",
            Self::All => "all",
        }
    }

    /// Whether the network is given two-bounce times.
    pub fn is_timed(self) -> bool {
        matches!(self, Self::Concat | Self::Difference)
    }
}

/// The kinds of network.
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
    /// Learned feature embeddings: a volume of features, its greatest values over time and their moments, and a network over those
    /// images (Chen et al., SIGGRAPH Asia 2020).
    Embeddings,
    /// NLOST: such a volume, attention in it within windows and over all of it, and a network over images (Li et al., CVPR 2023).
    Nlost,
}

impl Architecture {
    /// Its name, as in a job file.
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
    /// Residual groups: blocks, a convolution, and what went in. The lightweight SwinIR has 4, the others 6.
    pub groups: u32,
    /// Blocks of a group; every second one's windows are shifted by half a window.
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
    /// Whether a network of `width` channels can be built of them.
    ///
    /// # Errors
    /// The field, below `net`, and what is wrong with it.
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

/// What the projection before the first level is (appendix B names a convolution to 128 channels and nothing more).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StemForm {
    /// 3×3 convolution, batch norm, ReLU: a first half of a block.
    #[default]
    Block,
    /// 1×1 convolution with a bias, as the layer of that name is in the released 2.5D network.
    Linear,
}

/// Whether the two streams of a 2.5D network, measurement and shadow transient, share their first projection of time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeProjection {
    /// One layer for both (released code).
    #[default]
    Shared,
    /// A layer each.
    Each,
}

/// Numbers in which convolutions are computed; all else is 32 bits: weights, their gradients' sums and moments, batch norms,
/// losses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32 bits.
    #[default]
    F32,
    /// Inputs, weights and outputs, and their gradients, are rounded to bfloat16 (PyTorch's autocast). On a processor this
    /// is rounding alone, no faster than f32: products and sums have 32 bits there as on tensor cores.
    Bf16,
}

/// How the learning rate changes with the steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// One cycle over the run's real length: from 1/25 of the rate up to it within the first hundredth of the steps, then
    /// down (PyTorch's `OneCycleLR`, cosine).
    #[default]
    Onecycle,
    /// One cycle over a million steps, however long the run is: what the released code does.
    OnecyclePaper,
    /// From the rate to zero on half a cosine.
    Cosine,
    /// From the rate to zero on half a cosine, again and again in cycles that become longer (SGDR, Loshchilov and Hutter, ICLR
    /// 2017; PyTorch's `CosineAnnealingWarmRestarts`).
    Restarts,
    /// The same all the time.
    Constant,
}
