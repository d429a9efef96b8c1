//! What training reads: a scene's histogram and what is known about it.

use std::{error::Error, sync::Arc};

/// How a histogram's values follow each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Order {
    /// `[row][column][bin]`: histogram by histogram.
    #[default]
    Pixels,
    /// `[bin][row][column]`: an image for each bin, as networks take them.
    Bins,
}

/// A scene. Images are row by row, from the top left.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Scene {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Bins of the histogram.
    pub bins: usize,
    /// Path length at the beginning of the first bin, metres.
    pub first_m: f64,
    /// Width of a bin, metres of path.
    pub bin_width_m: f64,
    /// h, in [`Self::order`].
    pub histogram: Vec<f32>,
    /// How its values follow each other.
    pub order: Order,
    /// z-depth, metres: `[row][column]`.
    pub depth_m: Vec<f32>,
    /// z-depth that two-bounce times follow from where that is not the truth but a network's, metres: `[row][column]`.
    pub seen_depth_m: Option<Vec<f32>>,
    /// 1 where the first surface is a mirror: `[row][column]`.
    pub specular: Vec<u8>,
    /// Illumination spots L_i in camera coordinates, metres.
    pub spots: Vec<[f32; 3]>,
    /// 1 where a spot lights the point that is seen: `[spot][row][column]`.
    pub lit: Vec<u8>,
    /// Length of each spot's beam from the laser, metres: longer than the straight line where mirrors fold it. NaN where it
    /// meets nothing.
    pub beams_m: Vec<f32>,
    /// fx, fy, cx, cy in pixels.
    pub intrinsics: [f64; 4],
}

impl Scene {
    /// The same with another histogram of as many bins, in [`Order::Pixels`].
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
            ..*self
        }
    }
}

/// Scenes that are read one by one, in any order, from several threads.
pub trait Scenes: Send + Sync {
    /// How many.
    fn len(&self) -> usize;

    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// One of them.
    ///
    /// # Errors
    /// Whatever keeps it from being read.
    fn load(&self, index: usize) -> Result<Arc<Scene>, Unreadable>;

    /// Takes back what nobody needs any more: the room of its histogram may serve for the next.
    fn take_back(&self, _scene: Arc<Scene>) {}

    /// One of them as the `visit`th visit of a training sees it, counted over all epochs: what is drawn at random is drawn anew
    /// at each. Always the same where nothing is.
    ///
    /// # Errors
    /// As [`Self::load`].
    fn visited(&self, index: usize, _visit: u64) -> Result<Arc<Scene>, Unreadable> {
        self.load(index)
    }
}

/// Why a scene could not be read.
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
    /// About how much memory it takes.
    pub fn bytes(&self) -> usize {
        let seen = self.seen_depth_m.as_ref().map_or(0, Vec::len);
        let floats = self.histogram.len() + self.depth_m.len() + seen;
        4 * floats + self.specular.len() + self.lit.len()
    }

    /// Pixels.
    pub fn pixels(&self) -> usize {
        self.height * self.width
    }

    /// Two-bounce path lengths of a spot, metres, from [`Self::seen_depth_m`], else from the true depth: `[row][column]`. The
    /// beam's length + |x_p − L| + |x_p|, with the camera at the origin; NaN for a beam that meets nothing.
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
