//! Downloads Sweet Home 3D's furniture from Debian, with the distribution's own client.

use std::{
    io::ErrorKind,
    path::{Path, PathBuf},
    process::Command,
};

use crate::SceneError;

/// The Debian package that contains the furniture.
const PACKAGE: &str = "sweethome3d-furniture";
/// The folder of the libraries within the package.
pub(super) const INSIDE_PACKAGE: &str = "usr/share/sweethome3d/furniture";
/// The folder of this asset source inside an assets folder.
pub(super) const FOLDER: &str = "sweethome3d";

/// Downloads the package (about 120 MB) with `apt-get download`, unpacks it with `dpkg-deb`, and
/// stores its `.sh3f` files in `dest/sweethome3d`. Requires no root privileges. Returns that
/// folder. If the folder already has files, nothing is downloaded.
///
/// # Errors
/// [`SceneError::Install`] if a program is missing or fails, with an alternative;
/// [`SceneError::Write`] if the folder cannot be written.
pub fn install(dest: &Path) -> Result<PathBuf, SceneError> {
    let folder = dest.join(FOLDER);
    if !libraries_in(&folder).is_empty() {
        return Ok(folder);
    }
    let partial = dest.join(format!("{FOLDER}.{}.partial", std::process::id()));
    std::fs::create_dir_all(&partial).map_err(|e| cannot_write(&partial, e))?;
    let outcome = fetch(&partial, &folder);
    // The remains of the download belong to this function only and are of no further use.
    let _ = std::fs::remove_dir_all(&partial);
    outcome.map(|()| folder)
}

fn fetch(partial: &Path, folder: &Path) -> Result<(), SceneError> {
    run(Command::new("apt-get")
        .args(["download", PACKAGE])
        .current_dir(partial))?;
    let package = entries(partial)
        .into_iter()
        .find(|p| p.extension().is_some_and(|e| e == "deb"))
        .ok_or_else(|| failed("apt-get download left no .deb file; fetch the package by hand"))?;
    run(Command::new("dpkg-deb")
        .arg("-x")
        .arg(&package)
        .arg(partial))?;
    let inside = partial.join(INSIDE_PACKAGE);
    if libraries_in(&inside).is_empty() {
        return Err(failed(format!(
            "the package has no .sh3f files in {INSIDE_PACKAGE}"
        )));
    }
    std::fs::rename(&inside, folder).map_err(|e| cannot_write(folder, e))
}

fn run(command: &mut Command) -> Result<(), SceneError> {
    let name = command.get_program().to_string_lossy().into_owned();
    let by_hand = format!(
        "fetch Debian's package {PACKAGE} on another machine, unpack it with `dpkg-deb -x`, and put its \
         .sh3f files into <assets>/{FOLDER}"
    );
    let output = command.output().map_err(|e| match e.kind() {
        ErrorKind::NotFound => failed(format!("{name} is not on this machine; {by_hand}")),
        _ => failed(format!("{name} cannot run: {e}; {by_hand}")),
    })?;
    if output.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(failed(format!(
        "{name} failed ({}): {}; run `apt-get update` and try again, or {by_hand}",
        output.status,
        said.trim()
    )))
}

fn failed(what: impl Into<String>) -> SceneError {
    SceneError::Install { what: what.into() }
}

fn cannot_write(path: &Path, source: std::io::Error) -> SceneError {
    SceneError::Write {
        path: path.to_path_buf(),
        source,
    }
}

fn entries(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)
        .map(|dir| dir.filter_map(|e| Some(e.ok()?.path())).collect())
        .unwrap_or_default();
    paths.sort();
    paths
}

/// Returns the `.sh3f` files of a folder, sorted by name; none if it does not exist.
pub(super) fn libraries_in(folder: &Path) -> Vec<PathBuf> {
    entries(folder)
        .into_iter()
        .filter(|p| p.extension().is_some_and(|e| e == "sh3f"))
        .collect()
}
