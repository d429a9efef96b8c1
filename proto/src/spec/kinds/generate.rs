//! Generation: writes scenes as files for other programs. One task a scene. Rendering needs no such
//! files, because it generates its scenes itself and keys its results by their settings.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut},
    kind::{Declared, Dispatch, Manifest, Results, TaskKind},
    render::RenderSettings,
    scene_files::FilesIn,
    scenes::{SceneKind, SceneSource},
};
use crate::{
    show,
    spec::{
        destination::Destination,
        memory::{BASE, Known},
        spec_error::{SpecError, within},
    },
};

/// Writes generated scenes as files: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GenerateTask {
    /// The scenes; not files.
    pub scenes: SceneSource,
    /// The destination and form of the files.
    pub generate: GenerateSettings,
}

/// The destination and form of generated scenes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GenerateSettings {
    /// A path or URL that every worker can reach. Scene 7 becomes `000007.glb` or
    /// `000007/scene.xml` in it.
    pub dest: String,
    /// `glb` (default) or `mitsuba`.
    #[serde(default = "glb")]
    pub format: String,
    /// Width and height of the camera's image in pixels (default 256).
    #[serde(default = "side")]
    pub resolution: u32,
    /// Version of generators and writers, part of every task key; filled in at submission if
    /// omitted.
    #[serde(default)]
    pub version: String,
}

const FORMATS: [&str; 2] = ["glb", "mitsuba"];

fn glb() -> String {
    "glb".into()
}

fn side() -> u32 {
    256
}

impl Declared for GenerateTask {
    const NAME: &'static str = "generate";
    const FIELDS: &'static [&'static str] = &["scenes", "generate"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            scenes: fields.required("scenes")?,
            generate: fields.required("generate")?,
        })
    }
}

impl TaskKind for GenerateTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("generate.version", &self.generate.version),
            scenes: Some(&self.scenes),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.generate.version),
            scenes: Some(&mut self.scenes),
            stores: vec![("generate.dest", &mut self.generate.dest)],
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        self.scenes.check()?;
        let fail = |field: &str, what: String| Err(SpecError::new(field, what));
        if let SceneKind::Files { .. } = self.scenes.kind {
            return fail(
                "scenes.kind",
                "\"files\" are there already; `picofarm scene export` converts one".into(),
            );
        }
        let GenerateSettings {
            dest,
            format,
            resolution,
            ..
        } = &self.generate;
        if !FORMATS.contains(&&**format) {
            return fail("generate.format", show::unknown(format, &FORMATS));
        }
        let side = (1, RenderSettings::MAX_SIDE);
        within("generate.resolution", *resolution, side, "pixels a side")?;
        match dest.is_empty() {
            true => fail("generate.dest", "is empty; give a path or URL".into()),
            false => Ok(()),
        }
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "generate",
            "scenes": self.scenes.shaping(FilesIn::All),
            "seed": self.scenes.seed,
            "fov_deg": self.scenes.shaping_fov(),
            "spots": self.scenes.spots,
            "format": self.generate.format,
            "resolution": self.generate.resolution,
            "version": self.generate.version,
        })
    }

    fn results(&self) -> Results<'_> {
        Results {
            field: "generate.dest",
            store: &self.generate.dest,
            folder: "/scenes".into(),
            destination: Destination::folder("generate.dest", &self.generate.dest, ""),
            manifest: match &*self.generate.format {
                "glb" => Manifest::Gltf,
                _ => Manifest::None,
            },
        }
    }

    /// The scene is counted with the program.
    fn memory(&self, _known: &Known, _threads: u32) -> Option<f64> {
        Some(BASE)
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.scenes.count,
            ..Dispatch::default()
        }
    }
}
