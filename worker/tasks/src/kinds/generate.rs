//! Generate: writes a scene as a file for other programs. The scene is always regenerated and
//! compared with the existing file, because generating takes less time than verifying its origin.

use bytes::Bytes;
use picofarm_files::Opener;
use picofarm_proto::spec::{GenerateTask, SceneSource, SpecError};
use picofarm_scene::{Scene, SceneError, export};
use picofarm_settings::Resolution;
use picofarm_store::publish_files;
use sha2::{Digest, Sha256};
use tracing::info;

use crate::{
    errors::scene_error,
    input::scenes,
    submission::Submission,
    task::{Context, Control, Output, RunTask, Task, TaskError},
};

/// Version of the format of the written files.
const FILES_VERSION: &str = "scene-files-2";

/// Returns the version of all code of this program that determines a scene file's bytes.
pub fn generator_version() -> String {
    format!(
        "{}/{}/{FILES_VERSION}",
        picofarm_scene::furnished::GENERATOR_VERSION,
        picofarm_scene::primitive::GENERATOR_VERSION,
    )
}

impl RunTask for GenerateTask {
    fn code_version() -> String {
        generator_version()
    }

    /// Writes scene `task.index` of the job.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, libraries, spec) = (&context.stores, &context.libraries, self);
        let settings = &spec.generate;
        let source: &SceneSource = &spec.scenes;
        let scene = scenes::scene(
            source,
            Resolution::square(settings.resolution),
            task.index,
            // Generated scenes refer to no files.
            (libraries, &Opener::anywhere()),
        )?;
        if !control.at(0.5) {
            return Err(TaskError::Stopped);
        }
        let name = format!("{:06}", task.index);
        let files = match &*settings.format {
            "mitsuba" => mitsuba(&scene, &name)?,
            _ => {
                let bytes = export::glb_bytes(&scene).map_err(scene_error)?;
                vec![(format!("{name}.glb"), bytes.into())]
            }
        };
        let dest = ("generate.dest", &*settings.dest);
        let (store, prefix) = stores.probed_own(dest, is_scene_file, control)?;
        stores.patiently(control, async || {
            publish_files(&*store, &prefix, &files).await
        })?;
        let mut hash = Sha256::new();
        for (name, bytes) in &files {
            hash.update(name);
            hash.update(Sha256::digest(bytes));
        }
        info!(scene = scene.name, files = files.len(), "scene written");
        control.at(1.0);
        Ok(Output {
            manifest_sha256: hex::encode(hash.finalize()),
            bytes: files.iter().map(|(_, bytes)| bytes.len() as u64).sum(),
            adopted: false,
        })
    }

    fn resolve(&mut self, here: &Submission<'_>) -> Result<(), SpecError> {
        here.scenes(&mut self.scenes)
    }
}

/// Returns whether a name is that of a generated scene: `000007.glb`, or the folder `000007`.
fn is_scene_file(name: &str) -> bool {
    let number = name.strip_suffix(".glb").unwrap_or(name);
    number.len() >= 6 && number.bytes().all(|b| b.is_ascii_digit())
}

/// Returns the files of a scene for Mitsuba, below `name`. The file that refers to the others comes
/// last.
fn mitsuba(scene: &Scene, name: &str) -> Result<Vec<(String, Bytes)>, TaskError> {
    let failed = |e: std::io::Error| {
        TaskError::Interrupted(format!(
            "a folder for temporary files: {e}; set TMPDIR to one that has room"
        ))
    };
    let folder = tempfile::tempdir().map_err(failed)?;
    let of_write = |e: SceneError| match e {
        SceneError::Write { .. } => TaskError::Interrupted(e.to_string()),
        other => scene_error(other),
    };
    export::write_mitsuba(scene, &folder.path().join("scene.xml")).map_err(of_write)?;
    let mut files = Vec::new();
    for part in ["meshes", "textures", ""] {
        let mut paths = Vec::new();
        for entry in std::fs::read_dir(folder.path().join(part)).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if path.is_file() {
                paths.push(path);
            }
        }
        paths.sort();
        for path in paths {
            let below = path.strip_prefix(folder.path()).expect("it lies in it");
            let below = below.to_str().expect("we named it");
            files.push((
                format!("{name}/{below}"),
                std::fs::read(&path).map_err(failed)?.into(),
            ));
        }
    }
    Ok(files)
}
