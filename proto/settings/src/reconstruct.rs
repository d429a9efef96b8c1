//! How a scene is reconstructed.

use serde::{Deserialize, Serialize};

/// Most nodes along the longest side of the grid.
pub const MOST_NODES: u32 = 512;

/// How far light paths are believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Shadows {
    /// Not at all: what the camera does not see is empty.
    Ignore,
    /// Carving alone.
    Carve,
    /// Carving, then optimisation.
    #[default]
    Optimise,
}

/// What the density of the room is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FieldKind {
    /// A grid: seconds.
    #[default]
    Grid,
    /// PlatoNeRF's networks, sampled on the grid: the oracle. Minutes to days.
    Mlp,
}

/// What the networks compare transmittances and shadow masks by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShadowLoss {
    /// Mean squares, as the paper has them.
    #[default]
    Squares,
    /// Cross-entropy: a lit ray whose light is all stopped still has a gradient.
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
    /// What transmittances and shadow masks are compared by.
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
    /// The setting, and what is wrong with it.
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
    /// Close the room by planes where the camera does not look.
    pub planes: bool,
    /// What becomes of the shadow masks.
    pub shadows: Shadows,
    /// Iterations of the optimisation, at most: it ends once held-out rays say that more do not help.
    pub iterations: u32,
    /// Rays of an iteration.
    pub batch: u32,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Go on where the measurements contradict one another.
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
    /// The grid for quality rather than speed.
    pub const FINE_NODES: u32 = 256;

    /// Checks the ranges.
    ///
    /// # Errors
    /// The setting, and what is wrong with it.
    pub fn check(&self) -> Result<(), (&'static str, String)> {
        within(&[
            ("nodes", self.nodes, 16, MOST_NODES),
            ("iterations", self.iterations, 1, 100_000),
            ("batch", self.batch, 1, 1 << 22),
        ])
    }
}
