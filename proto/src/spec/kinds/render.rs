//! Rendering: the scenes and the render settings. One task a scene.

use picofarm_settings::{Budget, Spots};
use serde::Serialize;
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Results, TaskKind},
    scene_files::FilesIn,
};
use crate::{
    key::hash::{StageKey, TaskKey, task_key},
    spec::{
        memory::{Known, LIGHT_PATHS, Rendering, Shape},
        places::OutputSettings,
        spec_error::{SpecError, within},
    },
};

mod settings;

pub use super::scenes::{FileView, SceneFile, SceneKind, SceneSource};
pub use settings::{RenderSettings, parse_share};

/// Renders scenes into a data set: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RenderTask {
    /// The scenes.
    pub scenes: SceneSource,
    /// The render settings.
    pub render: RenderSettings,
    /// The destination of results.
    pub output: OutputSettings,
    /// Number of ranges of tiles into which each scene is divided, so that several workers share
    /// it; 1 means not divided. The result is bit-identical.
    #[serde(skip_serializing_if = "is_one")]
    pub parts: u32,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_one(n: &u32) -> bool {
    *n == 1
}

impl RenderTask {
    /// Most ranges into which a scene is divided.
    pub const MAX_PARTS: u32 = 1024;

    /// Returns the task with its list of files reduced to those of tasks `lo..hi`.
    pub(super) fn some(&self, lo: u64, hi: u64) -> Self {
        let kind = match &self.scenes.kind {
            SceneKind::Files {
                files,
                first,
                root,
                view,
            } => {
                let at = |i: u64| usize::try_from(i.saturating_sub(*first)).unwrap_or(usize::MAX);
                let own = files.get(at(lo)..at(hi).min(files.len()));
                SceneKind::Files {
                    files: own.unwrap_or_default().to_vec(),
                    first: lo.max(*first),
                    root: root.clone(),
                    view: view.clone(),
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

    /// Returns the values that determine a task's memory.
    pub(super) fn rendering(&self, threads: u32) -> Rendering {
        let render = &self.render;
        let spots = self.scenes.spots.count();
        Rendering {
            shape: Shape {
                height: render.resolution.height,
                width: render.resolution.width,
                bins: render.bins,
                spots,
            },
            histograms: 1 + render.subsets.len() as u32 + if render.per_spot { spots } else { 0 },
            split: false,
            light_paths: render.max_bounces != 1,
            triangles: self.scenes.kind.triangles(),
            threads,
        }
    }

    /// Returns the task, with the profile `auto` replaced by one that is enough for the render's
    /// error.
    pub(in crate::spec) fn new(
        scenes: SceneSource,
        render: RenderSettings,
        mut output: OutputSettings,
        parts: Option<u32>,
    ) -> Self {
        if output.profile == "auto" {
            output.profile = enough_for(render.budget).into();
        }
        Self {
            scenes,
            render,
            output,
            parts: parts.unwrap_or(1),
        }
    }

    /// Returns the key of the stage.
    pub fn stage_key(&self) -> StageKey {
        StageKey::of(self.shaping())
    }

    /// Everything that shapes the results. File scenes count by content and position, not by path;
    /// the place where results go does not count, nor the number of parts.
    fn described(&self, files: FilesIn<'_>) -> Value {
        json!({
            "task": "render",
            "scenes": self.scenes.shaping(files),
            "seed": self.scenes.seed,
            "fov_deg": self.scenes.shaping_fov(),
            "spots": self.scenes.spots,
            "render": self.render,
            "profile": self.output.profile,
        })
    }
}

impl Declared for RenderTask {
    const NAME: &'static str = "render";
    const FIELDS: &'static [&'static str] = &["scenes", "render", "output", "parts"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        let scenes = fields.required("scenes")?;
        let render = fields.or_default("render")?;
        let output = fields.required("output")?;
        let parts = fields.optional("parts")?;
        Ok(Self::new(scenes, render, output, parts))
    }

    fn only(&self, lo: u64, hi: u64) -> Option<Self> {
        Some(self.some(lo, hi))
    }
}

impl TaskKind for RenderTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("render.renderer", &self.render.renderer),
            scenes: Some(&self.scenes),
            makes: Makes::Scenes(&self.output),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.render.renderer),
            scenes: Some(&mut self.scenes),
            stores: vec![("output.store", &mut self.output.store)],
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        self.scenes.check()?;
        self.render.check()?;
        if self.render.fit_gate && !matches!(self.scenes.kind, SceneKind::Files { .. }) {
            let what = "\"auto\" is for scenes.kind = \"files\"; generated rooms fit the default gate, so leave it out";
            return Err(SpecError::new("render.gate", what));
        }
        let unit = "parts of a scene; 1 leaves it whole";
        within("parts", self.parts, (1, Self::MAX_PARTS), unit)?;
        if self.parts > 1 && matches!(self.render.budget, Budget::Error(_)) {
            let what = "needs render.samples: how many samples render.error takes is decided over the whole image; \
                        `picofarm scene plan` tells how many that would be";
            return Err(SpecError::new("parts", what));
        }
        if self.output.profile == "counts-u16" {
            let what = "\"counts-u16\" stores whole photon counts, and a render has none; use \"sqrt-u16\", or detect \
                        photons in a reprocess stage";
            return Err(SpecError::new("output.profile", what));
        }
        if let [smallest, ..] = self.render.subsets[..]
            && self.scenes.spots != Spots::Grid(100)
        {
            return Err(SpecError::new(
                "render.subsets",
                format!(
                    "{smallest} is a subset of the 10x10 grid, which scenes.spots = {} is not; set scenes.spots = 100, \
                     or leave subsets out",
                    json!(self.scenes.spots)
                ),
            ));
        }
        self.output.check()
    }

