//! What a render task does: which scenes, rendered how.

use picofarm_settings::{Budget, Gate, Strategy};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{Declared, Fields, Results, TaskKind, TaskSpec};
use crate::{
    key::StageKey,
    model::{
        limits::check_count,
        memory::{Known, LIGHT_PATHS, Rendering, Shape},
        places::OutputSettings,
        spec_error::{SpecError, within},
        text::{RenderSettingsText, SceneSourceText, check_share},
    },
};

/// Names of furniture that stand for whatever a machine has of it.
const LIBRARIES: [&str; 5] = ["", "auto", "parametric", "sweethome3d", "gltf"];

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

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_one(n: &u32) -> bool {
    *n == 1
}

impl RenderTask {
    /// Most ranges that a scene is divided into.
    pub const MAX_PARTS: u32 = 1024;

    /// What tasks `lo..hi` need of this: of a list of files only its own.
    pub(super) fn some(&self, lo: u64, hi: u64) -> Self {
        let kind = match &self.scenes.kind {
            SceneKind::Files { files, first, root } => {
                let at = |i: u64| usize::try_from(i.saturating_sub(*first)).unwrap_or(usize::MAX);
                let own = files.get(at(lo)..at(hi).min(files.len()));
                SceneKind::Files {
                    files: own.unwrap_or_default().to_vec(),
                    first: lo.max(*first),
                    root: root.clone(),
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

    /// The key of the stage.
    pub fn stage_key(&self) -> StageKey {
        StageKey::of(self.shaping())
    }
}

impl Declared for RenderTask {
    const NAME: &'static str = "render";
    const FIELDS: &'static [&'static str] = &["scenes", "render", "output", "parts"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            scenes: fields.required("scenes")?,
            render: fields.or_default("render")?,
            output: fields.required("output")?,
            parts: fields.optional("parts")?.unwrap_or(1),
        })
    }
}

impl TaskKind for RenderTask {
    fn versioned(&self) -> (&'static str, &str) {
        ("render.renderer", &self.render.renderer)
    }

    fn version_mut(&mut self) -> Option<&mut String> {
        Some(&mut self.render.renderer)
    }

    fn check(&self) -> Result<(), SpecError> {
        self.scenes.check()?;
        self.render.check()?;
        let unit = "parts of a scene; 1 leaves it whole";
        within("parts", self.parts, (1, Self::MAX_PARTS), unit)?;
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

    /// File scenes count by content and position, not by path; the place where results go does not count, nor the number
    /// of parts.
    fn shaping(&self) -> Value {
        json!({
            "task": "render",
            "scenes": self.scenes.shaping(),
            "seed": self.scenes.seed,
            "fov_deg": self.scenes.fov_deg,
            "spots": self.scenes.spots,
            "render": self.render,
            "profile": self.output.profile,
        })
    }

    fn results(&self) -> Results<'_> {
        Results::scenes(&self.output)
    }

    fn memory(&self, _known: &Known, threads: u32) -> Option<f64> {
        let rendering = Rendering::of(self, threads);
        let parts = match self.parts {
            1 => 0.0,
            _ => rendering.images() + rendering.paths() * LIGHT_PATHS,
        };
        Some(rendering.coded() + parts)
    }

    fn tasks(&self) -> u64 {
        self.scenes.count
    }

    fn only(&self, lo: u64, hi: u64) -> Option<TaskSpec> {
        Some(TaskSpec::Render(self.some(lo, hi)))
    }

    fn scenes(&self) -> Option<&SceneSource> {
        Some(&self.scenes)
    }

    fn inputs(&self, task: Option<u64>) -> Vec<(String, &str)> {
        let SceneKind::Files { files, first, root } = &self.scenes.kind else {
            return Vec::new();
        };
        let root = root.iter().map(|root| ("scenes.root".to_owned(), &**root));
        let files = files.iter().zip(*first..);
        let named = files.filter(|(_, i)| task.is_none_or(|task| *i == task));
        let named = named.map(|(file, i)| (format!("scenes.files[{i}]"), &*file.path));
        root.chain(named).collect()
    }

    fn stores_mut(&mut self) -> Vec<(&'static str, &mut String)> {
        vec![("output.store", &mut self.output.store)]
    }

    fn writes(&self) -> Option<(&String, &String)> {
        Some((&self.output.store, &self.output.dataset))
    }

