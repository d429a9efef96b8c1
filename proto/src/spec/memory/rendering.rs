//! The memory of a render.

use super::shape::{BIN, PROGRAM, STORE, Shape};

/// Ratio of the memory of a histogram's coded form during coding to the histogram's bytes, averaged
/// over scenes.
const CODED: f64 = 0.45;
/// Fraction of the previous scene's image that the allocator still keeps when a worker begins the
/// next.
const HELD: f64 = 0.25;
/// Pixels from which an image has large tiles, channels from which it has small ones again, and
/// pixels of both tiles.
const LARGE: f64 = 65_536.0;
const MANY: f64 = 5.0;
const LARGE_TILE: f64 = 1024.0;
const SMALL_TILE: f64 = 256.0;
/// Sums that a thread stores for each slot of its tile: for all channels, and for the first one
/// only. One pixel in nine stores nine more, for draws of its error.
const TILE_SUMS: (f64, f64) = (3.0, 7.0);
/// Memory of the sums over light paths, as a fraction of sums of every bin. They are stored only
/// for the bins that light paths reach, with twice as many bytes each. The value comes from the
/// memory of a furnished room of 64×64 pixels, about a fifth of the bins after 512 passes. Scenes
/// without mirrors and glass need none, but only the scene shows that.
pub(in crate::spec) const LIGHT_PATHS: f64 = 0.25;

/// Bytes of a triangle while the tree over the scene is built, and of one kept during rendering,
/// including the scene's own and excluding those counted with the program. Measured in rooms of
/// 90,000 to 360,000 triangles.
const BUILT: f64 = 750.0;
const KEPT: f64 = 300.0;
const COUNTED: f64 = 15e3;

/// The values that determine a render's memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rendering {
    /// The image and its gate.
    pub shape: Shape,
    /// Histograms of a pixel: for all spots, and for groups of them.
    pub histograms: u32,
    /// Whether the parts of the histogram are stored with their errors.
    pub split: bool,
    /// Whether light paths may be drawn into the image, because of mirrors or glass.
    pub light_paths: bool,
    /// Triangles of the scene; 0 if unknown.
    pub triangles: u64,
    /// Render threads.
    pub threads: u32,
}

impl Rendering {
    fn slots(&self) -> f64 {
        BIN * (f64::from(self.shape.bins) + 2.0)
    }

    /// Returns the bytes of the image's histograms: 4·pixels·bins for each, and for the six parts
    /// of [`Rendering::split`].
    pub(in crate::spec) fn images(&self) -> f64 {
        let parts = if self.split { 6.0 } else { 0.0 };
        self.shape.histogram() * (f64::from(self.histograms) + parts)
    }

    /// Returns the bytes that threads store for their current tiles.
    pub(in crate::spec) fn tiles(&self) -> f64 {
        let (pixels, channels) = (self.shape.pixels(), f64::from(self.histograms));
        let large = pixels >= LARGE && channels < MANY;
        let tile = if large { LARGE_TILE } else { SMALL_TILE };
        let sums = TILE_SUMS.0 * channels + TILE_SUMS.1;
        tile.min(pixels) * self.slots() * sums * f64::from(self.threads.max(1))
    }

    /// Returns the bytes of sums over light paths, if they were stored for every bin: for every
    /// channel, for squares, with alternating signs for [`Rendering::split`], and in one pixel of
    /// nine for draws of its error.
    pub(in crate::spec) fn paths(&self) -> f64 {
        let sums = f64::from(self.histograms) + if self.split { 2.5 } else { 1.5 };
        match self.light_paths {
            true => self.shape.pixels() * self.slots() * sums,
            false => 0.0,
        }
    }

    /// Returns the bytes of a scene and `rest`. The tree is built before the image exists.
    pub(in crate::spec) fn with_scene(&self, rest: f64) -> f64 {
        let triangles = (self.triangles as f64 - COUNTED).max(0.0);
        (BUILT * triangles).max(KEPT * triangles + rest)
    }

    /// Returns the bytes of the render alone: program, scene, truth, images, tiles, and light paths
    /// as far as they are counted.
    pub fn peak_bytes(&self) -> u64 {
        let images = self.shape.truth() + self.images();
        let rest = images + self.tiles() + LIGHT_PATHS * self.paths();
        // The cast saturates.
        (PROGRAM + self.with_scene(rest)) as u64
    }

    /// Returns the bytes of the render, or those of coding the result if larger, in a worker that
    /// renders one scene after another.
    pub(in crate::spec) fn coded(&self) -> f64 {
        let after = self.shape.truth() + self.images() * (1.0 + CODED);
        let after = PROGRAM + self.with_scene(after);
        (self.peak_bytes() as f64).max(after) + HELD * self.images() + STORE
    }
}
