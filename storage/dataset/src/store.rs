//! Stores from a path or URL, the check that a store is safe for several writers, and what killed writers leave.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures::future::join_all;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};

use crate::error::DatasetError;
use crate::objects;

/// Writers racing in [`probe`].
const RACERS: usize = 16;

/// The store and the prefix in it for a local path or a `file://` URL. The folder need not exist. Writes are flushed to
/// the disk before they count, so that a manifest that exists after a power cut has its objects.
///
/// # Errors
/// [`DatasetError::UnsupportedStore`] for other schemes and paths that cannot be object keys.
pub fn open_store(url_or_path: &str) -> Result<(Arc<dyn ObjectStore>, Path), DatasetError> {
    let path = local_path(url_or_path)?;
    let unsupported = |what: String| DatasetError::UnsupportedStore {
        url: url_or_path.to_string(),
        what,
    };
    let prefix = Path::from_absolute_path(&path)
        .map_err(|e| unsupported(format!("cannot be the prefix of object keys: {e}")))?;
    Ok((Arc::new(LocalFileSystem::new().with_fsync(true)), prefix))
}

fn local_path(url_or_path: &str) -> Result<PathBuf, DatasetError> {
    let unsupported = |what: &str| DatasetError::UnsupportedStore {
        url: url_or_path.to_string(),
        what: what.to_string(),
    };
    let path = match url_or_path.split_once("://") {
        None => PathBuf::from(url_or_path),
        Some(("file", rest)) if rest.starts_with('/') => {
            let decoded = Path::from_url_path(rest)
                .map_err(|e| unsupported(&format!("not a usable file URL: {e}")))?;
            PathBuf::from(format!("/{decoded}"))
        }
        Some(("file", _)) => {
            return Err(unsupported(
                "expected file:///absolute/path, with three slashes",
            ));
        }
        Some(("s3", _)) => {
            return Err(unsupported(
                "S3 is not supported by this version; use a local path or a file:// URL",
            ));
        }
        Some((scheme, _)) => {
            return Err(unsupported(&format!(
                "the scheme {scheme} is not supported; use a local path or a file:// URL"
            )));
        }
    };
    if path.as_os_str().is_empty() {
        return Err(unsupported("expected a path, found nothing"));
    }
    std::path::absolute(&path).map_err(|e| DatasetError::io("resolve", &path, e))
}

/// Checks that the store keeps the promise on which publishing rests: of several create-only puts to one key exactly
/// one succeeds, and its bytes stay. One after the other, then sixteen at once. Leaves nothing behind.
///
/// # Errors
/// [`DatasetError::UnsafeStore`] says which promise was broken; [`DatasetError::Store`] where the store refuses
/// altogether (read-only, full, no permission).
pub async fn probe(store: &dyn ObjectStore, prefix: &Path) -> Result<(), DatasetError> {
    let name = |part: &str| {
        prefix
            .clone()
            .join(format!(".probe-{}-{part}", uuid::Uuid::new_v4()))
    };
    let (sequential, race) = (name("sequential"), name("race"));
    let result = probe_at(store, prefix, &sequential, &race).await;
    for path in [&sequential, &race] {
        match store.delete(path).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => {}
            // The probe's own finding comes first.
            Err(e) if result.is_ok() => {
                return Err(DatasetError::store(
                    "delete",
                    objects::shown(store, path),
                    e,
                ));
            }
            Err(_) => {}
        }
    }
    result
}

async fn probe_at(
    store: &dyn ObjectStore,
    prefix: &Path,
    sequential: &Path,
    race: &Path,
) -> Result<(), DatasetError> {
    let broken = |what: String| DatasetError::UnsafeStore {
        prefix: objects::shown(store, prefix),
        what,
    };
    if !objects::create(store, sequential, Bytes::from_static(b"first")).await? {
        return Err(broken("a create-only put to a new key was refused".into()));
    }
    if objects::create(store, sequential, Bytes::from_static(b"second")).await? {
        return Err(broken(
            "a create-only put to an existing key succeeded".into(),
        ));
    }
    if objects::require(store, sequential).await? != Bytes::from_static(b"first") {
        return Err(broken(
            "a refused create-only put changed the object".into(),
        ));
    }
    let body = |i: usize| Bytes::from(format!("racer {i:02}").repeat(512));
    let racers = (0..RACERS).map(|i| objects::create(store, race, body(i)));
    let mut winners = Vec::new();
    for (i, won) in join_all(racers).await.into_iter().enumerate() {
        if won? {
            winners.push(i);
        }
    }
    let [winner] = winners[..] else {
        return Err(broken(format!(
            "{} of {RACERS} simultaneous create-only puts to one key succeeded, exactly one should",
            winners.len()
        )));
    };
    if objects::require(store, race).await? != body(winner) {
        return Err(broken(
            "the object does not hold the bytes of the put that succeeded".into(),
        ));
    }
    Ok(())
}

/// The unfinished files that killed writers left in a local data set, of at least the given age. A put to a local
/// store writes `name#1` beside the object and links it when complete, so a kill leaves such a file; it is invisible
/// to the store, disturbs nobody and only takes up space. Give an age longer than any put takes.
///
/// # Errors
/// [`DatasetError::UnsupportedStore`] where the location is not local; [`DatasetError::Io`].
pub fn local_leftovers(url_or_path: &str, min_age: Duration) -> Result<Vec<PathBuf>, DatasetError> {
    let mut folders = vec![local_path(url_or_path)?];
    let mut found = Vec::new();
    while let Some(folder) = folders.pop() {
        let entries =
            std::fs::read_dir(&folder).map_err(|e| DatasetError::io("list", &folder, e))?;
        for entry in entries {
            let entry = entry.map_err(|e| DatasetError::io("list", &folder, e))?;
            let path = entry.path();
            let meta = match entry.metadata() {
                Ok(meta) => meta,
                // Finished while we looked.
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => continue,
                Err(e) => return Err(DatasetError::io("look up", &path, e)),
            };
            if meta.is_dir() {
                folders.push(path);
                continue;
            }
            let name = entry.file_name();
            let staged = name
                .to_string_lossy()
                .rsplit_once('#')
                .is_some_and(|(_, number)| {
                    !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit())
                });
            let age = meta
                .modified()
                .ok()
                .and_then(|at| SystemTime::now().duration_since(at).ok());
            if staged && age.is_some_and(|age| age >= min_age) {
                found.push(path);
            }
        }
    }
    found.sort();
    Ok(found)
}
