//! Files that a person names: regular files only, of at most a size. A pipe, a device or a folder
//! is refused by its name rather than waited for or read for ever.

use std::path::Path;

use picofarm_files::{FileError, Opener};

use crate::error::{CliError, Result, io};

/// Largest file of settings, bytes.
pub const SETTINGS: u64 = 1 << 20;
/// Largest job file or list of names, bytes: as large as a message to the coordinator may be.
pub const LISTS: u64 = 64 << 20;
/// Largest file of weights, bytes.
#[cfg(feature = "networks")]
pub const WEIGHTS: u64 = 64 << 30;

/// Reads a file of at most `most` bytes.
///
/// # Errors
/// The file cannot be read, is not a regular file, or is larger.
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
/// As [`read`]; the file is not UTF-8.
pub fn read_text(path: &Path, most: u64) -> Result<String> {
    String::from_utf8(read(path, most)?).map_err(|_| {
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
