//! Rounds, tiles and the error estimate.

use serde::{Deserialize, Serialize};

/// Rounds of passes, and tiles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RoundTuning {
    /// Passes of the first round of `Budget::Error`, the fewest that give an error estimate. With 4
    /// passes, large images of many spots ended at 6.8 to 8.6 % with a target of 10 %.
    pub first_passes: u32,
    /// Fraction of the progress that the first round counts for.
    pub first_share: f32,
    /// Maximum length of a round of a time-bound render, in multiples of all rounds before it,
    /// because each round predicts the time of the next.
    pub growth: u32,
    /// Fraction of the remaining time that a round is planned for.
    pub timed: f64,
    /// Passes of light paths if no other passes are made.
    pub alone_passes: u32,
    /// Side of a tile in a large image, pixels. A larger tile cuts fewer of the squares that share
    /// vertices at its edges, and takes more memory.
    pub large_tile: u32,
    /// Side of a tile in a small image, or in one with many histograms per pixel.
    pub small_tile: u32,
    /// Pixels from which an image is large.
    pub large_image: usize,
    /// Histograms per pixel from which there are many.
    pub many_histograms: usize,
    /// Sampled tiles of a forecast, along each side of the image.
    pub forecast_tiles: u32,
    /// Passes over the sampled tiles.
    pub forecast_passes: u32,
}

impl Default for RoundTuning {
    fn default() -> Self {
        Self {
            first_passes: 2,
            first_share: 0.3,
            growth: 3,
            timed: 0.85,
            alone_passes: 64,
            large_tile: 32,
            small_tile: 16,
            large_image: 1 << 16,
            many_histograms: 5,
            forecast_tiles: 3,
            forecast_passes: 8,
        }
    }
}

/// The error estimate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ErrorTuning {
    /// Bins on either side over which the variance of the 3+ part is pooled.
    pub multi_reach: usize,
    /// The same for the two-bounce part.
    pub two_reach: usize,
    /// Fraction of a pixel's mean variance added to every bin, for paths that might have arrived
    /// and did not.
    pub floor: f32,
    /// Weight of a bin's own sample variance, because edges and peaks differ from their neighbours.
    /// Without it the brightest bins deviate by 1.25 to 1.4 of the stored error.
    pub own: f32,
    /// Exponent with which error² × passes of the 3+ part rises with the passes in the median over
    /// pixels, stated or true. After few passes, most pixels have not yet received rare bright
    /// paths. From 4 to 64 passes the exponent was 0.08 to 0.16 in rooms of 1 to 100 spots.
    pub rise: f64,
    /// The rise is extrapolated up to this multiple of the passes: with 4, one class of rooms ended
    /// at 8.5 % with a target of 10 %; without a bound, at 7.4 %.
    pub most_rise: f64,
}

impl Default for ErrorTuning {
    fn default() -> Self {
        Self {
            multi_reach: 3,
            two_reach: 1,
            floor: 0.003,
            own: 0.5,
            rise: 0.13,
            most_rise: 2.0,
        }
    }
}
