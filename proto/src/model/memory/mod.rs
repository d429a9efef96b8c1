//! How much memory a task takes at most, from its settings and what is known of what it reads. Plain arithmetic: the
//! coordinator places tasks by it, plans say it, and workers refuse by it, before anything is made.
//!
//! The constants are measured (`tests/tests/memory.rs`, which compares these numbers with the largest memory of
//! processes that run each kind of task): estimates lie within a factor of two above, and not more than a quarter below.

mod network;

use super::{JobSpec, RenderTask, StageSpec, TaskSpec};
pub use network::Network;

/// The program with its threads, what it has read of furniture, and a scene of some ten thousand triangles.
const PROGRAM: f64 = 70e6;
/// What a store's requests and the coding of small arrays take beside the histograms.
const STORE: f64 = 20e6;
/// Both: what every task takes.
pub(super) const BASE: f64 = PROGRAM + STORE;
/// Bytes of a histogram's bin in memory.
const BIN: f64 = 4.0;
/// Share of a histogram's bytes that its coded form takes in memory while it is made, on average over scenes.
const CODED: f64 = 0.45;
/// Bytes of a pixel for the ground truth, what its centre sees, and error sums.
const TRUTH: f64 = 260.0;
/// Pixels from which an image has large tiles, channels from which it has small ones again, and pixels of both tiles.
const LARGE: f64 = 65_536.0;
const MANY: f64 = 5.0;
const LARGE_TILE: f64 = 1024.0;
const SMALL_TILE: f64 = 256.0;
/// Sums that a thread keeps of each slot of its tile: of all channels, and of the first alone.
const TILE_SUMS: (f64, f64) = (2.0, 6.0);
/// Share of the sums over light paths that is counted: not every scene has mirrors that need them, and only the scene
/// tells.
pub(super) const LIGHT_PATHS: f64 = 0.6;

/// The size of scenes that a task reads or makes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// Rows of pixels.
    pub height: u32,
    /// Columns of pixels.
    pub width: u32,
    /// Bins of a histogram.
    pub bins: u32,
    /// Laser spots.
    pub spots: u32,
}

impl Shape {
    pub(super) fn pixels(&self) -> f64 {
        f64::from(self.height) * f64::from(self.width)
    }

    /// Bytes of one histogram of every pixel.
    pub(super) fn histogram(&self) -> f64 {
        BIN * self.pixels() * f64::from(self.bins)
    }

    /// Bytes of what is kept of each pixel beside histograms.
    pub(super) fn truth(&self) -> f64 {
        self.pixels() * (TRUTH + f64::from(self.spots))
    }

    /// Bytes of two scenes as networks meet them: the histogram as it is read, and as it is kept.
    pub(super) fn two(&self) -> f64 {
        self.truth() + 2.0 * self.histogram()
    }
}

/// What a render keeps, beside its scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rendering {
    /// The image and its gate.
    pub shape: Shape,
    /// Histograms of a pixel: that of all spots, and those of groups of them.
    pub histograms: u32,
    /// The parts of the histogram are kept with their errors.
    pub split: bool,
    /// Light paths may be drawn into the image, where mirrors call for them.
    pub light_paths: bool,
    /// Threads that render.
    pub threads: u32,
}

impl Rendering {
    /// Of a render task.
    pub fn of(task: &RenderTask, threads: u32) -> Self {
        let render = &task.render;
        let spots = if render.per_spot {
            task.scenes.spots
        } else {
            0
        };
        Self {
            shape: Shape {
                height: render.resolution,
                width: render.resolution,
                bins: render.bins,
                spots: task.scenes.spots,
            },
            histograms: 1 + render.subsets.len() as u32 + spots,
            split: false,
            light_paths: render.strategy.caustics != Some(false) && render.max_bounces != 2,
            threads,
        }
    }

    fn slots(&self) -> f64 {
        BIN * (f64::from(self.shape.bins) + 2.0)
    }

    /// Histograms of the image, in bytes: 4·pixels·bins for each, and for the five parts of [`Rendering::split`].
    pub(super) fn images(&self) -> f64 {
        let parts = if self.split { 5.0 } else { 0.0 };
        self.shape.histogram() * (f64::from(self.histograms) + parts)
    }

    /// What threads keep of the tiles that they work on.
    pub(super) fn tiles(&self) -> f64 {
        let (pixels, channels) = (self.shape.pixels(), f64::from(self.histograms));
        let large = pixels >= LARGE && channels < MANY;
        let tile = if large { LARGE_TILE } else { SMALL_TILE };
        let sums = TILE_SUMS.0 * channels + TILE_SUMS.1;
        tile.min(pixels) * self.slots() * sums * f64::from(self.threads.max(1))
    }

