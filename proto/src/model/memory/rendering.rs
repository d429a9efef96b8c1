//! What a render keeps in memory.

use super::shape::{BIN, PROGRAM, STORE, Shape};

/// Share of a histogram's bytes that its coded form takes in memory while it is made, on average over scenes.
const CODED: f64 = 0.45;
/// Share of the image that the allocator still holds of the scene before, when its worker goes on with the next.
const HELD: f64 = 0.25;
/// Pixels from which an image has large tiles, channels from which it has small ones again, and pixels of both tiles.
const LARGE: f64 = 65_536.0;
const MANY: f64 = 5.0;
const LARGE_TILE: f64 = 1024.0;
const SMALL_TILE: f64 = 256.0;
/// Sums that a thread keeps of each slot of its tile: of all channels, and of the first alone; one pixel in nine keeps nine
/// more, for draws of its error.
const TILE_SUMS: (f64, f64) = (3.0, 7.0);
/// What the sums over light paths take, as a share of what sums of every bin would. They are kept of the bins that light paths come to, in
/// twice as many bytes each: by the memory that a furnished room of 64×64 pixels took, about a fifth of the bins after 512 passes. Scenes without
/// mirrors and glass need none; only the scene tells.
pub(in crate::model) const LIGHT_PATHS: f64 = 0.25;

/// Bytes of a triangle while the tree over the scene is built, and of one that is kept while it is rendered, the scene's own among them;
/// without those that are counted with the program. By what rooms of 90,000 to 360,000 triangles took.
const BUILT: f64 = 750.0;
const KEPT: f64 = 300.0;
const COUNTED: f64 = 15e3;

/// What a render keeps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rendering {
    /// The image and its gate.
    pub shape: Shape,
    /// Histograms of a pixel: that of all spots, and those of groups of them.
    pub histograms: u32,
    /// The parts of the histogram are kept with their errors.
    pub split: bool,
    /// Light paths may be drawn into the image, where mirrors or glass call for them.
    pub light_paths: bool,
    /// Triangles of the scene; 0 where they are not known.
    pub triangles: u64,
    /// Threads that render.
    pub threads: u32,
}

impl Rendering {
    fn slots(&self) -> f64 {
        BIN * (f64::from(self.shape.bins) + 2.0)
    }

    /// Histograms of the image, in bytes: 4·pixels·bins for each, and for the six parts of [`Rendering::split`].
    pub(in crate::model) fn images(&self) -> f64 {
        let parts = if self.split { 6.0 } else { 0.0 };
        self.shape.histogram() * (f64::from(self.histograms) + parts)
    }

    /// What threads keep of the tiles that they work on.
    pub(in crate::model) fn tiles(&self) -> f64 {
        let (pixels, channels) = (self.shape.pixels(), f64::from(self.histograms));
        let large = pixels >= LARGE && channels < MANY;
        let tile = if large { LARGE_TILE } else { SMALL_TILE };
        let sums = TILE_SUMS.0 * channels + TILE_SUMS.1;
        tile.min(pixels) * self.slots() * sums * f64::from(self.threads.max(1))
    }

    /// Sums over light paths, if they were kept of every bin: of every channel, of squares, with alternating signs for [`Rendering::split`], and
    /// in one pixel of nine for draws of its error.
    pub(in crate::model) fn paths(&self) -> f64 {
        let sums = f64::from(self.histograms) + if self.split { 2.5 } else { 1.5 };
        match self.light_paths {
            true => self.shape.pixels() * self.slots() * sums,
            false => 0.0,
        }
    }

    /// What a scene takes, with what is kept beside it: the tree is built before there is anything of the image.
    pub(in crate::model) fn with_scene(&self, rest: f64) -> f64 {
        let triangles = (self.triangles as f64 - COUNTED).max(0.0);
        (BUILT * triangles).max(KEPT * triangles + rest)
    }

    /// Bytes of the render alone: program, scene, truth, images, tiles, and light paths as far as they are counted.
    pub fn peak_bytes(&self) -> u64 {
        let images = self.shape.truth() + self.images();
        let rest = images + self.tiles() + LIGHT_PATHS * self.paths();
        // Casting saturates.
        (PROGRAM + self.with_scene(rest)) as u64
    }

    /// The same, or what coding the result takes if that is more, in a worker that renders one scene after another.
    pub(in crate::model) fn coded(&self) -> f64 {
        let after = self.shape.truth() + self.images() * (1.0 + CODED);
        let after = PROGRAM + self.with_scene(after);
        (self.peak_bytes() as f64).max(after) + HELD * self.images() + STORE
    }
}
