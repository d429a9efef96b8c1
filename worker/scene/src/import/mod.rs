//! Reads scenes from files: glTF 2.0 (`.glb`, `.gltf`), Mitsuba 3 (XML, and its dictionary as
//! JSON), meshes in PLY, OBJ and STL, and the reference scenes' JSON.

mod buffers;
mod complete;
mod far;
mod fingerprint;
mod gltf_file;
mod image;
mod mesh_file;
mod mitsuba;
pub(crate) mod mtl;
mod obj;
mod ply;
pub(crate) mod polygon;
mod reference;
mod stl;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use picofarm_files::{FileError, Opener};
use picofarm_settings::Resolution;

use crate::{Aim, Camera, Object, Provenance, Scene, SceneError, Vec3};

/// The version of what files become. It is part of the key of every render, so a change of
/// geometry, materials or chosen views needs a new one.
pub const IMPORT_VERSION: &str = "files-2";

pub use fingerprint::fingerprint;
pub use reference::read_reference_json;

/// Settings for importing a scene, which complete or replace those of the file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ImportOptions {
    /// The camera that replaces the file's.
    pub camera: Option<Camera>,
    /// Changes to the file's camera, or to the camera that is chosen if the file has none.
    pub view: View,
    /// The aim of beams that replace the file's laser, over the camera's view.
    pub laser: Option<Aim>,
    /// The aim of beams for a file without a laser; `None` = a grid of 25 spots.
    pub spots_if_none: Option<Aim>,
    /// The size of the image; `None` = the camera's own. The width of the view is kept.
    pub size: Option<Resolution>,
    /// The unit of length of the file; `None` = the format's own. For formats without a unit (PLY),
    /// `None` means metres, or millimetres if the scene would measure more than 50 m.
    pub unit: Option<Unit>,
}

/// A view of a scene.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct View {
    /// The camera of the file by name, or by number from 0.
    pub camera: Option<String>,
    /// The position of the camera, metres.
    pub from: Option<Vec3>,
    /// A point in the middle of the image, metres.
    pub at: Option<Vec3>,
    /// The horizontal field of view, degrees.
    pub fov_deg: Option<f32>,
    /// The direction that is upwards in the image; `None` = +y.
    pub up: Option<Vec3>,
}

/// A unit of length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// 1 m.
    Metre,
    /// 0.01 m.
    Centimetre,
    /// 0.001 m.
    Millimetre,
    /// 0.0254 m.
    Inch,
    /// 0.3048 m.
    Foot,
}

impl Unit {
    /// All units with their short names.
    pub const ALL: [(&'static str, Self); 5] = [
        ("m", Self::Metre),
        ("cm", Self::Centimetre),
        ("mm", Self::Millimetre),
        ("in", Self::Inch),
        ("ft", Self::Foot),
    ];

    /// Returns the length in metres.
    pub fn metres(self) -> f32 {
        match self {
            Self::Metre => 1.0,
            Self::Centimetre => 0.01,
            Self::Millimetre => 0.001,
            Self::Inch => 0.0254,
            Self::Foot => 0.3048,
        }
    }
}

impl std::fmt::Display for Unit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let name = Self::ALL.iter().find(|(_, unit)| unit == self);
        f.write_str(name.map_or("m", |(name, _)| name))
    }
}

impl std::str::FromStr for Unit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let known = Self::ALL.iter().find(|(name, _)| *name == text);
        known
            .map(|(_, unit)| *unit)
            .ok_or_else(|| format!("{}: expected m, cm, mm, in or ft", quoted(text)))
    }
}

/// The allowed locations of a scene file and of the files that it names.
#[derive(Debug, Clone, Default)]
pub struct Bounds {
    /// Opens the scene file and the files that it names.
    pub files: Opener,
    /// The folder that contains all files named by the scene file; `None` = the scene file's own
    /// folder.
    pub root: Option<PathBuf>,
}

impl Bounds {
    /// Returns the opener for the files that the scene file at `path` names.
    fn of_scene(&self, path: &Path) -> Opener {
        let own = path.parent().unwrap_or(Path::new(""));
        // The parent of a bare name is the current folder.
        let own = if own.as_os_str().is_empty() {
            Path::new(".")
        } else {
            own
        };
        self.files.within([self.root.as_deref().unwrap_or(own)])
    }
}

