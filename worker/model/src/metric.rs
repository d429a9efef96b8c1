//! How good answers are: of depths in metres, of masks as overlap.

use serde::{Deserialize, Serialize};

use crate::input::{DEPTH_SCALE_M, Target};

/// Sums over pixels, from which figures follow; sums of scenes add up.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Tally {
    pixels: f64,
    absolute: f64,
    squared: f64,
    both: f64,
    either: f64,
    said: f64,
    is: f64,
}

/// Figures of a network on a set of scenes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Metrics {
    /// Of z-depth.
    Depth {
        /// Mean absolute error, metres.
        mae_m: f64,
        /// Root mean square error, metres.
        rmse_m: f64,
    },
    /// Of a mask at a threshold of one half.
    Mask {
        /// Share of pixels that are wrong.
        mae: f64,
        /// Intersection over union; 1 where neither has any pixel.
        iou: f64,
        /// 2·both over the sum of both masks; 1 where neither has any pixel.
        f1: f64,
    },
}

impl Metrics {
    /// Less is better: MAE, or one less IoU.
    pub fn loss(&self) -> f64 {
        match self {
            Self::Depth { mae_m, .. } => *mae_m,
            Self::Mask { iou, .. } => 1.0 - iou,
        }
    }
}

impl Tally {
    /// Adds pixels: what a network said (depth over 4.5 m, or logits) and what is true.
    pub fn add(&mut self, target: Target, said: &[f32], truth: &[f32]) {
        self.pixels += said.len() as f64;
        for (said, truth) in said.iter().zip(truth) {
            match target {
                Target::Tof => {
                    let error = f64::from(said - truth) * f64::from(DEPTH_SCALE_M);
                    self.absolute += error.abs();
                    self.squared += error * error;
                }
                Target::Shadow | Target::Specular => {
                    let (said, is) = (*said > 0.0, *truth > 0.5);
                    self.both += f64::from(u8::from(said && is));
                    self.either += f64::from(u8::from(said || is));
                    self.said += f64::from(u8::from(said));
                    self.is += f64::from(u8::from(is));
                }
            }
        }
    }

    /// Adds another's.
    pub fn join(&mut self, other: &Self) {
        self.pixels += other.pixels;
        self.absolute += other.absolute;
        self.squared += other.squared;
        self.both += other.both;
        self.either += other.either;
        self.said += other.said;
        self.is += other.is;
    }

    /// The figures.
    pub fn metrics(&self, target: Target) -> Metrics {
        let n = self.pixels.max(1.0);
        let share = |part: f64, of: f64| if of > 0.0 { part / of } else { 1.0 };
        match target {
            Target::Tof => Metrics::Depth {
                mae_m: self.absolute / n,
                rmse_m: (self.squared / n).sqrt(),
            },
            Target::Shadow | Target::Specular => Metrics::Mask {
                mae: (self.either - self.both) / n,
                iou: share(self.both, self.either),
                f1: share(2.0 * self.both, self.said + self.is),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depths_are_measured_in_metres() {
        let mut tally = Tally::default();
        tally.add(Target::Tof, &[0.0, 1.0], &[1.0, 1.0]);
        let Metrics::Depth { mae_m, rmse_m } = tally.metrics(Target::Tof) else {
            panic!("a depth")
        };
        assert!((mae_m - 2.25).abs() < 1e-9 && (rmse_m - 4.5 / 2f64.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn masks_of_nothing_are_perfect_and_overlap_counts_otherwise() {
        let of = |said: &[f32], truth: &[f32]| {
            let mut tally = Tally::default();
            tally.add(Target::Shadow, said, truth);
            tally.metrics(Target::Shadow)
        };
        let perfect = Metrics::Mask {
            mae: 0.0,
            iou: 1.0,
            f1: 1.0,
        };
        assert_eq!(of(&[-1.0; 3], &[0.0; 3]), perfect);
        let half = Metrics::Mask {
            mae: 1.0 / 3.0,
            iou: 0.5,
            f1: 2.0 / 3.0,
        };
        assert_eq!(of(&[1.0, 1.0, -1.0], &[1.0, 0.0, 0.0]), half);
    }
}
