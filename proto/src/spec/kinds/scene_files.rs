//! Scenes that are files: their list, pinned by content, and how they are read.

use serde::{Deserialize, Serialize};

use crate::{
    show,
    spec::spec_error::{SpecError, within},
};

/// A scene file, pinned by its content.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "SceneFileText")]
pub struct SceneFile {
    /// Path on the workers.
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

/// Which scene files a key counts, where scenes are files.
#[derive(Debug, Clone, Copy)]
pub(super) enum FilesIn<'a> {
    /// All of the job's: the key of a stage.
    All,
    /// A scene's own: the key of a scene, which the other files do not shape.
    One(&'a SceneFile),
    /// None: what the scenes of a list and of its corrected form have in common.
    None,
}

/// How scene files are read, and what replaces their camera, laser and unit.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct FileView {
    /// The camera of the file by name, or by number from 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<String>,
    /// The position of the camera, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub look_from: Option<[f64; 3]>,
    /// A point in the middle of the image, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub look_at: Option<[f64; 3]>,
    /// The direction that is upwards in the image; `None` = +y.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up: Option<[f64; 3]>,
    /// The unit of length of the file, one of [`Self::UNITS`]; `None` = the format's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// Whether the job's spots replace the laser of a file that has one.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub replace_laser: bool,
    /// Whether 25 spots are spread over what the camera sees, if a grid would miss much of it.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub spread_spots: bool,
}

impl FileView {
    /// The units of length.
    pub const UNITS: [&str; 5] = ["m", "cm", "mm", "in", "ft"];

    /// Returns the first given field with its name, for kinds of scenes that have none of them.
    pub(super) fn given(&self) -> Option<&'static str> {
        let Self {
            camera,
            look_from,
            look_at,
            up,
            unit,
            replace_laser,
            spread_spots,
        } = self;
        let all = [
            ("camera", camera.is_some()),
            ("look_from", look_from.is_some()),
            ("look_at", look_at.is_some()),
            ("up", up.is_some()),
            ("unit", unit.is_some()),
            ("replace_laser", *replace_laser),
            ("spread_spots", *spread_spots),
        ];
        all.into_iter()
            .find(|(_, given)| *given)
            .map(|(name, _)| name)
    }

    pub(super) fn check(&self) -> Result<(), SpecError> {
        let points = [
            ("look_from", self.look_from),
            ("look_at", self.look_at),
            ("up", self.up),
        ];
        for (field, point) in points {
            for x in point.into_iter().flatten() {
                within(format!("scenes.{field}"), x, (-1e6, 1e6), "metres")?;
            }
        }
        if self.look_from.is_some() && self.look_from == self.look_at {
            let what = "is the same point as scenes.look_from; expected another point";
            return Err(SpecError::new("scenes.look_at", what));
        }
        if self.up.is_some_and(|up| up == [0.0; 3]) {
            let what = "is [0, 0, 0]; expected a direction, such as [0, 1, 0]";
            return Err(SpecError::new("scenes.up", what));
        }
        match &self.unit {
            Some(unit) if !Self::UNITS.contains(&&**unit) => Err(SpecError::new(
                "scenes.unit",
                show::unknown(unit, &Self::UNITS),
            )),
            _ => Ok(()),
        }
    }
}