/// Returns a scene of the given objects, in metres. Camera and laser are those of `options`, or are
/// chosen as for a file without them.
///
/// # Errors
/// [`SceneError::Invalid`] if there are no triangles, or if the view of `options` is unusable.
pub fn complete(
    name: &str,
    objects: Vec<Object>,
    labels: Vec<String>,
    options: &ImportOptions,
) -> Result<Scene, SceneError> {
    let draft = complete::Draft {
        name: name.to_owned(),
        objects,
        labels,
        cameras: vec![],
        laser: None,
        has_unit: true,
        provenance: Provenance {
            source: "objects".into(),
            ..Provenance::default()
        },
    };
    draft.complete(options).map_err(|what| SceneError::Invalid {
        scene: name.to_owned(),
        field: "objects".into(),
        what,
    })
}

/// Reads a scene with its own camera and laser, and files from its own folder only; see
/// [`read_scene_with`].
///
/// # Errors
/// As for [`read_scene_with`].
pub fn read_scene(path: &Path) -> Result<Scene, SceneError> {
    read_scene_with(path, &ImportOptions::default(), &Bounds::default())
}

/// Reads a scene. The content determines the format: `glTF` magic or a JSON object with `asset` is
/// glTF, `ply` a lone mesh, XML or a JSON object with `"type": "scene"` a Mitsuba scene, and a JSON
/// object with `meshes` and `spots` a reference scene. STL is known by its structure, and OBJ by
/// its extension.
///
/// Files written by [`crate::export`] are restored exactly. In other glTF files, metals become GGX
/// conductors with α = roughness², partial metals a mix, and all other materials Lambertian with
/// the base colour, all two-sided; base colour textures are read. The camera is the first camera
/// node; its image has 64 rows (see [`crate::Intrinsics::resized`]). The laser comes from
/// `laser_spots` or `laser_directions` in a node's extras, or from `options`. A material's extras
/// may define its `spectrum`.
///
/// For Mitsuba 3, the following is supported: sensor `perspective`; shapes `ply`, `obj`,
/// `rectangle`, `cube`, `disk` and `sphere`; BSDFs `diffuse`, `roughconductor`, `conductor`,
/// `twosided`, and `blendbsdf` of all these, nested too; `dielectric` and `thindielectric`;
/// `bitmap` textures, and spectra over wavelengths as reflectances. Beams are emitters `projector`
/// of `fov` ≤ 2° (or `spot` of `cutoff_angle` ≤ 1°) that start at one point; a shape's category is
/// its id up to the first `.`. Camera, laser and unit that neither the file nor `options` state are
/// chosen, with notes under keys that start with `chosen.`. Features of a format
/// that our scenes cannot represent are listed in the provenance's notes, under keys that start
/// with `import.`, or refused.
///
/// # Errors
/// [`SceneError::Read`] for a file (also a buffer file) that cannot be read,
/// [`SceneError::Refused`] for one outside `bounds`, [`SceneError::Format`] naming file and field
/// otherwise. If a file has none of these formats, no error quotes it.
pub fn read_scene_with(
    path: &Path,
    options: &ImportOptions,
    bounds: &Bounds,
) -> Result<Scene, SceneError> {
    let bytes = read_file(&bounds.files, path)?;
    let files = &bounds.of_scene(path);
    if bytes.is_empty() {
        return Err(format_error(path, "is empty; export the scene again"));
    }
    let draft = if bytes.starts_with(b"glTF") {
        gltf_file::read(path, &bytes, options, files)?
    } else if ply::is_ply(&bytes) {
        ply::read(path, &bytes, options)?
    } else if stl::is_stl(&bytes) {
        mesh_file::read_stl(path, &bytes, options)?
    } else if mesh_file::is_obj(path, &bytes) {
        mesh_file::read_obj(path, &bytes, options, files)?
    } else if is_xml(&bytes) {
        mitsuba::read_xml(path, &bytes, options, files)?
    } else {
        match sniff(path, &bytes)? {
            Kind::Gltf => gltf_file::read(path, &bytes, options, files)?,
            Kind::Reference => reference::parse(path, &bytes)?,
            Kind::Mitsuba => mitsuba::read_dictionary(path, &bytes, options, files)?,
        }
    };
    let scene = draft
        .complete(options)
        .map_err(|what| format_error(path, what))?;
    validated(path, scene)
}

/// Reads one glTF file as one mesh in its own frame, with the notes on dropped parts; its numbers
/// are unchecked.
pub(crate) fn read_model(
    path: &Path,
    files: &Opener,
) -> Result<(crate::Mesh, std::collections::BTreeMap<String, String>), SceneError> {
    gltf_file::read_model(path, &read_file(files, path)?, files)
}

