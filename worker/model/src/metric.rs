//! The metrics of answers: errors of depths in metres, and overlap of masks.

mod boundary;

use serde::{Deserialize, Serialize};

use crate::input::{Question, Target};

/// The number of masks that the released code scores together.
const BATCH: usize = 32;

/// Sums over pixels, from which metrics are computed. The sums of several scenes are joined in the
/// scenes' order.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Tally {
    pixels: u64,
    absolute: f64,
    squared: f64,
    /// The sum of the images' boundary F1, and the number of images.
    boundary: f64,
    images: u64,
    masks: Vec<Overlap>,
}

/// The pixel counts of a predicted mask and of the true mask.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Overlap {
    both: u64,
    said: u64,
    is: u64,
    of: u64,
}

/// The metrics of a network on a set of scenes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Metrics {
    /// Metrics of z-depth.
    Depth {
        /// The mean absolute error, metres.
        mae_m: f64,
        /// The root mean square error, metres.
        rmse_m: f64,
    },
    /// Metrics of a mask at a threshold of one half.
    Mask {
        /// The share of wrong pixels.
        mae: f64,
        /// Intersection over union; 1 if neither mask has a pixel.
        iou: f64,
        /// 2·both over the sum of both masks; 1 if neither mask has a pixel.
        f1: f64,
    },
}

/// Metrics by the formulas of the code released with Shoot-Bounce-3D, if they differ from
/// [`Metrics`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Released {
    /// Metrics of z-depth.
    Depth {
        /// The scale-invariant boundary F1 (Depth Pro, section 3.3), averaged over images.
        boundary_f1: f64,
    },
    /// Metrics of masks. They are computed for 32 masks together, in the order of scenes and then
    /// of spots, and averaged over these batches. Two masks without any pixel have an overlap of 0.
    Mask {
        /// The share of wrong pixels.
        mae_32: f64,
        /// Intersection over union.
        iou_32: f64,
        /// 2·both over the sum of both masks.
        f1_32: f64,
    },
}

impl Metrics {
    /// Returns a loss: MAE, or 1 − IoU. A smaller loss is better.
    pub fn loss(&self) -> f64 {
        match self {
            Self::Depth { mae_m, .. } => *mae_m,
            Self::Mask { iou, .. } => 1.0 - iou,
        }
    }

    /// Returns each metric with its name.
    pub fn figures(&self) -> Vec<(&'static str, f64)> {
        match *self {
            Self::Depth { mae_m, rmse_m } => vec![("mae_m", mae_m), ("rmse_m", rmse_m)],
            Self::Mask { mae, iou, f1 } => vec![("mae", mae), ("iou", iou), ("f1", f1)],
        }
    }
}

impl Released {
    /// Returns each metric with its name.
    pub fn figures(&self) -> Vec<(&'static str, f64)> {
        match *self {
            Self::Depth { boundary_f1 } => vec![("boundary_f1", boundary_f1)],
            Self::Mask {
                mae_32,
                iou_32,
                f1_32,
            } => vec![("mae_32", mae_32), ("iou_32", iou_32), ("f1_32", f1_32)],
        }
    }
}

impl Tally {
    /// Adds images of `height` rows and `width` columns, `[image][row][column]`: a network's
    /// outputs (depth over the question's scale, or logits) and the truth.
    pub fn add(
        &mut self,
        question: &Question,
        said: &[f32],
        truth: &[f32],
        [height, width]: [usize; 2],
    ) {
        self.pixels += said.len() as u64;
        let images = said
            .chunks_exact(height * width)
            .zip(truth.chunks_exact(height * width));
        for (said, truth) in images {
            self.images += 1;
            match question.target {
                Target::Tof => {
                    let scale_m = f64::from(question.depth_scale_m);
                    for (said, truth) in said.iter().zip(truth) {
                        let error = f64::from(said - truth) * scale_m;
                        self.absolute += error.abs();
                        self.squared += error * error;
                    }
                    self.boundary += boundary::boundary_f1(said, truth, width);
                }
                Target::Shadow | Target::Specular => {
                    let mut mask = Overlap {
                        of: said.len() as u64,
                        ..Overlap::default()
                    };
                    for (said, truth) in said.iter().zip(truth) {
                        let (said, is) = (*said > 0.0, *truth > 0.5);
                        mask.both += u64::from(said && is);
                        mask.said += u64::from(said);
                        mask.is += u64::from(is);
                    }
                    self.masks.push(mask);
                }
            }
        }
    }

    /// Adds the tally of the images that follow these.
    pub fn join(&mut self, other: &Self) {
        self.pixels += other.pixels;
        self.absolute += other.absolute;
        self.squared += other.squared;
        self.boundary += other.boundary;
        self.images += other.images;
        self.masks.extend_from_slice(&other.masks);
    }

