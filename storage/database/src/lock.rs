//! Ensures that one SQLite catalog has one coordinator, with an exclusive lock on a file next to
//! the database. The operating system releases the lock when the process ends, even if it is
//! killed.

use std::{
    fs::{File, OpenOptions, TryLockError},
    io::{Read, Seek, SeekFrom, Write},
    path::Path,
};

use picofarm_catalog::CatalogError;

/// A lock held while the catalog is open.
#[derive(Debug)]
pub(crate) struct CatalogLock(
    #[expect(dead_code, reason = "the lock lives as long as the file")] File,
);

impl CatalogLock {
    /// Locks the database at `path`. `holder` is a description of this process for people.
    pub(crate) fn take(path: &Path, holder: &str) -> Result<Self, CatalogError> {
        let mut lock_path = path.as_os_str().to_owned();
        lock_path.push(".lock");
        let failed = |what| move |source| CatalogError::file(path, what, source);
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&lock_path)
            .map_err(failed("opening its lock file"))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut text = String::new();
                // The name of the holder is informative only; the lock itself decides.
                let _ = file.read_to_string(&mut text);
                let holder = match text.trim() {
                    "" => "unknown".to_owned(),
                    text => text.to_owned(),
                };
                return Err(CatalogError::Held {
                    path: path.to_owned(),
                    holder,
                });
            }
            Err(TryLockError::Error(e)) => return Err(failed("locking it")(e)),
        }
        file.set_len(0)
            .and_then(|()| file.seek(SeekFrom::Start(0)))
            .and_then(|_| writeln!(file, "{holder}"))
            .map_err(failed("writing its lock file"))?;
        Ok(Self(file))
    }
}
