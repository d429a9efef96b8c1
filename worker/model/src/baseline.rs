//! What networks have to beat: the best constant, the peak of each pixel's histogram, masks of one value.

use serde::{Deserialize, Serialize};

use crate::{
    ModelError,
    input::DEPTH_SCALE_M,
    scene::{Scene, Scenes},
};

/// Depths without a network, fitted to training scenes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthBaseline {
    /// The median depth, metres: no constant has a smaller mean absolute error.
    pub constant_m: f64,
    /// z of a pixel = `slope` · ℓ · cos θ + `offset_m`, with ℓ the path length of its histogram's greatest bin and θ the
    /// angle to the optical axis; by least squares.
    pub slope: f64,
    /// See `slope`, metres.
    pub offset_m: f64,
}

impl DepthBaseline {
    /// Fitted to at most `most` scenes, the first ones.
    ///
    /// # Errors
    /// [`ModelError::Scene`].
    pub fn fit(scenes: &dyn Scenes, most: usize) -> Result<Self, ModelError> {
        let mut depths = Vec::new();
        // Σ1, Σx, Σx², Σz, Σxz
        let mut sums = [0.0f64; 5];
        for index in 0..scenes.len().min(most) {
            let scene = scenes.load(index).map_err(|source| ModelError::Scene {
                scene: index,
                source,
            })?;
            for (x, z) in peaks(&scene).iter().zip(&scene.depth_m) {
                let (x, z) = (*x, f64::from(known(*z)));
                depths.push(known(z as f32));
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
        depths.sort_unstable_by(f32::total_cmp);
        Ok(Self {
            constant_m: depths.get(depths.len() / 2).copied().map_or(0.0, f64::from),
            slope,
            offset_m: if n > 0.0 { (z - slope * x) / n } else { 0.0 },
        })
    }

    /// Depths from peaks, metres: `[row][column]`.
    pub fn of_peaks(&self, scene: &Scene) -> Vec<f32> {
        let depth = peaks(scene)
            .into_iter()
            .map(|x| self.slope * x + self.offset_m);
        depth.map(|z| z as f32).collect()
    }
}

/// Depth as networks learn it: within what they can say.
fn known(z: f32) -> f32 {
    if z.is_finite() {
        z.clamp(0.0, DEPTH_SCALE_M)
    } else {
        DEPTH_SCALE_M
    }
}

/// Path length of each pixel's greatest bin times the cosine of its angle to the optical axis, metres.
fn peaks(scene: &Scene) -> Vec<f64> {
    let [fx, fy, cx, cy] = scene.intrinsics;
    let pixels = scene.histogram.chunks_exact(scene.bins).enumerate();
    pixels
        .map(|(i, h)| {
            let mut peak = 0;
            for (b, value) in h.iter().enumerate() {
                if *value > h[peak] {
                    peak = b;
                }
            }
            let path = scene.first_m + (peak as f64 + 0.5) * scene.bin_width_m;
            let x = ((i % scene.width) as f64 + 0.5 - cx) / fx;
            let y = ((i / scene.width) as f64 + 0.5 - cy) / fy;
            path / (x * x + y * y + 1.0).sqrt()
        })
        .collect()
}
