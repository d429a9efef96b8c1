//! The store in a folder, which makes all objects of a small result durable with one flush.
//!
//! A scene of one pixel has fifteen objects of some hundred bytes. If each were flushed with its
//! folder before the next request, the scene would wait thirty times for the disk, and a worker's
//! processor would idle. A result is complete only with its manifest, so only this order counts:
//! all objects are durable before the manifest can be seen, and the manifest before the call
//! returns. A power failure in between leaves objects without a manifest, possibly torn ones, which
//! the next writer of the result replaces or completes.

use std::{
    collections::BTreeSet,
    fmt,
    fs::{self, File, OpenOptions},
    io::{self, ErrorKind, Read, Write},
    ops::Range,
    path::{Path as Folder, PathBuf},
};

use bytes::Bytes;
use futures::stream::{self, BoxStream};
use futures::{StreamExt, TryStreamExt};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMode, PutMultipartOptions, PutOptions, PutPayload, PutResult, RenameOptions,
    Result,
};

use crate::concurrent::CONCURRENCY;
use crate::error::StorageError;
use crate::objects;

/// Name of this store in messages and in errors.
const NAME: &str = "folder";

/// Results of at most this many bytes are flushed by one call for the whole file system. Larger
/// ones are flushed file by file, so that they do not wait for what other programs write.
const SMALL: usize = 4 << 20;

/// The work of a put before it creates its object, as an extension of its options.
#[derive(Clone)]
struct Before {
    /// Objects to create.
    create: Vec<(Path, Bytes)>,
    /// Objects that exist and are to be flushed, too.
    flush: Vec<Path>,
}

/// Creates the objects of a result and then its manifest, if the store can do this in one step and
/// none of them exists. Returns `false`, and may leave objects without a manifest, otherwise.
///
/// # Errors
/// [`StorageError::Store`].
pub(crate) async fn create_together(
    store: &dyn ObjectStore,
    objects: &[(Path, Bytes)],
    (path, manifest): (&Path, Bytes),
) -> std::result::Result<bool, StorageError> {
    let bytes: usize = objects.iter().map(|(_, bytes)| bytes.len()).sum();
    if bytes > SMALL || !store.to_string().contains(&format!("{NAME} ")) {
        return Ok(false);
    }
    let before = Before {
        create: objects.to_vec(),
        flush: Vec::new(),
    };
    create_after(store, before, path, manifest).await
}

/// Creates a manifest after its objects, which exist, are durable. Returns `false` if the manifest
/// exists.
///
/// # Errors
/// [`StorageError::Store`].
pub(crate) async fn create_last(
    store: &dyn ObjectStore,
    objects: &[(Path, Bytes)],
    (path, manifest): (&Path, Bytes),
) -> std::result::Result<bool, StorageError> {
    let before = Before {
        create: Vec::new(),
        flush: objects.iter().map(|(path, _)| path.clone()).collect(),
    };
    create_after(store, before, path, manifest).await
}

/// Returns the bytes of objects of known sizes; `None` for one that is missing or has another size.
/// A folder is read in one step, because a request for each of many small objects costs more than
/// their bytes.
///
/// # Errors
/// [`StorageError::Store`], [`StorageError::Io`].
pub async fn get_sized(
    store: &dyn ObjectStore,
    objects: &[(Path, u64)],
) -> std::result::Result<Vec<Option<Bytes>>, StorageError> {
    // A store that checks its identity looks at it whenever an object is missing.
    if !store.to_string().starts_with(NAME) {
        let get = |(path, size): &(Path, u64)| {
            let (path, size) = (path.clone(), *size);
            async move {
                match objects::size(store, &path).await? == Some(size) {
                    true => objects::get(store, &path).await,
                    false => Ok(None),
                }
            }
        };
        let gets = stream::iter(objects.iter().map(get).collect::<Vec<_>>());
        return gets.buffered(CONCURRENCY).try_collect().await;
    }
    let place = |path: &Path| PathBuf::from(objects::shown(store, path));
    let files = objects.iter().map(|(path, size)| (place(path), *size));
    let files: Vec<_> = files.collect();
    let read = move || {
        files
            .iter()
            .map(|(path, size)| read_sized(path, *size))
            .collect()
    };
    let read = tokio::task::spawn_blocking(read).await;
    read.expect("reading files does not panic")
}

