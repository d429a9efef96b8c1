//! What a render task does: which scenes, rendered how.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{
    job::{OutputSettings, SpecError, check_count, place},
    text::{RenderSettingsText, SceneSourceText},
};

/// Rendering scenes into a data set: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RenderTask {
    /// Which scenes.
    pub scenes: SceneSource,
    /// How they are rendered.
    pub render: RenderSettings,
    /// Where results go.
    pub output: OutputSettings,
    /// Into how many ranges of tiles each scene is divided, for several workers to share it; 1 = not divided. The result
    /// is the same to the bit.
    #[serde(skip_serializing_if = "is_one")]
    pub parts: u32,
}

/// Rendering parts of scenes, which the stage that needs it joins: one task a part. Task `i` is part
/// `i % tasks_per_scene` of scene `i / tasks_per_scene`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PartTask {
    /// The rendering.
    #[serde(flatten)]
    pub whole: RenderTask,
    /// Key of the stage that joins the parts, hexadecimal; filled in at submission.
    pub joined_by: String,
}

impl PartTask {
    /// Tasks of each scene: the ranges of tiles, and the light paths that cross them.
    pub fn tasks_per_scene(&self) -> u64 {
        u64::from(self.whole.parts) + 1
    }

    /// The scene and the part that task `index` is.
    pub fn split(&self, index: u64) -> (u64, u32) {
        let part = index % self.tasks_per_scene();
        (index / self.tasks_per_scene(), part as u32)
    }

