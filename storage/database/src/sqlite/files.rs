//! Checks whether the files of an open database are still those at its path. On Unix, a deleted or
//! replaced file continues to exist for processes that have it open. SQLite would continue to write
//! into it, and nobody would ever read those writes.
//!
//! Such a catalog is not used: no request is answered from it, and the coordinator is not ready.
//! The coordinator continues by itself when the original files are back (moved away and back
//! again). It does not touch another file at the same path, because this may be an incomplete copy,
//! or older than what workers have been promised. The administrator who put it there must restart
//! the coordinator.

use std::{
    io,
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
};

/// Device and inode number of a file.
type Identity = (u64, u64);

/// The files of an open database.
#[derive(Debug)]
pub(super) struct Files {
    path: PathBuf,
    main: Option<Identity>,
    /// The write-ahead log, which contains the latest commits.
    log: Option<Identity>,
}

fn identity(path: &Path) -> Result<Option<Identity>, String> {
    match std::fs::metadata(path) {
        Ok(file) => Ok(Some((file.dev(), file.ino()))),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(format!("{} cannot be seen ({error})", path.display())),
    }
}

fn log_of(path: &Path) -> PathBuf {
    let mut log = path.as_os_str().to_owned();
    log.push("-wal");
    log.into()
}

impl Files {
    /// Records the identities of the files that were just opened.
    pub(super) fn open_at(path: &Path) -> Result<Self, String> {
        Ok(Self {
            path: path.to_owned(),
            main: identity(path)?,
            log: identity(&log_of(path))?,
        })
    }

    /// Checks that the files at the path are those that were opened.
    ///
    /// # Errors
    /// A description of the difference, and what to do about it.
    pub(super) fn check(&self) -> Result<(), String> {
        let now = identity(&self.path)?;
        if now.is_none() {
            return Err(
                "the file was deleted or moved away while the coordinator has it open; put that file back, or stop the \
                 coordinator and restore a backup: a new one would know nothing of what was done"
                    .into(),
            );
        }
        if now != self.main {
            return Err(
                "another file has taken its place while the coordinator has it open; put the former one back, or stop the \
                 coordinator and start it again to use the new one"
                    .into(),
            );
        }
        if self.log.is_some() && identity(&log_of(&self.path))? != self.log {
            return Err(
                "its write-ahead log (-wal) was deleted or replaced while the coordinator has it open; stop the coordinator, \
                 which writes what the log held into the database, and start it again"
                    .into(),
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_very_same_files_will_do() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.db");
        std::fs::write(&path, "a").unwrap();
        std::fs::write(log_of(&path), "b").unwrap();
        let files = Files::open_at(&path).unwrap();
        assert_eq!(files.check(), Ok(()));
        let away = folder.path().join("away");
        std::fs::rename(&path, &away).unwrap();
        assert!(files.check().unwrap_err().contains("deleted"));
        std::fs::copy(&away, &path).unwrap();
        assert!(files.check().unwrap_err().contains("another file"));
        std::fs::rename(&away, &path).unwrap();
        assert_eq!(files.check(), Ok(()), "back again");
        std::fs::remove_file(log_of(&path)).unwrap();
        assert!(files.check().unwrap_err().contains("-wal"));
    }
}
