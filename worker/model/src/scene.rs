//! The input of training: a scene's histogram and its ground truth.

use std::{error::Error, sync::Arc};

/// The order of a histogram's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Order {
    /// `[row][column][bin]`: one pixel's histogram after another.
    #[default]
    Pixels,
    /// `[bin][row][column]`: one image for each bin, the order that networks take.
    Bins,
}

/// A scene. Images are stored row by row, from the top left.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Scene {
    /// The number of rows.
    pub height: usize,
    /// The number of columns.
    pub width: usize,
    /// The number of bins of the histogram.
    pub bins: usize,
    /// The path length at the start of the first bin, metres.
    pub first_m: f64,
    /// The width of a bin, metres of path.
    pub bin_width_m: f64,
    /// The histogram h, in [`Self::order`].
    pub histogram: Vec<f32>,
    /// The order of the histogram's values.
    pub order: Order,
    /// The true z-depth, metres: `[row][column]`.
    pub depth_m: Vec<f32>,
    /// The z-depth from which two-bounce times are computed, if it is a network's prediction and
    /// not the true depth, metres: `[row][column]`.
    pub seen_depth_m: Option<Vec<f32>>,
    /// 1 if the first surface is a mirror: `[row][column]`.
    pub specular: Vec<u8>,
    /// The illumination spots L_i in camera coordinates, metres.
    pub spots: Vec<[f32; 3]>,
    /// 1 if a spot lights the visible point: `[spot][row][column]`.
    pub lit: Vec<u8>,
    /// The length of each spot's beam from the laser, metres. Mirrors fold the beam and make it
    /// longer than the straight line. NaN if the beam hits nothing.
    pub beams_m: Vec<f32>,
    /// Codes of the evidence, if the network sees it: `[spot][plane][row][column]`. The histogram
    /// may then be empty.
    pub evidence: Vec<u8>,
    /// The intrinsics fx, fy, cx, cy in pixels.
    pub intrinsics: [f64; 4],
}

impl Scene {
    /// Returns the scene with another histogram, which has as many bins and is in
    /// [`Order::Pixels`].
    #[must_use]
    pub fn showing(&self, histogram: Vec<f32>) -> Self {
        Self {
            histogram,
            order: Order::Pixels,
            depth_m: self.depth_m.clone(),
            seen_depth_m: self.seen_depth_m.clone(),
            specular: self.specular.clone(),
            spots: self.spots.clone(),
            lit: self.lit.clone(),
            beams_m: self.beams_m.clone(),
            evidence: self.evidence.clone(),
            ..*self
        }
    }
}

/// A set of scenes that are read one by one, in any order, from several threads.
pub trait Scenes: Send + Sync {
    /// Returns the number of scenes.
    fn len(&self) -> usize;

    /// Returns whether there are no scenes.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Reads a scene.
    ///
    /// # Errors
    /// Any reason why the scene cannot be read.
    fn load(&self, index: usize) -> Result<Arc<Scene>, Unreadable>;

    /// Takes back a scene after its last use, so that its histogram's memory can be reused
    /// for the next.
    fn take_back(&self, _scene: Arc<Scene>) {}

    /// Reads a scene as the `visit`th visit of a training run sees it, counted over all epochs.
    /// Random parts are drawn again at each visit. A scene without random parts is always the same.
    ///
    /// # Errors
    /// As for [`Self::load`].
    fn visited(&self, index: usize, _visit: u64) -> Result<Arc<Scene>, Unreadable> {
        self.load(index)
    }
}

/// The reason why a scene could not be read.
pub type Unreadable = Box<dyn Error + Send + Sync>;

impl Scenes for Vec<Arc<Scene>> {
    fn len(&self) -> usize {
        self.as_slice().len()
    }

    fn load(&self, index: usize) -> Result<Arc<Scene>, Unreadable> {
        Ok(Arc::clone(&self[index]))
    }
}

impl Scene {
    /// Returns the approximate memory that the scene takes, bytes.
    pub fn bytes(&self) -> usize {
        let seen = self.seen_depth_m.as_ref().map_or(0, Vec::len);
        let floats = self.histogram.len() + self.depth_m.len() + seen;
        4 * floats + self.specular.len() + self.lit.len() + self.evidence.len()
    }

    /// Returns the number of pixels.
    pub fn pixels(&self) -> usize {
        self.height * self.width
    }

    /// Returns the two-bounce path lengths of a spot in metres, from [`Self::seen_depth_m`] or else
    /// the true depth: `[row][column]`. A path length is the beam's length + |x_p − L| + |x_p|,
    /// with the camera at the origin. It is NaN if the beam hits nothing.
    pub fn tof(&self, spot: usize) -> Vec<f32> {
        let depth_m = self.seen_depth_m.as_ref().unwrap_or(&self.depth_m);
        let [fx, fy, cx, cy] = self.intrinsics;
        let to_spot = f64::from(self.beams_m[spot]);
        let spot = self.spots[spot].map(f64::from);
        let distance = |a: [f64; 3], b: [f64; 3]| {
            let d: f64 = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum();
            d.sqrt()
        };
        let pixels = depth_m.iter().enumerate();
        pixels
            .map(|(i, z)| {
                let z = f64::from(*z);
                let (u, v) = (i % self.width, i / self.width);
                let x = [
                    (u as f64 + 0.5 - cx) / fx * z,
                    (v as f64 + 0.5 - cy) / fy * z,
                    z,
                ];
                (to_spot + distance(x, spot) + distance(x, [0.0; 3])) as f32
            })
            .collect()
    }
}
