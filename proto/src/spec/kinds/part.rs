//! Parts of heavy scenes. Several workers share one scene, and its render stage joins their
//! results.

use serde::Serialize;
use serde_json::{Value, json};

use super::{
    division::Division,
    fields::Fields,
    io::{Io, IoMut, Makes},
    kind::{Declared, Dispatch, Manifest, Results, TaskKind},
    render::RenderTask,
};
use crate::{
    key::hash::TaskKey,
    spec::{
        destination::Destination,
        memory::{BASE, Known, LIGHT_PATHS},
        spec_error::SpecError,
    },
};

/// Renders parts of scenes, which the dependent stage joins: one task a part.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PartTask {
    /// The rendering.
    #[serde(flatten)]
    pub whole: RenderTask,
}

impl PartTask {
    /// Returns the division of scenes into tasks.
    pub fn division(&self) -> Division {
        Division {
            parts: self.whole.parts,
        }
    }
}

impl Declared for PartTask {
    const NAME: &'static str = "part";
    const FIELDS: &'static [&'static str] = &["scenes", "render", "output", "parts", "joined_by"];
    /// Written in job files as a render stage with `parts`.
    const WRITTEN: bool = false;

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        // Jobs in older catalogs have it: the key of the stage that joins the parts, which `whole`
        // says too.
        fields.optional::<String>("joined_by")?;
        Ok(Self {
            whole: RenderTask::read(fields)?,
        })
    }

    fn only(&self, lo: u64, hi: u64) -> Option<Self> {
        let each = self.division().tasks_per_scene();
        Some(Self {
            whole: self.whole.some(lo / each, hi.div_ceil(each)),
        })
    }
}

impl TaskKind for PartTask {
    fn io(&self) -> Io<'_> {
        Io {
            makes: Makes::Nothing,
            tasks_per_scene: self.division().tasks_per_scene(),
            ..self.whole.io()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        self.whole.io_mut()
    }

    fn check(&self) -> Result<(), SpecError> {
        self.whole.check()
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "part",
            "whole": self.whole.stage_key().to_string(),
            "parts": self.whole.parts,
        })
    }

    /// That of the scene that the parts are joined to.
    fn scene_key(&self, scene: u64) -> Option<TaskKey> {
        self.whole.scene_key(scene)
    }

    fn results(&self) -> Results<'_> {
        let whole = &self.whole.output;
        Results {
            field: "output.store",
            store: &whole.store,
            folder: format!("{}/parts", whole.dataset),
            destination: Destination::output(&self.whole.output),
            manifest: Manifest::Part {
                dataset: &whole.dataset,
                whole: &self.whole,
                division: self.division(),
            },
        }
    }

    fn memory(&self, _known: &Known, threads: u32) -> Option<f64> {
        let rendering = self.whole.rendering(threads);
        let share = 1.0 / f64::from(self.whole.parts.max(1));
        // Tiles are cut out of the image, and written.
        let tiles = 3.0 * share * rendering.images() + rendering.tiles();
        let paths = 3.0 * LIGHT_PATHS * rendering.paths();
        let kept = rendering.shape.truth() + tiles.max(paths);
        Some(BASE + rendering.with_scene(kept))
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.whole.scenes.count * self.division().tasks_per_scene(),
            ..Dispatch::default()
        }
    }
}
