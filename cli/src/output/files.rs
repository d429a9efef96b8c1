//! Writes pictures and pages to files.

use picofarm_figures::Canvas;

use crate::error::{CliError, Code, Result, io};

fn cannot_write(path: &std::path::Path, error: impl std::fmt::Display) -> CliError {
    CliError::new(
        Code::Resource,
        format!("cannot write {}: {error}", path.display()),
    )
    .hint("check the folder and the free space, then run the same command again")
}

/// Writes a picture as PNG, completely or not at all.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn save(canvas: &Canvas, path: &std::path::Path) -> Result<()> {
    write_atomically(path, &canvas.png())
}

/// Writes a file completely or not at all.
pub(crate) fn write_atomically(path: &std::path::Path, bytes: &[u8]) -> Result<()> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    // Another process may write the same file at the same time.
    let partial = path.with_file_name(format!(".{name}.{}.partial", uuid::Uuid::new_v4()));
    std::fs::write(&partial, bytes)
        .and_then(|()| std::fs::rename(&partial, path))
        .map_err(|e| {
            // The partial file belongs to this process; failing to remove it loses nothing.
            let _ = std::fs::remove_file(&partial);
            cannot_write(path, e)
        })
}

/// Rejects early a folder that the writer would reject after the render.
///
/// # Errors
/// Fails if the folder is not empty, or cannot be read.
pub fn free_folder(out: &std::path::Path) -> Result<()> {
    let taken = match std::fs::read_dir(out) {
        Ok(mut entries) => entries.next().is_some(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => false,
        Err(e) => return Err(io(format!("--out {}", out.display()), &e)),
    };
    if taken {
        return Err(
            CliError::input(format!("--out {}: the folder is not empty", out.display()))
                .hint("name a new folder; nothing is overwritten"),
        );
    }
    Ok(())
}