enum Kind {
    Gltf,
    Reference,
    Mitsuba,
}

/// Returns whether text starts like XML.
fn is_xml(bytes: &[u8]) -> bool {
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    text.trim_ascii_start().first() == Some(&b'<')
}

fn sniff(path: &Path, bytes: &[u8]) -> Result<Kind, SceneError> {
    #[derive(serde::Deserialize)]
    struct Keys {
        asset: Option<serde::de::IgnoredAny>,
        meshes: Option<serde::de::IgnoredAny>,
        spots: Option<serde::de::IgnoredAny>,
        r#type: Option<serde_json::Value>,
    }
    let expected = "expected binary glTF (.glb), glTF JSON (.gltf), a Mitsuba scene (.xml, or its dictionary as \
                    .json), a mesh (.ply, .obj, .stl) or a reference scene (.json)";
    let keys: Keys = serde_json::from_slice(bytes)
        .map_err(|e| format_error(path, format!("{expected}, found none of them: {e}")))?;
    match (keys.asset, keys.meshes, keys.spots) {
        _ if keys.r#type.is_some_and(|t| t == "scene") => Ok(Kind::Mitsuba),
        (Some(_), _, _) => Ok(Kind::Gltf),
        (None, Some(_), Some(_)) => Ok(Kind::Reference),
        _ => Err(format_error(
            path,
            format!(
                "{expected}; this JSON has neither `asset` (glTF) nor `meshes` and `spots` (reference) nor \
                 `\"type\": \"scene\"` (Mitsuba)"
            ),
        )),
    }
}

/// The greatest size of a file, bytes.
const MAX_FILE_BYTES: u64 = 8 << 30;

/// The beginning of the text that Git LFS leaves in place of a file that it has not fetched.
const LFS_POINTER: &[u8] = b"version https://git-lfs.github.com/spec/";

/// Returns a regular file's bytes. The check is necessary because a path inside a scene file may
/// name anything, devices too.
fn read_file(files: &Opener, path: &Path) -> Result<Vec<u8>, SceneError> {
    let bytes = files.read(path, MAX_FILE_BYTES).map_err(of_file)?;
    match bytes.starts_with(LFS_POINTER) {
        false => Ok(bytes),
        true => Err(format_error(
            path,
            "is a pointer of Git LFS, not the file itself; run `git lfs pull` in its repository",
        )),
    }
}

fn of_file(error: FileError) -> SceneError {
    match error {
        FileError::Io { path, source } => SceneError::Read { path, source },
        refused => SceneError::Refused(refused),
    }
}

fn format_error(path: &Path, what: impl Into<String>) -> SceneError {
    SceneError::Format {
        path: path.to_path_buf(),
        what: shortened(what.into()),
    }
}

/// The greatest length of a message on a file, and of a note, letters.
const MAX_MESSAGE: usize = 1000;
/// The number of letters of a file's own text that a message quotes.
const MAX_QUOTE: usize = 80;

/// Truncates a message of more than [`MAX_MESSAGE`] letters.
fn shortened(mut message: String) -> String {
    if let Some((end, _)) = message.char_indices().nth(MAX_MESSAGE) {
        message.truncate(end);
        message.push('…');
    }
    message
}

/// The greatest number of notes on a file.
const MAX_NOTES: usize = 256;

/// Adds a note. The length is limited, because keys and texts may contain names from the file. The
/// number is limited, because a file may have any number of these.
fn add_note(notes: &mut BTreeMap<String, String>, key: &str, what: String) {
    let key: String = key.chars().take(2 * MAX_QUOTE).collect();
    match notes.len() < MAX_NOTES || notes.contains_key(&key) {
        true => notes.insert(key, shortened(what)),
        false => notes.insert("more".into(), "there are too many notes to list".into()),
    };
}

/// Returns text of a file in quotes, truncated if it is long.
fn quoted(text: &str) -> String {
    match text.char_indices().nth(MAX_QUOTE) {
        None => format!("{text:?}"),
        Some((end, _)) => format!("{:?}… ({} bytes)", &text[..end], text.len()),
    }
}

/// Returns the scene if the renderer can use it, or else an error that also names the file.
fn validated(path: &Path, scene: Scene) -> Result<Scene, SceneError> {
    match scene.validate() {
        Ok(()) => Ok(scene),
        Err(SceneError::Invalid { field, what, .. }) => {
            Err(format_error(path, format!("{field}: {what}")))
        }
        Err(other) => Err(other),
    }
}