    /// Sums over light paths: of every channel, of squares, and with alternating signs for [`Rendering::split`].
    pub(super) fn paths(&self) -> f64 {
        let sums = f64::from(self.histograms) + if self.split { 2.0 } else { 1.0 };
        match self.light_paths {
            true => self.shape.pixels() * self.slots() * sums,
            false => 0.0,
        }
    }

    /// Bytes of the render alone: program, truth, images, tiles, and light paths as far as they are counted.
    pub fn peak_bytes(&self) -> u64 {
        let images = PROGRAM + self.shape.truth() + self.images();
        bytes(images + self.tiles() + LIGHT_PATHS * self.paths())
    }

    /// The same, or what coding the result takes if that is more.
    pub(super) fn coded(&self) -> f64 {
        let after = PROGRAM + self.shape.truth() + self.images() * (1.0 + CODED);
        (self.peak_bytes() as f64).max(after) + STORE
    }
}

/// What is known of what a task reads.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Known {
    /// The scenes of the data set; `None` where only the store tells.
    pub source: Option<Shape>,
    /// The networks of the models that it asks, as far as they are known.
    pub networks: Vec<Network>,
}

/// Bytes in words: "41.3 GiB".
pub fn gib(bytes: u64) -> String {
    let gib = bytes as f64 / (1u64 << 30) as f64;
    match gib {
        0.0..0.1 => format!("{:.0} MiB", gib * 1024.0),
        _ => format!("{gib:.1} GiB"),
    }
}

/// Casting saturates.
fn bytes(estimate: f64) -> u64 {
    estimate as u64
}

/// Bytes that a task takes at most, in a process of its own; `None` where that depends on a data set of which nothing is
/// known here.
///
/// | kind | beside the program (70 MB) and the store (20 MB); H = 4·pixels·bins |
/// | --- | --- |
/// | render | H a histogram, truth (260 + spots a pixel), tiles of each thread; and what is more: .6 of the light paths' sums, or the coded result (.45·H) |
/// | render of parts | the same, and all parts (as much as the image) |
/// | part | the image's and truth's, of the range of tiles; the sums over light paths, and both once more as a message |
/// | generate | nothing that grows with pixels: its scene is counted with the program |
/// | import | 3.2·H |
/// | reprocess | 2.6·H; from single spots 4.6·H |
/// | split | nothing that grows with pixels |
/// | promote | twice the weights |
/// | reconstruct | 28 bytes a node of the grid, 40 a pixel and spot; from single spots 2·H |
/// | export | 3.5·H |
/// | train, evaluate, infer, report | see [`Network`]; and two scenes |
pub fn peak_bytes(task: &TaskSpec, known: &Known, threads: u32) -> Option<u64> {
    task.memory(known, threads).map(bytes)
}

impl JobSpec {
    /// What is known of what the stage at a position reads: from the stages before it, which make it.
    pub fn known(&self, stage: usize) -> Known {
        let before = &self.stages[..stage.min(self.stages.len())];
        let Some(spec) = self.stages.get(stage) else {
            return Known::default();
        };
        Known {
            source: spec
                .task
                .reads()
                .and_then(|source| made(before, (&source.store, &source.dataset))),
            networks: networks(before, spec),
        }
    }
}

/// The scenes that a stage puts into a place.
fn made(before: &[StageSpec], place: (&String, &String)) -> Option<Shape> {
    let at = before.iter().rposition(|s| s.task.makes() == Some(place))?;
    let source = before[at].task.reads();
    let source = source.and_then(|source| made(&before[..at], (&source.store, &source.dataset)));
    before[at].task.shape(source)
}

/// The networks that stages train of which another one reads the models.
fn networks(before: &[StageSpec], spec: &StageSpec) -> Vec<Network> {
    let Some(store) = spec.task.shelf() else {
        return Vec::new();
    };
    let trained = |model: &String| {
        let at = before
            .iter()
            .rposition(|s| s.task.trains() == Some((store, model)))?;
        let source = before[at].task.reads()?;
        let scenes = made(&before[..at], (&source.store, &source.dataset))?;
        before[at].task.network(&scenes)
    };
    let models = spec.task.models();
    models
        .iter()
        .filter_map(|(_, model)| trained(model))
        .collect()
}

#[cfg(test)]
mod tests;