/// Returns the bytes of a file; `None` if it is missing or has another size.
fn read_sized(path: &Folder, size: u64) -> std::result::Result<Option<Bytes>, StorageError> {
    let read = || -> io::Result<Option<Bytes>> {
        let mut file = File::open(path)?;
        if file.metadata()?.len() != size {
            return Ok(None);
        }
        let mut bytes = Vec::with_capacity(usize::try_from(size).unwrap_or(0));
        file.read_to_end(&mut bytes)?;
        Ok(Some(bytes.into()))
    };
    match read() {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
        other => other.map_err(|e| StorageError::io("read", path, e)),
    }
}

async fn create_after(
    store: &dyn ObjectStore,
    before: Before,
    path: &Path,
    bytes: Bytes,
) -> std::result::Result<bool, StorageError> {
    let mut options = PutOptions::from(PutMode::Create);
    options.extensions.insert(before);
    match store.put_opts(path, bytes.into(), options).await {
        Ok(_) => Ok(true),
        Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => Ok(false),
        Err(e) => Err(StorageError::store("write", objects::shown(store, path), e)),
    }
}

/// A store in a folder. Every put is durable when it returns.
#[derive(Debug)]
pub(crate) struct FolderStore(LocalFileSystem);

impl FolderStore {
    pub(crate) fn new() -> Self {
        Self(LocalFileSystem::new().with_fsync(true))
    }
}

impl fmt::Display for FolderStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{NAME} {}", self.0)
    }
}

#[async_trait::async_trait]
impl ObjectStore for FolderStore {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> Result<PutResult> {
        let Some(before) = options.extensions.get::<Before>() else {
            return self.0.put_opts(location, payload, options).await;
        };
        let place = |path: &Path| self.0.path_to_filesystem(path);
        let mut files = Vec::with_capacity(before.create.len());
        for (path, bytes) in &before.create {
            files.push((place(path)?, bytes.clone()));
        }
        let present: Vec<PathBuf> = before.flush.iter().map(place).collect::<Result<_>>()?;
        let last = (place(location)?, Bytes::from(payload));
        let write = move || write_together(&files, &present, &last);
        let written = tokio::task::spawn_blocking(write).await;
        written.map_err(|source| Error::JoinError { source })??;
        Ok(PutResult {
            e_tag: None,
            version: None,
            extensions: Default::default(),
        })
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.0.put_multipart_opts(location, options).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.0.get_opts(location, options).await
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.0.get_ranges(location, ranges).await
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        self.0.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.0.list(prefix)
    }

    fn list_with_offset(
        &self,
        prefix: Option<&Path>,
        offset: &Path,
    ) -> BoxStream<'static, Result<ObjectMeta>> {
        self.0.list_with_offset(prefix, offset)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.0.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.0.copy_opts(from, to, options).await
    }

    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> Result<()> {
        self.0.rename_opts(from, to, options).await
    }
}

/// A file operation that failed. The source stays visible for [`crate::io_hint`].
#[derive(Debug, thiserror::Error)]
#[error("{path}: {source}")]
struct Failed {
    path: String,
    source: io::Error,
}

/// Files that were created and are not flushed yet.
#[derive(Default)]
struct Unflushed {
    files: Vec<File>,
    /// Folders with new entries.
    folders: BTreeSet<PathBuf>,
}

/// Creates files, flushes them and those that are `present`, and then creates the last one.
///
/// # Errors
/// [`Error::AlreadyExists`] if one of them exists, or if a collector has deleted one meanwhile, so
/// that the caller must look; [`Error::Generic`] for other failures.
fn write_together(
    files: &[(PathBuf, Bytes)],
    present: &[PathBuf],
    (path, manifest): &(PathBuf, Bytes),
) -> Result<()> {
    let mut unflushed = Unflushed::default();
    for path in present {
        let file = File::open(path).map_err(|e| failed(path, e))?;
        unflushed.files.push(file);
        unflushed.folders.insert(parent(path).to_owned());
    }
    for (path, bytes) in files {
        let staged = unflushed.stage(path, bytes)?;
        let linked = fs::hard_link(&staged, path);
        // A leftover is found by its name.
        let _ = fs::remove_file(&staged);
        linked.map_err(|e| failed(path, e))?;
    }
    let staged = unflushed.stage(path, manifest)?;
    let linked = unflushed.flush().and_then(|()| {
        fs::hard_link(&staged, path)?;
        File::open(parent(path))?.sync_all()
    });
    let _ = fs::remove_file(&staged);
    linked.map_err(|e| failed(path, e))?;
    match files.iter().find(|(path, _)| !path.exists()) {
        None => Ok(()),
        Some((path, _)) => Err(exists(path, ErrorKind::NotFound.into())),
    }
}

