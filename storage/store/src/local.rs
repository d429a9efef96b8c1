//! Stores in a local folder: their paths, and the unfinished files left by killed writers.

use std::fs::Metadata;
use std::io::ErrorKind;
use std::path::{Path as Folder, PathBuf};
use std::time::{Duration, SystemTime};

use object_store::path::Path;

use super::probe::PROBE;
use crate::error::StorageError;

/// Returns the path of a local location.
pub(super) fn local_path(url_or_path: &str) -> Result<PathBuf, StorageError> {
    let unsupported = |what: &str| StorageError::UnsupportedStore {
        url: url_or_path.to_string(),
        what: what.to_string(),
    };
    if let Some(meant) = mistyped(url_or_path) {
        return Err(unsupported(&format!(
            "is no folder and no URL; did you mean {meant}? (a folder of that name is ./{url_or_path})"
        )));
    }
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
        Some((scheme, _)) => {
            return Err(unsupported(&format!(
                "the scheme {scheme} is not supported; use a local path, a file:// URL, s3://bucket/prefix, gs://bucket/prefix or az://container/prefix"
            )));
        }
    };
    if path.as_os_str().is_empty() {
        return Err(unsupported("expected a path, found nothing"));
    }
    std::path::absolute(&path).map_err(|e| StorageError::io("resolve", &path, e))
}

/// Returns the URL that was probably meant if a text begins like one but has too few slashes:
/// `s3:/bucket/x` would be a folder named `s3:`.
fn mistyped(text: &str) -> Option<String> {
    let (scheme, rest) = text.split_once(':')?;
    let slashes = match &*scheme.to_ascii_lowercase() {
        "s3" | "gs" | "az" => "//",
        "file" => "///",
        _ => return None,
    };
    let known = scheme
        .chars()
        .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit());
    let whole = known && rest.starts_with("//");
    (!whole).then(|| {
        let scheme = scheme.to_ascii_lowercase();
        format!("{scheme}:{slashes}{}", rest.trim_start_matches('/'))
    })
}

/// Returns the unfinished files left by killed writers in a local data set, of at least the given
/// age, with their sizes. A put to a local store writes `name#1` next to the object and links it
/// when complete, so a kill leaves such a file. It is invisible to the store and harmless, but
/// takes up space. The age must be longer than any put takes.
///
/// # Errors
/// [`StorageError::Io`].
pub fn leftovers(folder: &Folder, min_age: Duration) -> Result<Vec<(PathBuf, u64)>, StorageError> {
    let mut folders = vec![folder.to_owned()];
    let mut found = Vec::new();
    while let Some(folder) = folders.pop() {
        for (path, meta) in entries(&folder)? {
            if meta.is_dir() {
                folders.push(path);
            } else if is_staged(&path) && is_old(&meta, min_age) {
                found.push((path, meta.len()));
            }
        }
    }
    found.sort();
    Ok(found)
}

/// Like [`leftovers`], for files of killed probes in the store's folder itself: `.probe-…#1`.
///
/// # Errors
/// [`StorageError::Io`].
pub fn probe_leftovers(
    folder: &Folder,
    min_age: Duration,
) -> Result<Vec<(PathBuf, u64)>, StorageError> {
    let mut found: Vec<_> = entries(folder)?
        .into_iter()
        .filter(|(path, meta)| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            meta.is_file() && name.starts_with(PROBE) && is_staged(path) && is_old(meta, min_age)
        })
        .map(|(path, meta)| (path, meta.len()))
        .collect();
    found.sort();
    Ok(found)
}

fn entries(folder: &Folder) -> Result<Vec<(PathBuf, Metadata)>, StorageError> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| StorageError::io("list", folder, e))? {
        let entry = entry.map_err(|e| StorageError::io("list", folder, e))?;
        let path = entry.path();
        match entry.metadata() {
            Ok(meta) => found.push((path, meta)),
            // The file was finished in the meantime.
            Err(e) if e.kind() == ErrorKind::NotFound => {}
            Err(e) => return Err(StorageError::io("look up", &path, e)),
        }
    }
    Ok(found)
}

fn is_staged(path: &Folder) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let number = name.rsplit_once('#').map(|(_, number)| number);
    number.is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
}

fn is_old(meta: &Metadata, min_age: Duration) -> bool {
    let age = meta
        .modified()
        .ok()
        .and_then(|at| SystemTime::now().duration_since(at).ok());
    age.is_some_and(|age| age >= min_age)
}
