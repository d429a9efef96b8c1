//! Makes a task's scene: generates it from the task's own seed, or reads it from a file pinned by
//! its hash.

use std::path::{Path, PathBuf};

use picofarm_files::Opener;
use picofarm_proto::{
    key::scene_seed,
    spec::{FileView, SceneFile, SceneKind, SceneSource},
};
use picofarm_scene::{
    Aim, AssetLibrary, Scene, SceneError, Vec3,
    furnished::{self, FurnishedSettings},
    import::{self, Bounds, ImportOptions, View},
    primitive::{self, PrimitiveSettings},
};
use picofarm_settings::Resolution;
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

/// Returns the scene of task `index`, with an image of the given size and the job's spots.
pub(crate) fn scene(
    source: &SceneSource,
    size: Resolution,
    index: u64,
    (libraries, files): With<'_>,
) -> Result<Scene, TaskError> {
    let seed = scene_seed(source.seed, index);
    let Resolution { width, height } = size;
    let fov_deg = source.fov_deg.unwrap_or(90.0) as f32;
    match &source.kind {
        SceneKind::Furnished {
            assets,
            min_specular,
            floor_plan,
        } => {
            let library = library(assets, libraries)?;
            let settings = FurnishedSettings {
                spots: source.spots.clone(),
                laser_m: source.laser_m.map(|x| x as f32),
                width,
                height,
                fov_deg,
                assets: library.name().to_owned(),
                specular_at_least: *min_specular,
                floor_plan: *floor_plan,
            };
            furnished::generate(seed, &settings, library).map_err(scene_error)
        }
        SceneKind::Primitive { rooms } => {
            let settings = PrimitiveSettings {
                spots: source.spots.clone(),
                laser_m: source.laser_m.map(|x| x as f32),
                width,
                height,
                fov_deg,
                rooms: *rooms,
            };
            primitive::generate(seed, &settings).map_err(scene_error)
        }
        SceneKind::Files { root, view, .. } => {
            let bounds = Bounds {
                files: files.clone(),
                root: root.as_ref().map(PathBuf::from),
            };
            let at = format!("scenes.files[{index}]");
            let file = source.kind.file(index).ok_or_else(|| not_listed(&at))?;
            let aim = Aim::of(&source.spots, seed)
                .map_err(|what| TaskError::User(format!("scenes.spots: {what}")))?;
            let mut options = options(view, source.fov_deg, aim);
            // A square image shows the whole view of the camera, whatever its shape.
            options.size = (!size.is_square()).then_some(size);
            let mut scene = read(file, &at, source.spots.count(), &options, &bounds)?;
            let i = &mut scene.camera.intrinsics;
            *i = i.resized(width, height);
            Ok(scene)
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

/// Returns how a job's files are read.
fn options(view: &FileView, fov_deg: Option<f64>, aim: Aim) -> ImportOptions {
    let point = |p: [f64; 3]| Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32);
    let (laser, spots_if_none) = match (view.replace_laser, view.spread_spots) {
        (true, _) => (Some(aim), None),
        (false, false) => (None, Some(aim)),
        (false, true) => (None, None),
    };
    ImportOptions {
        view: View {
            camera: view.camera.clone(),
            from: view.look_from.map(point),
            at: view.look_at.map(point),
            fov_deg: fov_deg.map(|x| x as f32),
            up: view.up.map(point),
        },
        laser,
        spots_if_none,
        // The job's check knows the same units.
        unit: view.unit.as_ref().and_then(|unit| unit.parse().ok()),
        ..ImportOptions::default()
    }
}

/// Reads a scene file after checking its hash.
fn read(
    file: &SceneFile,
    at: &str,
    spots: u32,
    options: &ImportOptions,
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
    let scene = import::read_scene_with(path, options, bounds).map_err(|e| named(at, e))?;
    let beams = scene.laser.beams.len();
    if beams == spots as usize {
        return Ok(scene);
    }
    let path = &file.path;
    Err(TaskError::User(
        match scene.provenance.notes.contains_key("chosen.laser") {
            true => format!(
                "{at}: the camera sees so little of {path} that {beams} of {spots} spots find a place; set scenes.look_from, \
                 scenes.look_at or scenes.fov_deg, or leave the file out"
            ),
            false => format!(
                "{at}: {path} has a laser of {beams} beams, but the job says scenes.spots = {spots}; set scenes.spots to \
                 {beams}, or scenes.replace_laser = true to use the job's spots"
            ),
        },
    ))
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