    fn shape(&self, _source: Option<Shape>) -> Option<Shape> {
        Some(Shape {
            height: self.render.resolution,
            width: self.render.resolution,
            bins: self.render.bins,
            spots: self.scenes.spots,
        })
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
        /// Folder that holds everything the scene files name (meshes, buffers, textures); without, each scene file's own.
        #[serde(skip_serializing_if = "Option::is_none")]
        root: Option<String>,
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
            Self::Files { files, first, .. } => {
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
    /// The renderer's ways of finding light that are chosen by hand; the others are left to the renderer.
    #[serde(skip_serializing_if = "Strategy::is_default")]
    pub strategy: Strategy,
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
            strategy: Strategy::default(),
        }
    }
}

impl RenderSettings {
    /// The recorded interval.
    pub fn gate(&self) -> Gate {
        Gate {
            start_m: self.gate_start_m,
            bin_width_m: self.bin_width_m,
            bins: self.bins,
        }
    }
}

impl SceneSource {
    /// What shapes the scenes, but for seed, field of view and spots, as keys know it.
    pub(super) fn shaping(&self) -> Value {
        match &self.kind {
            SceneKind::Furnished {
                assets,
                min_specular,
            } => json!({"kind": "furnished", "assets": assets, "min_specular": min_specular}),
            SceneKind::Primitive => json!({"kind": "primitive"}),
            SceneKind::Files { files, .. } => json!({
                "kind": "files",
                "sha256": files.iter().map(|f| f.sha256.as_str()).collect::<Vec<_>>(),
            }),
        }
    }

    /// Checks what a client must have filled in before it submits.
    ///
    /// # Errors
    /// [`SpecError`] naming the field.
    pub(in crate::model) fn check_resolved(&self) -> Result<(), SpecError> {
        match &self.kind {
            SceneKind::Furnished { assets, .. } if LIBRARIES.contains(&&**assets) => {
                Err(SpecError::new(
                    "scenes.assets",
                    format!(
                        "{assets:?} is not a fingerprint; the client must resolve it (e.g. to \"parametric-1\") before it submits"
                    ),
                ))
            }
            SceneKind::Files { files, .. } => match files.iter().find(|f| f.sha256.len() != 64) {
                Some(file) => Err(SpecError::new(
                    "scenes.files",
                    format!(
                        "{:?} has no SHA-256; the client must hash each file before it submits",
                        file.path
                    ),
                )),
                None => Ok(()),
            },
            _ => Ok(()),
        }
    }

    /// The numbers of laser spots there are: grids of up to 10×10.
    pub const SPOTS: [u32; 5] = [1, 4, 16, 25, 100];

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
        // What the generators can furnish: beyond, walls or furniture leave the view.
        let degrees = "degrees from left to right";
        within("scenes.fov_deg", self.fov_deg, (20.0, 120.0), degrees)?;
        Self::check_spots(self.spots).map_err(|what| SpecError::new("scenes.spots", what))?;
        match &self.kind {
            SceneKind::Furnished { min_specular, .. } => within(
                "scenes.min_specular",
                *min_specular,
                (0, 16),
                "mirrors a room at least; more find no wall",
            ),
            _ => Ok(()),
        }
    }

    /// Checks a number of laser spots: they lie on a square grid.
    ///
    /// # Errors
    /// What numbers there are.
    pub fn check_spots(spots: u32) -> Result<(), String> {
        match Self::SPOTS.contains(&spots) {
            true => Ok(()),
            false => Err(format!(
                "{spots} is no number of spots; there are grids of 1, 4, 16, 25 and 100"
            )),
        }
    }
}

impl RenderSettings {
    /// The subsets of the 10×10 grid of spots there are.
    pub const SUBSETS: [u32; 2] = [4, 25];

    /// Most pixels of an image's side.
    pub const MAX_SIDE: u32 = 4096;

    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("render.{field}"), what));
        within(
            "render.resolution",
            self.resolution,
            (1, Self::MAX_SIDE),
            "pixels a side",
        )?;
        // Light that has gone 10 km comes from no room.
        let start = "metres of optical path (there and back); 1 ns of delay is 0.3 m";
        within("render.gate_start_m", self.gate_start_m, (0.0, 1e4), start)?;
        // From a hundredth of a picosecond to 33 ns: both ends are beyond any detector. Picoseconds taken for metres are not
        // in it.
        let width = "metres of optical path; 1 ps is 0.0002998 m, so 128 ps are 0.0384";
        within("render.bin_width_m", self.bin_width_m, (1e-6, 10.0), width)?;
        within("render.bins", self.bins, (1, 65_536), "bins")?;
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
        match self.budget {
            Budget::Samples(n) => {
                let unit = "paths a pixel; two at least, to estimate their error";
                within("render.samples", n, (2, 1_048_576), unit)?;
            }
            Budget::Error(e) => {
                check_share(e).map_err(|what| SpecError::new("render.error", what))?
            }
        }
        match self.max_bounces {
            1 => fail(
                "max_bounces",
                "1 keeps nothing but the spots; use 0 (all) or at least 2".into(),
            ),
            n => within("render.max_bounces", n, (0, 1_000_000), "bounces; 0 is all"),
        }
    }
}