    fn check_resolved(&self) -> Result<(), SpecError> {
        match self.render.fit_gate {
            true => Err(SpecError::new(
                "render.gate",
                "is \"auto\"; the client must fit the gate to the files before it submits",
            )),
            false => Ok(()),
        }
    }

    fn remarks(&self) -> Vec<String> {
        self.render.remarks(&self.scenes.kind)
    }

    fn shaping(&self) -> Value {
        self.described(FilesIn::All)
    }

    fn scene_key(&self, scene: u64) -> Option<TaskKey> {
        let stage = match &self.scenes.kind {
            SceneKind::Files { .. } => {
                let own = self.scenes.kind.file(scene)?;
                StageKey::of(self.described(FilesIn::One(own)))
            }
            _ => self.stage_key(),
        };
        Some(task_key(&stage, scene))
    }

    fn files_key(&self) -> Option<StageKey> {
        let files = matches!(self.scenes.kind, SceneKind::Files { .. });
        files.then(|| StageKey::of(self.described(FilesIn::None)))
    }

    fn results(&self) -> Results<'_> {
        Results::scenes(&self.output)
    }

    fn memory(&self, _known: &Known, threads: u32) -> Option<f64> {
        let rendering = self.rendering(threads);
        let parts = match self.parts {
            1 => 0.0,
            // Parts are read, decoded and put into the image one after the other. The allocator
            // still keeps the memory of the previous one.
            _ => 3.0 * rendering.images() + rendering.paths() * LIGHT_PATHS,
        };
        Some(rendering.coded() + parts)
    }

    fn shape(&self, _source: Option<Shape>) -> Option<Shape> {
        Some(Shape {
            height: self.render.resolution.height,
            width: self.render.resolution.width,
            bins: self.render.bins,
            spots: self.scenes.spots.count(),
        })
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.scenes.count,
            ..Dispatch::default()
        }
    }
}

/// Returns the coarsest profile whose error is at most a quarter of the render's own, which then
/// grows by 3 % at most. At a median error of 10 %, the median lit bin of a furnished room is off
/// by 0.62 of its photon noise σ; the square-root code with step Δ by 0.25 Δ σ.
fn enough_for(budget: Budget) -> &'static str {
    let own = match budget {
        Budget::Samples(_) => return "sqrt-u16",
        Budget::Error(share) => 0.62 * share / 0.1,
    };
    let enough = |step: f64| 0.25 * step <= 0.25 * own;
    match (enough(1.0), enough(0.5)) {
        (true, _) => "coarse",
        (_, true) => "balanced",
        _ => "sqrt-u16",
    }
}
