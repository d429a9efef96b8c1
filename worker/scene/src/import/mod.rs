//! Reading scenes from files: glTF 2.0 (`.glb`, `.gltf`), Mitsuba 3 (XML, and its dictionary as JSON), PLY meshes and
//! the reference scenes' JSON.

mod buffers;
mod far;
mod fingerprint;
mod gltf_file;
mod image;
mod mitsuba;
mod obj;
mod ply;
pub(crate) mod polygon;
mod reference;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use picofarm_files::{FileError, Opener};

use crate::{Aim, Camera, Scene, SceneError};

pub use fingerprint::fingerprint;
pub use reference::read_reference_json;

/// What the caller states where a file does not, or wants otherwise.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ImportOptions {
    /// Use this camera in place of the file's.
    pub camera: Option<Camera>,
    /// Beams aimed so over the camera's view, in place of the file's laser.
    pub laser: Option<Aim>,
    /// Put a camera in front of a lone mesh (PLY) where no camera is stated: 60°, on its +z side, seeing all of it.
    pub frame: bool,
}

/// Where a scene file may lie, and where the files that it names.
#[derive(Debug, Clone, Default)]
pub struct Bounds {
    /// Opens the scene file, and what it names.
    pub files: Opener,
    /// The folder that also holds everything the scene file names; `None` = the scene file's own folder.
    pub root: Option<PathBuf>,
}

impl Bounds {
    /// What opens the files that the scene file at `path` names.
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

/// Reads a scene with its own camera and laser, and files from its own folder only; see [`read_scene_with`].
///
/// # Errors
/// As [`read_scene_with`].
pub fn read_scene(path: &Path) -> Result<Scene, SceneError> {
    read_scene_with(path, &ImportOptions::default(), &Bounds::default())
}

/// Reads a scene by its content: `glTF` magic or a JSON object with `asset` is glTF, `ply` a lone mesh, XML or a
/// JSON object with `"type": "scene"` a Mitsuba scene, and a JSON object with `meshes` and `spots` a reference scene.
///
/// Files written by [`crate::export`] come back exactly. Of other glTF files, metals become GGX conductors with
/// α = roughness², metals in part a mix, everything else Lambertian with the base colour, all two-sided; base
/// colour textures are read. The camera is the first camera node; its image gets 64 rows (see
/// [`crate::Intrinsics::resized`]). The laser comes from `laser_spots` or `laser_directions` in a node's extras,
/// or from `options`. A material's extras may state its `spectrum`.
///
/// Of Mitsuba 3, this is understood: sensor `perspective`; shapes `ply`, `obj`, `rectangle`, `cube`, `disk` and
/// `sphere`; BSDFs `diffuse`, `roughconductor`, `conductor`, `twosided`, and `blendbsdf` of all these, nested
/// too; `dielectric` and `thindielectric`; `bitmap` textures, and spectra over wavelengths as reflectances. Beams are
/// emitters `projector` of `fov` ≤ 2° (or `spot` of `cutoff_angle` ≤ 1°) that start at one place; a shape's category is its id up to the
/// first `.`. A PLY needs camera and laser from `options`. Whatever a format holds that our scenes do not is named in
/// the provenance's notes, under keys that start with `import.`, or refused.
///
/// # Errors
/// [`SceneError::Read`] for a file (also a buffer file) that cannot be read, [`SceneError::Refused`] for one outside
/// `bounds`, [`SceneError::Format`] naming file and field otherwise. No error quotes a file that is none of these formats.
pub fn read_scene_with(
    path: &Path,
    options: &ImportOptions,
    bounds: &Bounds,
) -> Result<Scene, SceneError> {
    let bytes = read_file(&bounds.files, path)?;
    let files = &bounds.of_scene(path);
    let mut scene = if bytes.starts_with(b"glTF") {
        gltf_file::read(path, &bytes, options, files)?
    } else if ply::is_ply(&bytes) {
        ply::read(path, &bytes, options)?
    } else if is_xml(&bytes) {
        mitsuba::read_xml(path, &bytes, options, files)?
    } else {
        match sniff(path, &bytes)? {
            Kind::Gltf => gltf_file::read(path, &bytes, options, files)?,
            Kind::Reference => reference::parse(path, &bytes)?,
            Kind::Mitsuba => mitsuba::read_dictionary(path, &bytes, options, files)?,
        }
    };
    if let Some(camera) = options.camera {
        scene.camera = camera;
    }
    if let Some(aim) = &options.laser {
        scene.laser = aim.laser(&scene.camera);
    }
    validated(path, scene)
}

/// One glTF file as one mesh in its own frame, with the notes on what was dropped; its numbers are unchecked.
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

/// True for text that starts like XML.
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
                    .json), PLY (.ply) or a reference scene (.json)";
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

/// Largest file read, bytes.
const MAX_FILE_BYTES: u64 = 8 << 30;

/// A regular file's bytes: a path inside a scene file may name anything, devices too.
fn read_file(files: &Opener, path: &Path) -> Result<Vec<u8>, SceneError> {
    files.read(path, MAX_FILE_BYTES).map_err(of_file)
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

/// Longest message on a file, and longest note, letters.
const MAX_MESSAGE: usize = 1000;
/// Letters of a file's own text that a message quotes.
const MAX_QUOTE: usize = 80;

/// A message, cut where it is too long to be read.
fn shortened(mut message: String) -> String {
    if let Some((end, _)) = message.char_indices().nth(MAX_MESSAGE) {
        message.truncate(end);
        message.push('…');
    }
    message
}

/// Most notes on a file.
const MAX_NOTES: usize = 256;

/// Adds a note. Keys and texts may have names of the file in them, and a file may have any number
/// of these.
fn add_note(notes: &mut BTreeMap<String, String>, key: &str, what: String) {
    let key: String = key.chars().take(2 * MAX_QUOTE).collect();
    match notes.len() < MAX_NOTES || notes.contains_key(&key) {
        true => notes.insert(key, shortened(what)),
        false => notes.insert("more".into(), "there are too many notes to list".into()),
    };
}

/// Text of a file in quotes, cut where it is long.
fn quoted(text: &str) -> String {
    match text.char_indices().nth(MAX_QUOTE) {
        None => format!("{text:?}"),
        Some((end, _)) => format!("{:?}… ({} bytes)", &text[..end], text.len()),
    }
}

/// The scene if the renderer can use it; otherwise an error that names the file too.
fn validated(path: &Path, scene: Scene) -> Result<Scene, SceneError> {
    match scene.validate() {
        Ok(()) => Ok(scene),
        Err(SceneError::Invalid { field, what, .. }) => {
            Err(format_error(path, format!("{field}: {what}")))
        }
        Err(other) => Err(other),
    }
}