impl Unflushed {
    /// Writes a file next to its place, with the name of an unfinished one.
    fn stage(&mut self, path: &Folder, bytes: &Bytes) -> Result<PathBuf> {
        let mut options = OpenOptions::new();
        options.write(true).create_new(true);
        let (mut number, mut created) = (1u64, false);
        loop {
            let mut staged = path.as_os_str().to_owned();
            staged.push(format!("#{number}"));
            let staged = PathBuf::from(staged);
            match options.open(&staged) {
                Ok(mut file) => {
                    if let Err(e) = file.write_all(bytes) {
                        let _ = fs::remove_file(&staged);
                        return Err(failed(path, e));
                    }
                    self.files.push(file);
                    self.folders.insert(parent(path).to_owned());
                    return Ok(staged);
                }
                Err(e) if e.kind() == ErrorKind::AlreadyExists => number += 1,
                Err(e) if e.kind() == ErrorKind::NotFound && !created => {
                    let folder = self.create_folder(parent(path));
                    folder.map_err(|e| failed(path, e))?;
                    created = true;
                }
                Err(e) => return Err(failed(path, e)),
            }
        }
    }

    /// Creates a folder and the missing ones above it.
    fn create_folder(&mut self, folder: &Folder) -> io::Result<()> {
        let above = parent(folder);
        self.folders.insert(above.to_owned());
        let made = match fs::create_dir(folder) {
            Err(e) if e.kind() == ErrorKind::NotFound && above != folder => {
                self.create_folder(above)?;
                fs::create_dir(folder)
            }
            made => made,
        };
        match made {
            // Another writer was faster.
            Err(e) if e.kind() == ErrorKind::AlreadyExists => Ok(()),
            made => made,
        }
    }

    /// Flushes all files and folders to the disk.
    fn flush(&self) -> io::Result<()> {
        #[cfg(target_os = "linux")]
        if let Some(last) = self.files.last()
            && flushes_whole(last)?
        {
            return Ok(rustix::fs::syncfs(last)?);
        }
        self.flush_each()
    }

    /// Flushes one file and folder after another.
    fn flush_each(&self) -> io::Result<()> {
        self.files.iter().try_for_each(File::sync_all)?;
        let mut folders = self.folders.iter();
        folders.try_for_each(|folder| File::open(folder)?.sync_all())
    }
}

/// Returns whether the kernel flushes the whole file system to the disk when asked. It does not ask
/// file systems in user space, for example.
#[cfg(target_os = "linux")]
fn flushes_whole(file: &File) -> io::Result<bool> {
    /// ext2 to ext4, XFS, Btrfs, F2FS, ZFS, overlayfs, tmpfs.
    const KINDS: [u64; 7] = [
        0xEF53,
        0x5846_5342,
        0x9123_683E,
        0xF2F5_2010,
        0x2FC1_2FC1,
        0x794C_7630,
        0x0102_1994,
    ];
    let kind = rustix::fs::fstatfs(file)?.f_type as u64 & 0xFFFF_FFFF;
    Ok(KINDS.contains(&kind))
}

fn parent(path: &Folder) -> &Folder {
    path.parent().unwrap_or(path)
}

fn exists(path: &Folder, source: io::Error) -> Error {
    Error::AlreadyExists {
        path: path.display().to_string(),
        source: source.into(),
    }
}

fn failed(path: &Folder, source: io::Error) -> Error {
    match source.kind() {
        ErrorKind::AlreadyExists => exists(path, source),
        _ => Error::Generic {
            store: NAME,
            source: Box::new(Failed {
                path: path.display().to_string(),
                source,
            }),
        },
    }
}

#[cfg(test)]
mod tests;
