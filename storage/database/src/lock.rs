//! One coordinator for one SQLite catalog: an exclusive lock on a file beside the database. The system
//! releases it when the process ends, however it ends.

use std::{
    fs::{File, OpenOptions, TryLockError},
    io::{Read, Seek, SeekFrom, Write},
    path::Path,
};

use picofarm_catalog::CatalogError;

/// Held while the catalog is open.
#[derive(Debug)]
pub(crate) struct CatalogLock(
    #[expect(dead_code, reason = "the lock lives as long as the file")] File,
);

impl CatalogLock {
    /// Takes the lock of the database at `path` for `holder`, words that tell people who has it.
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
                // Who holds it is a courtesy; the lock itself is the fact.
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
