//! Reads files named by the user: only regular files up to a maximum size. A pipe, a device or a
//! folder is rejected by name, because reading it could block or never end.

use std::{io::Read, path::Path};

use picofarm_files::{FileError, Opener};

use crate::error::{CliError, Result, io};

/// Maximum size of a settings file, in bytes.
pub const SETTINGS: u64 = 1 << 20;
/// Maximum size of a job file or a list of names, in bytes. Equals the maximum size of a message to
/// the coordinator.
pub const LISTS: u64 = 64 << 20;
/// Maximum size of a file of weights, in bytes.
#[cfg(feature = "networks")]
pub const WEIGHTS: u64 = 64 << 30;

/// Reads a file of at most `most` bytes.
///
/// # Errors
/// Fails if the file cannot be read, is not a regular file, or is larger.
pub fn read(path: &Path, most: u64) -> Result<Vec<u8>> {
    Opener::anywhere().read(path, most).map_err(|e| match e {
        FileError::Io { source, .. } => match source.kind() {
            std::io::ErrorKind::InvalidInput | std::io::ErrorKind::InvalidData => {
                CliError::input(format!("{}: {source}", path.display()))
            }
            _ => io(path.display(), &source),
        },
        refused => CliError::input(refused),
    })
}

/// Reads a text file of at most `most` bytes.
///
/// # Errors
/// Fails like [`read`], and if the file is not UTF-8.
pub fn read_text(path: &Path, most: u64) -> Result<String> {
    text(read(path, most)?, path)
}

/// Reads at most `most` bytes of text from standard input.
///
/// # Errors
/// Fails if standard input cannot be read, is larger, or is not UTF-8.
pub fn read_stdin(most: u64) -> Result<String> {
    let name = Path::new("standard input");
    let mut bytes = Vec::new();
    let mut input = std::io::stdin().lock().take(most + 1);
    input
        .read_to_end(&mut bytes)
        .map_err(|e| io(name.display(), &e))?;
    if bytes.len() as u64 > most {
        let what = format!("standard input: is larger than {most} bytes");
        return Err(CliError::input(what));
    }
    text(bytes, name)
}

fn text(bytes: Vec<u8>, path: &Path) -> Result<String> {
    String::from_utf8(bytes).map_err(|_| {
        CliError::input(format!(
            "{}: is not a text file; expected UTF-8",
            path.display()
        ))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Code;

    #[test]
    fn what_is_not_a_regular_file_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        let large = folder.path().join("large");
        std::fs::write(&large, [b'x'; 11]).unwrap();
        for path in [&pipe, Path::new("/dev/zero"), folder.path(), &large] {
            let error = read_text(path, 10).unwrap_err();
            assert_eq!(error.code, Code::Input);
            let name = path.display().to_string();
            assert!(error.message.starts_with(&name), "{}", error.message);
        }
        let missing = read_text(&folder.path().join("missing"), 10).unwrap_err();
        assert_eq!(missing.code, Code::Input);
    }
}
