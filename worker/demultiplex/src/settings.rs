//! Every constant of the method.

use serde::{Deserialize, Serialize};

/// How shadows are judged.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Shading {
    /// By a few rules: geometry, and a logistic regression with 20 numbers over light.
    Physics,
    /// By boosted trees over what the physics knows, learnt from rendered rooms.
    #[default]
    Learned,
}

/// How a capture is taken apart. The defaults were chosen on furnished rooms with seeds from 92001
/// on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Least range that is tried, metres.
    pub nearest_m: f32,
    /// Greatest range that is tried, metres.
    pub farthest_m: f32,
    /// Step between ranges, bins.
    pub step_bins: f32,
    /// Bins narrower than this are summed, metres of path: a pixel's own width spreads its peaks.
    pub finest_m: f64,
    /// Half width of the opening that gives the slow background, metres of path.
    pub slow_m: f32,
    /// Which greatest bin of a pixel is called strong; with few spots half their number.
    pub top_rank: usize,
    /// Share of the strong bin below which nothing stands out.
    pub floor: f32,
    /// Most that a bin may stand out, in natural logarithms.
    pub most_out: f32,
    /// Sum of what stands out from which on a pixel counts in full, with 16 spots and more; pixels
    /// with less leave more to their neighbours.
    pub full_score: f32,
    /// Semi-global matching: cost of one step of range between neighbours.
    pub step_cost: f32,
    /// Semi-global matching: cost of any leap.
    pub leap_cost: f32,
    /// Slanted planes: rounds over the image.
    pub plane_rounds: u32,
    /// Slanted planes: half width of the window, pixels.
    pub plane_reach: usize,
    /// Scores below this count as nothing: such a pixel takes its neighbours' surface.
    pub weak_score: f32,
    /// Share of a pixel's light by which its first light counts as come.
    pub early_share: f32,
    /// Bins by which light may come too early: a pixel's own width spreads its first light.
    pub early_bins: f32,
    /// Cost of a surface so far away that light comes too early.
    pub early_cost: f32,
    /// Metres beyond the farthest possible range over which that cost grows to its full.
    pub early_slack_m: f32,
    /// Usual distance from a surface to the farthest possible range, metres: where no neighbour's
    /// surface is possible.
    pub early_gap_m: f32,
    /// Rounds depth → shadows → depth.
    pub rounds: u32,
    /// Whether a wide pulse is removed. It is read at the times that the calibration states, so
    /// that a wrong calibration looks less wrong without it.
    #[serde(skip_serializing_if = "Clone::clone")]
    pub remove_pulse: bool,
    /// How shadows are judged.
    pub shadows: Shading,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            nearest_m: 0.3,
            farthest_m: 6.6,
            step_bins: 0.65,
            finest_m: 0.0384,
            slow_m: 0.154,
            top_rank: 12,
            floor: 0.3,
            most_out: 2.0,
            full_score: 6.0,
            step_cost: 0.15,
            leap_cost: 1.5,
            plane_rounds: 3,
            plane_reach: 3,
            weak_score: 0.4,
            early_share: 0.01,
            early_bins: 1.5,
            early_cost: 0.5,
            early_slack_m: 0.2,
            early_gap_m: 0.1,
            rounds: 1,
            remove_pulse: true,
            shadows: Shading::Learned,
        }
    }
}
