//! Settings of a scene's reconstruction.

use serde::{Deserialize, Serialize};

/// Most nodes along the longest side of the grid.
pub const MOST_NODES: u32 = 512;

/// The use of shadow masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Shadows {
    /// Shadow masks are ignored: space outside the camera's view is empty.
    Ignore,
    /// Carving alone.
    Carve,
    /// Carving, then optimisation.
    #[default]
    Optimise,
}

/// The representation of the room's density.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FieldKind {
    /// A grid: seconds.
    #[default]
    Grid,
    /// PlatoNeRF's networks, sampled on the grid, as the oracle. Minutes to days.
    Mlp,
}

/// The loss between the networks' transmittances and shadow masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShadowLoss {
    /// Mean squares, as in the paper.
    #[default]
    Squares,
    /// Cross-entropy, which has a gradient even for a lit ray with no light left.
    CrossEntropy,
}

/// Settings of PlatoNeRF's networks. Their seed is the grid's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MlpSettings {
    /// Steps, an eighth of them on distances alone. 200,000 by default, as in the paper.
    pub steps: u32,
    /// Width of the layers.
    pub width: u32,
    /// Rays of a step.
    pub batch: u32,
    /// The loss between transmittances and shadow masks.
    pub shadow_loss: ShadowLoss,
}

impl Default for MlpSettings {
    fn default() -> Self {
        Self {
            steps: 200_000,
            width: 256,
            batch: 1024,
            shadow_loss: ShadowLoss::Squares,
        }
    }
}

impl MlpSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// Returns the setting, and a description of the fault.
    pub fn check(&self) -> Result<(), (&'static str, String)> {
        within(&[
            ("steps", self.steps, 8, 100_000_000),
            ("width", self.width, 8, 1024),
            ("batch", self.batch, 1, 65_536),
        ])
    }
}

fn within(all: &[(&'static str, u32, u32, u32)]) -> Result<(), (&'static str, String)> {
    for &(field, value, least, most) in all {
        if !(least..=most).contains(&value) {
            return Err((field, format!("is {value}, choose {least} to {most}")));
        }
    }
    Ok(())
}

/// Settings of a reconstruction on a grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GridSettings {
    /// Nodes along the longest side of the grid, 16 to [`MOST_NODES`]. 192 by default; 256 is fine.
    pub nodes: u32,
    /// Whether planes close the room outside the camera's view.
    pub planes: bool,
    /// The use of shadow masks.
    pub shadows: Shadows,
    /// Most iterations of the optimisation, which ends once held-out rays show that more do not
    /// help.
    pub iterations: u32,
    /// Rays of an iteration.
    pub batch: u32,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Whether to continue if the measurements contradict one another.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub accept_inconsistent: bool,
}

impl Default for GridSettings {
    fn default() -> Self {
        Self {
            nodes: 192,
            planes: true,
            shadows: Shadows::Optimise,
            iterations: 200,
            batch: 16_384,
            seed: 0,
            accept_inconsistent: false,
        }
    }
}

impl GridSettings {
    /// Number of nodes for quality instead of speed.
    pub const FINE_NODES: u32 = 256;

    /// Checks the ranges.
    ///
    /// # Errors
    /// Returns the setting, and a description of the fault.
    pub fn check(&self) -> Result<(), (&'static str, String)> {
        within(&[
            ("nodes", self.nodes, 16, MOST_NODES),
            ("iterations", self.iterations, 1, 100_000),
            ("batch", self.batch, 1, 1 << 22),
        ])
    }
}