    /// As [`RenderTask::only`].
    pub(super) fn only(&self, lo: u64, hi: u64) -> Self {
        let each = self.tasks_per_scene();
        Self {
            whole: self.whole.only(lo / each, hi.div_ceil(each)),
            joined_by: self.joined_by.clone(),
        }
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_one(n: &u32) -> bool {
    *n == 1
}

impl RenderTask {
    /// Most ranges that a scene is divided into.
    pub const MAX_PARTS: u32 = 1024;

    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check(&self) -> Result<(), SpecError> {
        self.scenes.check()?;
        self.render.check()?;
        if !(1..=Self::MAX_PARTS).contains(&self.parts) {
            let what = format!("{} lies outside 1..={}", self.parts, Self::MAX_PARTS);
            return Err(SpecError::new("parts", what));
        }
        if self.parts > 1 && matches!(self.render.budget, Budget::Error(_)) {
            let what = "needs render.samples: how many samples render.error takes is decided over the whole image; \
                        `picofarm scene plan` tells how many that would be";
            return Err(SpecError::new("parts", what));
        }
        if let [smallest, ..] = self.render.subsets[..]
            && self.scenes.spots != 100
        {
            return Err(SpecError::new(
                "render.subsets",
                format!(
                    "{smallest} is a subset of the 10x10 grid, which scenes.spots = {} is not; set scenes.spots = 100, \
                     or leave subsets out",
                    self.scenes.spots
                ),
            ));
        }
        self.output.check()
    }

    pub(super) fn check_places(&self) -> Result<(), SpecError> {
        place("output.store", &self.output.store)?;
        if let SceneKind::Files { files, .. } = &self.scenes.kind {
            for (i, file) in files.iter().enumerate() {
                place(&format!("scenes.files[{i}]"), &file.path)?;
            }
        }
        Ok(())
    }

    /// What a lease of tasks `lo..hi` needs of this: of a list of files only its own.
    pub(super) fn only(&self, lo: u64, hi: u64) -> Self {
        let kind = match &self.scenes.kind {
            SceneKind::Files { files, first } => {
                let at = |i: u64| usize::try_from(i.saturating_sub(*first)).unwrap_or(usize::MAX);
                let own = files.get(at(lo)..at(hi).min(files.len()));
                SceneKind::Files {
                    files: own.unwrap_or_default().to_vec(),
                    first: lo.max(*first),
                }
            }
            other => other.clone(),
        };
        Self {
            scenes: SceneSource {
                kind,
                ..self.scenes.clone()
            },
            render: self.render.clone(),
            output: self.output.clone(),
            parts: self.parts,
        }
    }
}

/// The scenes of a job: one task each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "SceneSourceText")]
pub struct SceneSource {
    /// Where scenes come from.
    #[serde(flatten)]
    pub kind: SceneKind,
    /// Number of scenes; with `kind = "files"`, the number of files (may be left out).
    pub count: u64,
    /// Seed (default 0); scene i derives its own from (seed, i).
    pub seed: u64,
    /// Horizontal field of view in degrees (generated scenes; default 90).
    pub fov_deg: f64,
    /// Laser spots: 1, 4, 16, 25 (default) or 100 (generated scenes, and files without a laser).
    pub spots: u32,
}

/// Where scenes come from.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum SceneKind {
    /// Furnished rooms.
    Furnished {
        /// `parametric`, `sweethome3d`, `auto` (default: whichever is installed; resolved before
        /// submission), or a resolved fingerprint.
        assets: String,
        /// At least this many mirrors a room (default 1).
        min_specular: u32,
    },
    /// Primitive rooms: cube, cylinder and mirror in a room of varying scale.
    Primitive,
    /// Scene files (.glb, .gltf, .json), one scene each.
    Files {
        /// The files; in a job file, plain paths.
        files: Vec<SceneFile>,
        /// Index of the first of them: 0 but in a lease, which brings only its own.
        #[serde(skip_serializing_if = "is_zero")]
        first: u64,
    },
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

impl SceneKind {
    /// The file of scene `index`, where scenes are files and this one is listed.
    pub fn file(&self, index: u64) -> Option<&SceneFile> {
        match self {
            Self::Files { files, first } => {
                files.get(usize::try_from(index.checked_sub(*first)?).ok()?)
            }
            _ => None,
        }
    }
}

/// A scene file, pinned by its content.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "SceneFileText")]
pub struct SceneFile {
    /// Path as the workers see it.
    pub path: String,
    /// SHA-256 of the content in hexadecimal; empty until submission fills it in.
    pub sha256: String,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum SceneFileText {
    Path(String),
    Pinned { path: String, sha256: String },
}

impl From<SceneFileText> for SceneFile {
    fn from(text: SceneFileText) -> Self {
        match text {
            SceneFileText::Path(path) => Self {
                path,
                sha256: String::new(),
            },
            SceneFileText::Pinned { path, sha256 } => Self { path, sha256 },
        }
    }
}

/// How scenes are rendered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "RenderSettingsText")]
pub struct RenderSettings {
    /// Image width and height in pixels.
    pub resolution: u32,
    /// ℓ_min, metres of optical path.
    pub gate_start_m: f64,
    /// Δ, metres.
    pub bin_width_m: f64,
    /// Number of bins.
    pub bins: u32,
    /// Multi-bounce work: `samples = N` (paths per pixel) or `error = 0.1` (target).
    #[serde(flatten)]
    pub budget: Budget,
    /// Longest path in bounces; 0 = until the gate ends.
    pub max_bounces: u32,
    /// Version of the renderer, part of every task key; filled in at submission where left out.
    pub renderer: String,
    /// Subsets of the 10×10 grid of spots that get histograms of their own, from the same rays: 4 and 25, ascending.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub subsets: Vec<u32>,
    /// Each spot gets a histogram of its own, from the same rays.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub per_spot: bool,
    /// The renderer's ways of finding light that are chosen by hand, by name; the others are left to the renderer,
    /// which knows their names.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub strategy: BTreeMap<String, Choice>,
}

/// A choice by hand, of [`RenderSettings::strategy`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Choice {
    /// Used or not.
    On(bool),
    /// A size, in the unit that the name stands for.
    Size(u32),
}

/// How much multi-bounce work to do.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Budget {
    /// Camera paths per pixel.
    Samples(u32),
    /// Until the median per-pixel relative error falls to this share.
    Error(f64),
}

impl Default for RenderSettings {
    /// The measurement contract's default gate: [1.0, 25.45584) m in 637 bins of 0.0384 m, 256×256 px.
    fn default() -> Self {
        Self {
            resolution: 256,
            gate_start_m: 1.0,
            bin_width_m: 0.0384,
            bins: 637,
            budget: Budget::Samples(32),
            max_bounces: 0,
            renderer: String::new(),
            subsets: vec![],
            per_spot: false,
            strategy: BTreeMap::new(),
        }
    }
}

impl SceneSource {
    pub(super) fn check(&self) -> Result<(), SpecError> {
        check_count("scenes.count", self.count)?;
        if let SceneKind::Files { first: 1.., .. } = &self.kind {
            return Err(SpecError::new(
                "scenes.first",
                "is only for leases; remove it",
            ));
        }
        if let SceneKind::Files { files, .. } = &self.kind
            && files.len() as u64 != self.count
        {
            return Err(SpecError::new(
                "scenes.count",
                format!(
                    "{} differs from the {} files listed; leave count out",
                    self.count,
                    files.len()
                ),
            ));
        }
        if !(10.0..=150.0).contains(&self.fov_deg) {
            return Err(SpecError::new(
                "scenes.fov_deg",
                format!("{} lies outside 10..=150 degrees", self.fov_deg),
            ));
        }
        if ![1, 4, 16, 25, 100].contains(&self.spots) {
            return Err(SpecError::new(
                "scenes.spots",
                format!("{} is not one of 1, 4, 16, 25, 100", self.spots),
            ));
        }
        Ok(())
    }
}

impl RenderSettings {
    /// The subsets of the 10×10 grid of spots there are.
    pub const SUBSETS: [u32; 2] = [4, 25];

    fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("render.{field}"), what));
        if !(1..=4096).contains(&self.resolution) {
            return fail(
                "resolution",
                format!("{} lies outside 1..=4096 pixels", self.resolution),
            );
        }
        if !(self.gate_start_m >= 0.0 && self.gate_start_m.is_finite()) {
            return fail(
                "gate_start_m",
                format!("{} must be a finite length ≥ 0 m", self.gate_start_m),
            );
        }
        if !(self.bin_width_m > 0.0 && self.bin_width_m.is_finite()) {
            return fail(
                "bin_width_m",
                format!("{} must be a positive length in metres", self.bin_width_m),
            );
        }
        if !(1..=65_536).contains(&self.bins) {
            return fail("bins", format!("{} lies outside 1..=65536", self.bins));
        }
        if let Some(n) = self.subsets.iter().find(|n| !Self::SUBSETS.contains(n)) {
            return fail(
                "subsets",
                format!(
                    "{n} is no subset of the 10x10 grid of spots; there are {:?}",
                    Self::SUBSETS
                ),
            );
        }
        if !self.subsets.is_sorted_by(|a, b| a < b) {
            return fail(
                "subsets",
                format!("{:?} must name each once, ascending", self.subsets),
            );
        }
        let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        if let Some(name) = self
            .strategy
            .keys()
            .find(|n| n.is_empty() || !n.chars().all(plain))
        {
            return fail(
                "strategy",
                format!("{name:?} is no name such as light_vertices"),
            );
        }
        match self.budget {
            Budget::Samples(n) if !(2..=1_048_576).contains(&n) => fail(
                "samples",
                format!("{n} lies outside 2..=1048576 paths per pixel"),
            ),
            Budget::Error(e) if !(e > 0.0 && e < 1.0) => fail(
                "error",
                format!("{e} must lie between 0 and 1, e.g. 0.1 for 10 %"),
            ),
            _ if self.max_bounces == 1 => fail(
                "max_bounces",
                "1 keeps nothing but the spots; use 0 (all) or at least 2".into(),
            ),
            _ => Ok(()),
        }
    }
}
