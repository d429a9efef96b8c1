//! Writes the files of a reconstruction, all or none: first to a temporary folder, which is then
//! renamed.

use std::{fs, path::Path};

use super::Made;
use crate::error::{CliError, Code, Result, io};

/// Writes mesh, density and metrics to `out`, which does not exist or is empty.
///
/// # Errors
/// Fails if the folder cannot be written.
pub fn write(out: &Path, made: &Made) -> Result<()> {
    let out = std::path::absolute(out).map_err(|e| io(format!("--out {}", out.display()), &e))?;
    let (Some(parent), Some(name)) = (out.parent(), out.file_name()) else {
        return Err(CliError::input(format!(
            "--out {}: expected a new folder",
            out.display()
        )));
    };
    let failed = |e: std::io::Error| io(format!("--out {}", out.display()), &e);
    fs::create_dir_all(parent).map_err(failed)?;
    let partial = parent.join(format!(
        ".{}.partial-{}",
        name.display(),
        uuid::Uuid::new_v4()
    ));
    let written = into(&partial, made)
        // Replaces an empty folder; fails if it has been filled in the meantime.
        .and_then(|()| fs::rename(&partial, &out).map_err(failed));
    if written.is_err() {
        // The first error is reported. Files that cannot be removed are visible in the folder.
        let _ = fs::remove_dir_all(&partial);
    }
    written
}

fn into(dir: &Path, made: &Made) -> Result<()> {
    let save = |name: &str, bytes: &[u8]| {
        let path = dir.join(name);
        fs::write(&path, bytes).map_err(|e| io(path.display(), &e))
    };
    fs::create_dir_all(dir).map_err(|e| io(dir.display(), &e))?;
    let objects = picofarm_tasks::reconstruct::density(&made.reconstructed)
        .map_err(|e| CliError::new(Code::Resource, e))?;
    for (key, bytes) in &objects {
        let path = dir.join("density.zarr").join(key);
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(|e| io(folder.display(), &e))?;
        }
        fs::write(&path, bytes).map_err(|e| io(path.display(), &e))?;
    }
    save("mesh.ply", &made.mesh.ply())?;
    save("mesh.glb", &made.glb)?;
    save("views.png", &made.views.png())?;
    save("orbit.gif", &made.orbit)?;
    let text = serde_json::to_string_pretty(&made.metrics).expect("metrics are plain data");
    save("metrics.json", (text + "\n").as_bytes())
}
