//! Checks whether a location is writable without creating it.

use std::{
    path::{Path as Folder, PathBuf},
    time::Duration,
};

use super::{local::local_path, open_store, place::Place, probe};
use crate::error::StorageError;

/// A writable location.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Writable {
    /// It exists, and is safe for several writers.
    There,
    /// The folder does not exist. The first writer creates it in this existing, writable folder.
    New(PathBuf),
}

/// Checks whether a location is writable, with a timeout. Leaves no files, and does not create a
/// missing folder.
///
/// # Errors
/// Those of [`super::open_store`] and [`probe`].
pub async fn check_writable(location: &str, within: Duration) -> Result<Writable, StorageError> {
    if let Some(ground) = local_ground(location)?
        && ground != local_path(location)?
    {
        return try_file(&ground).map(|()| Writable::New(ground));
    }
    let (store, prefix) = open_store(location)?;
    probe(&*store, &prefix, within).await?;
    Ok(Writable::There)
}

/// Returns the deepest existing folder of a local location; `None` for network stores.
///
/// # Errors
/// [`StorageError::UnsupportedStore`].
pub fn local_ground(location: &str) -> Result<Option<PathBuf>, StorageError> {
    if Place::parse(location)?.is_some() {
        return Ok(None);
    }
    let path = local_path(location)?;
    let there = path.ancestors().find(|p| p.exists());
    Ok(Some(there.unwrap_or(Folder::new("/")).to_owned()))
}

/// Creates a file in a folder and deletes it.
fn try_file(folder: &Folder) -> Result<(), StorageError> {
    let path = folder.join(format!("{}{}", super::PROBE, uuid::Uuid::new_v4()));
    let failed = |e| StorageError::io("write to", folder, e);
    std::fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(&path)
        .map_err(failed)?;
    std::fs::remove_file(&path).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PROBE_WITHIN;

    #[tokio::test]
    async fn a_folder_that_does_not_exist_is_not_made() {
        let folder = tempfile::tempdir().unwrap();
        let there = folder.path().display().to_string();
        assert_eq!(
            check_writable(&there, PROBE_WITHIN).await.unwrap(),
            Writable::There
        );
        let new = folder.path().join("a/b");
        let found = check_writable(&new.display().to_string(), PROBE_WITHIN)
            .await
            .unwrap();
        assert_eq!(found, Writable::New(folder.path().to_owned()));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        for bad in [file.clone(), file.join("x")] {
            check_writable(&bad.display().to_string(), PROBE_WITHIN)
                .await
                .unwrap_err();
        }
        assert!(check_writable("ftp://host/x", PROBE_WITHIN).await.is_err());
    }
}