    /// Computes the metrics.
    pub fn metrics(&self, target: Target) -> Metrics {
        let n = self.pixels.max(1) as f64;
        match target {
            Target::Tof => Metrics::Depth {
                mae_m: self.absolute / n,
                rmse_m: (self.squared / n).sqrt(),
            },
            Target::Shadow | Target::Specular => {
                let [mae, iou, f1] = Overlap::sum(&self.masks).figures(1.0);
                Metrics::Mask { mae, iou, f1 }
            }
        }
    }

    /// Computes the metrics by the released code's formulas.
    pub fn released(&self, target: Target) -> Released {
        match target {
            Target::Tof => Released::Depth {
                boundary_f1: self.boundary / self.images.max(1) as f64,
            },
            Target::Shadow | Target::Specular => {
                let each: Vec<[f64; 3]> = self
                    .masks
                    .chunks(BATCH)
                    .map(|batch| Overlap::sum(batch).figures(0.0))
                    .collect();
                let mean = |k: usize| {
                    each.iter().map(|figures| figures[k]).sum::<f64>() / each.len().max(1) as f64
                };
                Released::Mask {
                    mae_32: mean(0),
                    iou_32: mean(1),
                    f1_32: mean(2),
                }
            }
        }
    }
}

impl Overlap {
    /// Returns the sum of several masks' counts.
    fn sum(masks: &[Self]) -> Self {
        masks.iter().fold(Self::default(), |a, b| Self {
            both: a.both + b.both,
            said: a.said + b.said,
            is: a.is + b.is,
            of: a.of + b.of,
        })
    }

    /// Returns the share of wrong pixels, the intersection over union and F1. The latter two are
    /// `empty` if there is no pixel.
    fn figures(&self, empty: f64) -> [f64; 3] {
        let share = |part: u64, of: u64| match of {
            0 => empty,
            of => part as f64 / of as f64,
        };
        let sum = self.said + self.is;
        let wrong = (sum - 2 * self.both) as f64 / self.of.max(1) as f64;
        [
            wrong,
            share(self.both, sum - self.both),
            share(2 * self.both, sum),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(target: Target) -> Question {
        Question {
            target,
            variant: crate::input::ShadowVariant::default(),
            normalise: crate::input::Normalise::default(),
            bins: 1,
            intensity_only: false,
            spots: 1,
            depth_scale_m: 4.5,
            evidence: None,
        }
    }

    #[test]
    fn depths_are_measured_in_metres() {
        let mut tally = Tally::default();
        tally.add(&asked(Target::Tof), &[0.0, 1.0], &[1.0, 1.0], [1, 2]);
        let Metrics::Depth { mae_m, rmse_m } = tally.metrics(Target::Tof) else {
            panic!("a depth")
        };
        assert!((mae_m - 2.25).abs() < 1e-9 && (rmse_m - 4.5 / 2f64.sqrt()).abs() < 1e-9);
        let desktop = Question {
            depth_scale_m: 1.25,
            ..asked(Target::Tof)
        };
        let mut tally = Tally::default();
        tally.add(&desktop, &[0.0, 1.0], &[1.0, 1.0], [1, 2]);
        assert!((tally.metrics(Target::Tof).loss() - 0.625).abs() < 1e-9);
    }

    #[test]
    fn masks_of_nothing_are_perfect_and_overlap_counts_otherwise() {
        let of = |said: &[f32], truth: &[f32]| {
            let mut tally = Tally::default();
            tally.add(&asked(Target::Shadow), said, truth, [1, said.len()]);
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

    #[test]
    fn the_released_code_scores_masks_by_32_and_none_where_both_are_empty() {
        // 32 masks of two pixels, both right; then 16 that are empty in both; the two tallies are
        // joined.
        let mut tally = Tally::default();
        tally.add(&asked(Target::Shadow), &[1.0; 40], &[1.0; 40], [1, 2]);
        let mut rest = Tally::default();
        rest.add(&asked(Target::Shadow), &[1.0; 24], &[1.0; 24], [1, 2]);
        rest.add(&asked(Target::Shadow), &[-1.0; 32], &[0.0; 32], [1, 2]);
        tally.join(&rest);
        let expected = Released::Mask {
            mae_32: 0.0,
            iou_32: 0.5,
            f1_32: 0.5,
        };
        assert_eq!(tally.released(Target::Shadow), expected);
        assert!(matches!(tally.metrics(Target::Shadow), Metrics::Mask { iou, .. } if iou == 1.0));
    }
}
