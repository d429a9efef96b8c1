//! Tiny Python packages in a folder, for tests that install packages without a network.

use std::{ffi::OsStr, path::Path, process::Command};

const WRITE: &str = include_str!("wheels.py");

/// Writes wheels of `tiny` 1.0 and 2.0, and of `user` 1.0, which needs `tiny`, into `folder`.
/// Returns the variables by which pip and uv find these and no others, or `None` if `python` cannot
/// make environments.
///
/// # Panics
/// If the wheels cannot be written.
pub fn write(python: &OsStr, folder: &Path) -> Option<[(&'static str, String); 4]> {
    let run = |script: &str| {
        let mut command = Command::new(python);
        let status = command.args(["-c", script]).arg(folder).status();
        status.is_ok_and(|status| status.success())
    };
    if !run("import venv, ensurepip") {
        eprintln!("SKIPPED: this Python cannot make virtual environments (python3-venv)");
        return None;
    }
    assert!(run(WRITE), "the wheels cannot be written");
    let wheels = folder.display().to_string();
    Some([
        ("PIP_NO_INDEX", "1".into()),
        ("PIP_FIND_LINKS", wheels.clone()),
        ("UV_NO_INDEX", "1".into()),
        ("UV_FIND_LINKS", wheels),
    ])
}
