//! The files of a scene, which are read as a whole and recorded with their SHA-256.

use std::cell::RefCell;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use picofarm_files::{FileError, Opener};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::ImportError;

/// Maximum size in bytes of a file read as a whole.
const MOST: u64 = 16 << 30;

/// A source file of a scene.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct SourceFile {
    /// Path relative to the imported folder, with `/` as separator.
    pub name: String,
    /// Size in bytes.
    pub bytes: u64,
    /// SHA-256, in hexadecimal.
    pub sha256: String,
}

/// The files of one scene that have been read.
pub(super) struct Files {
    root: PathBuf,
    opener: Opener,
    read: RefCell<Vec<SourceFile>>,
}

impl Files {
    pub fn new(root: &Path, opener: &Opener) -> Self {
        Self {
            root: root.to_owned(),
            opener: opener.clone(),
            read: RefCell::default(),
        }
    }

    /// Returns the path of a file named by a file in `folder`. It must be inside the folder,
    /// without `..`.
    pub fn named(&self, folder: &Path, name: &str) -> Result<PathBuf, ImportError> {
        use std::path::Component::{CurDir, Normal};
        let path = Opener::named(folder, name)?;
        let plain = |c| matches!(c, CurDir | Normal(_));
        if !Path::new(name).components().all(plain) {
            return Err(FileError::Outside {
                path,
                allowed: folder.display().to_string(),
            }
            .into());
        }
        Ok(path)
    }

    /// Opens a file.
    pub fn open(&self, path: &Path) -> Result<File, ImportError> {
        Ok(self.opener.open(path)?)
    }

    /// Reads a file. Its purpose `what` is part of an error.
    pub fn bytes(&self, path: &Path) -> Result<Vec<u8>, ImportError> {
        let bytes = self.opener.read(path, MOST)?;
        self.remember(path, bytes.len() as u64, &Sha256::digest(&bytes));
        Ok(bytes)
    }

    /// Records a file that its decoder reads by itself, piece by piece.
    pub fn hash(&self, path: &Path) -> Result<(), ImportError> {
        let failed = |e| ImportError::io("read", path, e);
        let mut file = self.open(path)?;
        let (mut digest, mut total) = (Sha256::new(), 0);
        let mut buffer = vec![0; 1 << 20];
        loop {
            let n = file.read(&mut buffer).map_err(failed)?;
            if n == 0 {
                break;
            }
            digest.update(&buffer[..n]);
            total += n as u64;
        }
        self.remember(path, total, &digest.finalize());
        Ok(())
    }

    fn remember(&self, path: &Path, bytes: u64, sha256: &[u8]) {
        self.read.borrow_mut().push(SourceFile {
            name: self.name(path),
            bytes,
            sha256: hex::encode(sha256),
        });
    }

    /// Formats a path for the provenance.
    pub fn name(&self, path: &Path) -> String {
        let below = path.strip_prefix(&self.root).unwrap_or(path);
        let parts: Vec<_> = below
            .components()
            .map(|c| c.as_os_str().to_string_lossy().into_owned())
            .collect();
        parts.join("/")
    }

    /// Returns all files read, by name, without duplicates.
    pub fn into_list(self) -> Vec<SourceFile> {
        let mut files = self.read.into_inner();
        files.sort();
        files.dedup();
        files
    }
}

/// Returns the entries of a folder by name: (folders, files).
pub(super) fn entries(folder: &Path) -> Result<(Vec<PathBuf>, Vec<PathBuf>), ImportError> {
    let failed = |e| ImportError::io("list", folder, e);
    let (mut folders, mut files) = (Vec::new(), Vec::new());
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        match path.is_dir() {
            true => folders.push(path),
            false => files.push(path),
        }
    }
    folders.sort();
    files.sort();
    Ok((folders, files))
}
