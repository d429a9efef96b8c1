//! Baselines that networks have to beat: the best constant, the peak of each pixel's histogram,
//! masks of one value, and images that are the same for all scenes.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::{
    ModelError,
    input::{Question, Target},
    scene::{Order, Scene, Scenes},
};

/// Answers without a network, fitted to training scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Baseline {
    /// Answers for depths.
    Depth(DepthBaseline),
    /// Answers for masks.
    Mask(MaskBaseline),
}

impl Baseline {
    /// Fits a baseline to the first `most` scenes.
    ///
    /// # Errors
    /// [`ModelError::Scene`]; [`ModelError::Invalid`] if there are no scenes or their sizes differ.
    pub fn fit(question: &Question, scenes: &dyn Scenes, most: usize) -> Result<Self, ModelError> {
        let target = question.target;
        Ok(match target {
            Target::Tof => Self::Depth(DepthBaseline::fit(question.depth_scale_m, scenes, most)?),
            Target::Shadow | Target::Specular => {
                Self::Mask(MaskBaseline::fit(target, scenes, most)?)
            }
        })
    }

    /// Returns the names of the baselines, in the order of `Baseline::answers`.
    pub fn names(&self) -> &'static [&'static str] {
        match self {
            Self::Depth(_) => &["constant", "peak", "median image"],
            Self::Mask(_) => &["all", "none", "mean mask"],
        }
    }

    /// Returns the baselines' answers for a scene, in the form of a network's output: depth over
    /// its scale, or logits of the masks from `plane` on.
    pub(crate) fn answers(
        &self,
        question: &Question,
        scene: &Scene,
        plane: usize,
        len: usize,
    ) -> Vec<Vec<f32>> {
        match self {
            Self::Depth(fit) => {
                let scaled = |z: f32| (z / question.depth_scale_m).clamp(0.0, 1.0);
                let peaks = fit.of_peaks(scene).into_iter().map(scaled).collect();
                let median = fit.median_m.iter().copied().map(scaled).collect();
                vec![vec![scaled(fit.constant_m as f32); len], peaks, median]
            }
            Self::Mask(fit) => {
                let at = plane * scene.pixels();
                let mean = fit.mask.iter().skip(at).take(len);
                let mean = mean.map(|&m| if m { 1.0 } else { -1.0 }).collect();
                vec![vec![1.0; len], vec![-1.0; len], mean]
            }
        }
    }
}

/// Masks without a network: each pixel of each spot's mask has its usual value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MaskBaseline {
    /// The mask: `[spot][row][column]`, or `[row][column]` for mirrors. A pixel is set if it is set
    /// in a large enough share of the training scenes; the share is the one with the greatest IoU
    /// on these scenes.
    pub mask: Vec<bool>,
}

impl MaskBaseline {
    fn fit(target: Target, scenes: &dyn Scenes, most: usize) -> Result<Self, ModelError> {
        let mut set: Vec<usize> = Vec::new();
        let count = scenes.len().min(most);
        for index in 0..count {
            let scene = load(scenes, index)?;
            let planes = match target {
                Target::Shadow => &scene.lit,
                Target::Tof | Target::Specular => &scene.specular,
            };
            if index == 0 {
                set = vec![0; planes.len()];
            }
            same_size(set.len(), planes.len(), index)?;
            for (sum, m) in set.iter_mut().zip(planes) {
                *sum += usize::from(*m > 0);
            }
        }
        // The number of pixels by the number of scenes in which they are set.
        let mut by_count = vec![0usize; count + 1];
        for &n in &set {
            by_count[n] += 1;
        }
        let all: usize = set.iter().sum();
        let (mut best, mut least) = (0.0, usize::MAX);
        let (mut both, mut said) = (0, 0);
        for n in (1..=count).rev() {
            both += n * by_count[n];
            said += count * by_count[n];
            let iou = both as f64 / (said + all - both).max(1) as f64;
            if iou > best {
                (best, least) = (iou, n);
            }
        }
        Ok(Self {
            mask: set.iter().map(|&n| n >= least).collect(),
        })
    }
}

/// Depths without a network, fitted to training scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DepthBaseline {
    /// The median depth, metres. No other constant has a smaller mean absolute error.
    pub constant_m: f64,
    /// The slope of a least-squares fit: z of a pixel = `slope` · ℓ · cos θ + `offset_m`, with ℓ
    /// the path length of the greatest bin of the pixel's histogram and θ the angle to the optical
    /// axis.
    pub slope: f64,
    /// The offset of the fit, metres; see `slope`.
    pub offset_m: f64,
    /// Each pixel's median depth, metres, `[row][column]`. No other image that is the same for all
    /// scenes has a smaller mean absolute error.
    pub median_m: Vec<f32>,
}

