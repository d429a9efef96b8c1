//! What a generate task does: a scene, written as a file for other programs. (Rendering needs no such files: it makes its
//! scenes itself, and names its results by what makes them.)

use serde::{Deserialize, Serialize};

use super::{
    job::{SpecError, place},
    render::{SceneKind, SceneSource},
};

/// Writing generated scenes as files: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GenerateTask {
    /// Which scenes; not files.
    pub scenes: SceneSource,
    /// Where and how they are written.
    pub generate: GenerateSettings,
}

/// Where and how generated scenes are written.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GenerateSettings {
    /// A path or URL that every worker can reach; scene 7 becomes `000007.glb` or `000007/scene.xml` in it.
    pub dest: String,
    /// `glb` (default) or `mitsuba`.
    #[serde(default = "glb")]
    pub format: String,
    /// Width and height of the camera's image in pixels (default 256).
    #[serde(default = "side")]
    pub resolution: u32,
    /// Version of generators and writers, part of every task key; filled in at submission where left out.
    #[serde(default)]
    pub version: String,
}

fn glb() -> String {
    "glb".into()
}

fn side() -> u32 {
    256
}

impl GenerateTask {
    pub(super) fn check(&self) -> Result<(), SpecError> {
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
        if !["glb", "mitsuba"].contains(&&**format) {
            return fail(
                "generate.format",
                format!("{format:?} is not one of \"glb\", \"mitsuba\""),
            );
        }
        if !(1..=4096).contains(resolution) {
            let what = format!("{resolution} lies outside 1..=4096 pixels");
            return fail("generate.resolution", what);
        }
        match dest.is_empty() {
            true => fail("generate.dest", "is empty; give a path or URL".into()),
            false => Ok(()),
        }
    }

    pub(super) fn check_places(&self) -> Result<(), SpecError> {
        place("generate.dest", &self.generate.dest)
    }
}
