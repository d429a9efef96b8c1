//! Makes a task's scene: generates it from the task's own seed, or reads it from a file pinned by
//! its hash.

use std::path::{Path, PathBuf};

use picofarm_files::Opener;
use picofarm_proto::{
    key::scene_seed,
    spec::{SceneFile, SceneKind, SceneSource},
};
use picofarm_scene::{
    Aim, AssetLibrary, Scene, SceneError,
    furnished::{self, FurnishedSettings},
    import::{self, Bounds, ImportOptions},
    primitive::{self, PrimitiveSettings},
};
use tracing::info;

use crate::{errors::scene_error, task::TaskError};

/// Inputs for making scenes: the installed furniture, and the opener of scene files.
pub(crate) type With<'a> = (&'a [AssetLibrary], &'a Opener);

/// Names of the supported furniture libraries.
const LIBRARIES: [&str; 3] = ["parametric", "sweethome3d", "gltf"];

/// Finds the furniture libraries on this machine. A missing library is not an error, because jobs
/// that need it run on other workers.
pub(crate) fn find_libraries(dirs: &[PathBuf]) -> Vec<AssetLibrary> {
    LIBRARIES
        .iter()
        .filter_map(|name| match AssetLibrary::find(name, dirs) {
            Ok(library) => {
                info!(
                    library = name,
                    fingerprint = library.fingerprint(),
                    models = library.len(),
                    "furniture at hand"
                );
                Some(library)
            }
            Err(why) => {
                info!(library = name, %why, "furniture not at hand");
                None
            }
        })
        .collect()
}

/// Returns the scene of task `index`, with an image of `side` pixels and the job's spots.
pub(crate) fn scene(
    source: &SceneSource,
    side: u32,
    index: u64,
    (libraries, files): With<'_>,
) -> Result<Scene, TaskError> {
    let seed = scene_seed(source.seed, index);
    match &source.kind {
        SceneKind::Furnished {
            assets,
            min_specular,
        } => {
            let library = library(assets, libraries)?;
            let settings = FurnishedSettings {
                spots: source.spots.clone(),
                laser_m: source.laser_m.map(|x| x as f32),
                width: side,
                height: side,
                fov_deg: source.fov_deg as f32,
                assets: library.name().to_owned(),
                specular_at_least: *min_specular,
            };
            furnished::generate(seed, &settings, library).map_err(scene_error)
        }
        SceneKind::Primitive { rooms } => {
            let settings = PrimitiveSettings {
                spots: source.spots.clone(),
                laser_m: source.laser_m.map(|x| x as f32),
                width: side,
                height: side,
                fov_deg: source.fov_deg as f32,
                rooms: *rooms,
            };
            primitive::generate(seed, &settings).map_err(scene_error)
        }
        SceneKind::Files { root, .. } => {
            let bounds = Bounds {
                files: files.clone(),
                root: root.as_ref().map(PathBuf::from),
            };
            let at = format!("scenes.files[{index}]");
            let file = source.kind.file(index).ok_or_else(|| not_listed(&at))?;
            let aim = Aim::of(&source.spots, seed)
                .map_err(|what| TaskError::User(format!("scenes.spots: {what}")))?;
            read(file, &at, (&aim, side), &bounds)
        }
    }
}

/// A lease brings the files of its own tasks.
pub(crate) fn not_listed(at: &str) -> TaskError {
    TaskError::User(format!("{at}: the job lists no such file; submit it again"))
}

fn library<'a>(
    fingerprint: &str,
    libraries: &'a [AssetLibrary],
) -> Result<&'a AssetLibrary, TaskError> {
    let found = libraries.iter().find(|l| l.fingerprint() == fingerprint);
    found.ok_or_else(|| {
        let here: Vec<_> = libraries.iter().map(AssetLibrary::fingerprint).collect();
        TaskError::User(format!(
            "scenes.assets: furniture {fingerprint:?} is not on this worker's machine (it has {}); run \
             `picofarm assets install` there, or set assets = \"parametric\" in the job",
            here.join(", ")
        ))
    })
}

/// Reads a scene file after checking its hash, and sets the job's resolution.
fn read(
    file: &SceneFile,
    at: &str,
    (aim, side): (&Aim, u32),
    bounds: &Bounds,
) -> Result<Scene, TaskError> {
    let path = Path::new(&file.path);
    let found = import::fingerprint(path, bounds).map_err(|e| named(at, e))?;
    if found != file.sha256 {
        return Err(TaskError::User(format!(
            "{at}: {} has SHA-256 {found}, but the job was submitted with {}; put the old file back, or use the new one: \
             `picofarm job retry` makes a new job of it, which takes over the scenes that are finished",
            file.path, file.sha256
        )));
    }
    let mut scene = with_laser(path, aim, bounds).map_err(|e| named(at, e))?;
    scene.camera.intrinsics = scene.camera.intrinsics.resized(side, side);
    let (beams, spots) = (scene.laser.beams.len(), aim.film().len());
    if beams != spots {
        return Err(TaskError::User(format!(
            "{at}: {} has a laser of {beams} beams, but the job says scenes.spots = {spots}; set scenes.spots to {beams}, \
             or remove the laser from the file to use the job's spots",
            file.path
        )));
    }
    Ok(scene)
}

/// Reads a scene with its own laser, or with a laser aimed as the job specifies if it has none.
fn with_laser(path: &Path, aim: &Aim, bounds: &Bounds) -> Result<Scene, SceneError> {
    let options = ImportOptions {
        spots_if_none: Some(aim.clone()),
        ..ImportOptions::default()
    };
    import::read_scene_with(path, &options, bounds)
}

/// Adds the scene's field in the job to an error.
fn named(at: &str, error: SceneError) -> TaskError {
    match scene_error(error) {
        TaskError::User(text) => TaskError::User(format!("{at}: {text}")),
        TaskError::Interrupted(text) => TaskError::Interrupted(format!("{at}: {text}")),
        other => other,
    }
}

#[cfg(test)]
mod tests;