impl DepthBaseline {
    /// Fits the baselines to the first `most` scenes. Depths are limited to `scale_m`, as for
    /// networks.
    ///
    /// # Errors
    /// [`ModelError::Scene`]; [`ModelError::Invalid`] if the scenes' sizes differ.
    pub fn fit(scale_m: f32, scenes: &dyn Scenes, most: usize) -> Result<Self, ModelError> {
        let mut depths = Vec::new();
        // Σ1, Σx, Σx², Σz, Σxz
        let mut sums = [0.0f64; 5];
        let (count, mut pixels) = (scenes.len().min(most), 0);
        for index in 0..count {
            let scene = load(scenes, index)?;
            if index == 0 {
                pixels = scene.pixels();
            }
            same_size(pixels, scene.pixels(), index)?;
            for (x, z) in peaks(&scene).iter().zip(&scene.depth_m) {
                let (x, z) = (*x, known(*z, scale_m));
                depths.push(z);
                let z = f64::from(z);
                for (sum, term) in sums.iter_mut().zip([1.0, x, x * x, z, x * z]) {
                    *sum += term;
                }
            }
        }
        let [n, x, xx, z, xz] = sums;
        let spread = n * xx - x * x;
        let slope = if spread > 0.0 {
            (n * xz - x * z) / spread
        } else {
            0.0
        };
        let median_m = (0..pixels)
            .map(|i| {
                median(
                    &mut (0..count)
                        .map(|k| depths[k * pixels + i])
                        .collect::<Vec<_>>(),
                )
            })
            .collect();
        Ok(Self {
            constant_m: f64::from(median(&mut depths)),
            slope,
            offset_m: if n > 0.0 { (z - slope * x) / n } else { 0.0 },
            median_m,
        })
    }

    /// Returns the depths from peaks, metres: `[row][column]`.
    pub fn of_peaks(&self, scene: &Scene) -> Vec<f32> {
        let depth = peaks(scene)
            .into_iter()
            .map(|x| self.slope * x + self.offset_m);
        depth.map(|z| z as f32).collect()
    }
}

fn load(scenes: &dyn Scenes, index: usize) -> Result<Arc<Scene>, ModelError> {
    scenes.load(index).map_err(|source| ModelError::Scene {
        scene: index,
        source,
    })
}

fn same_size(first: usize, other: usize, index: usize) -> Result<(), ModelError> {
    match first == other {
        true => Ok(()),
        false => Err(ModelError::invalid(
            "scenes",
            format!(
                "scene {index} has {other} values, the first one {first}; use scenes of one size"
            ),
        )),
    }
}

/// Returns the median, the upper one of an even number of values; 0 if there are none.
fn median(values: &mut [f32]) -> f32 {
    values.sort_unstable_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

/// Limits a depth to the range that networks can predict.
fn known(z: f32, scale_m: f32) -> f32 {
    if z.is_finite() {
        z.clamp(0.0, scale_m)
    } else {
        scale_m
    }
}

/// Returns the path length of each pixel's greatest bin times the cosine of its angle to the
/// optical axis, metres.
fn peaks(scene: &Scene) -> Vec<f64> {
    let [fx, fy, cx, cy] = scene.intrinsics;
    brightest(scene)
        .into_iter()
        .enumerate()
        .map(|(i, peak)| {
            let path = scene.first_m + (peak as f64 + 0.5) * scene.bin_width_m;
            let x = ((i % scene.width) as f64 + 0.5 - cx) / fx;
            let y = ((i / scene.width) as f64 + 0.5 - cy) / fy;
            path / (x * x + y * y + 1.0).sqrt()
        })
        .collect()
}

/// Returns each pixel's greatest bin, the first of several.
fn brightest(scene: &Scene) -> Vec<usize> {
    match scene.order {
        Order::Pixels => {
            let of =
                |h: &[f32]| (1..h.len()).fold(0, |peak, b| if h[b] > h[peak] { b } else { peak });
            scene.histogram.chunks_exact(scene.bins).map(of).collect()
        }
        Order::Bins => {
            let mut planes = scene.histogram.chunks_exact(scene.pixels());
            let mut most = planes.next().map_or_else(Vec::new, <[f32]>::to_vec);
            let mut peaks = vec![0; most.len()];
            for (b, plane) in planes.enumerate() {
                for ((h, most), peak) in plane.iter().zip(&mut most).zip(&mut peaks) {
                    if *h > *most {
                        (*most, *peak) = (*h, b + 1);
                    }
                }
            }
            peaks
        }
    }
}
