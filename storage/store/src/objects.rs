//! Operations on single objects: create-only puts, gets and sizes, with errors that name the
//! object.

use std::time::Duration;

use bytes::Bytes;
use object_store::path::Path;
use object_store::{Error, ObjectStore, ObjectStoreExt, PutMode, PutOptions, UpdateVersion};

use crate::error::StorageError;
use crate::failure::no_bucket;
use crate::sealed::sha256_hex;
use crate::together::create_last;

/// Number of attempts to create an object that the store reports as existing although it is
/// missing.
const ATTEMPTS: usize = 4;
/// Pause between these attempts.
const PAUSE: Duration = Duration::from_millis(250);

/// Pauses in milliseconds before an unexpected result from a network store is read again.
const REREAD_MS: [u64; 4] = [200, 400, 800, 1600];

/// Repeats reads with an unexpected result, because answers from a network store may be late,
/// stale, truncated or corrupted. Reads from a folder are not repeated.
pub struct Rereads {
    remote: bool,
    done: usize,
}

impl Rereads {
    /// Returns a count of no repetitions yet.
    pub fn new(store: &dyn ObjectStore) -> Self {
        Self {
            remote: shown(store, &Path::default()).contains("://"),
            done: 0,
        }
    }

    /// Returns how long to wait before the next read; `None` if a repetition is useless, or there
    /// have been enough.
    pub fn pause<T>(&mut self, read: &Result<T, StorageError>) -> Option<Duration> {
        let error = read.as_ref().err().filter(|_| self.remote)?;
        let most = match error {
            StorageError::Damaged { .. } | StorageError::Codec { .. } => REREAD_MS.len(),
            // The result may be true, because only the caller names these objects.
            StorageError::NotPublished { .. } | StorageError::NoDataset { .. } => 2,
            _ => 0,
        };
        let pause = REREAD_MS.get(self.done).filter(|_| self.done < most)?;
        self.done += 1;
        tracing::warn!(%error, "what was read is not what it should be; it is read again");
        Some(Duration::from_millis(*pause))
    }
}

/// Returns the full path of a key relative to `prefix`.
pub fn path_of(prefix: &Path, key: &str) -> Path {
    key.split('/')
        .fold(prefix.clone(), |path, part| path.join(part))
}

/// Formats a path for people: with the leading `/` for local stores, because their keys are paths
/// from the root.
pub fn shown(store: &dyn ObjectStore, path: &Path) -> String {
    // The store's root is only known from its `Display` text.
    let named = |kind: &str| {
        let name = store.to_string();
        let (_, rest) = name.split_once(kind)?;
        Some(rest.trim_end_matches(')').to_string())
    };
    if let Some(root) = named("LocalFileSystem(file://") {
        format!("{}/{path}", root.trim_end_matches('/'))
    } else if let Some(bucket) = named("AmazonS3(") {
        format!("s3://{bucket}/{path}")
    } else if let Some(bucket) = named("GoogleCloudStorage(") {
        format!("gs://{bucket}/{path}")
    } else if let Some(container) = named("MicrosoftAzure { account: ") {
        let container = container.split_once("container: ").map_or("", |c| c.1);
        format!("az://{}/{path}", container.trim_end_matches(" }"))
    } else {
        path.to_string()
    }
}

/// Returns the folder of a path in a local store; `None` for other stores.
pub fn folder(store: &dyn ObjectStore, path: &Path) -> Option<std::path::PathBuf> {
    let local = store.to_string().contains("LocalFileSystem(file://");
    local.then(|| shown(store, path).into())
}

/// Puts an object create-only. Returns `false` if it already exists.
pub async fn create(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
) -> Result<bool, StorageError> {
    let options = PutOptions::from(PutMode::Create);
    match store.put_opts(path, bytes.into(), options).await {
        Ok(_) => Ok(true),
        Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => Ok(false),
        Err(e) => Err(StorageError::store("write", shown(store, path), e)),
    }
}

/// Puts an object create-only. An existing object must have equal bytes.
///
/// ```
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), picofarm_store::StorageError> {
/// use object_store::{memory::InMemory, path::Path};
/// use picofarm_store::{StorageError, objects};
///
/// let (store, key) = (InMemory::new(), Path::from("a"));
/// objects::create_or_match(&store, &key, "bytes".into()).await?;
/// objects::create_or_match(&store, &key, "bytes".into()).await?;
/// let other = objects::create_or_match(&store, &key, "other".into()).await;
/// assert!(matches!(other, Err(StorageError::Conflict { .. })));
/// # Ok(())
/// # }
/// ```
pub async fn create_or_match(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
) -> Result<(), StorageError> {
    create_or_match_by(store, path, &bytes, || create(store, path, bytes.clone())).await
}

/// Like [`create_or_match`], for an object that refers to `objects`: these exist, and are durable
/// before it can be seen.
///
/// # Errors
/// Those of [`create_or_match`].
pub(crate) async fn create_last_or_match(
    store: &dyn ObjectStore,
    objects: &[(Path, Bytes)],
    path: &Path,
    bytes: Bytes,
) -> Result<(), StorageError> {
    let create = || create_last(store, objects, (path, bytes.clone()));
    create_or_match_by(store, path, &bytes, create).await
}

async fn create_or_match_by<F: Future<Output = Result<bool, StorageError>>>(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: &Bytes,
    create: impl Fn() -> F,
) -> Result<(), StorageError> {
    let mut found = None;
    for _ in 0..ATTEMPTS {
        if create().await? {
            return Ok(());
        }
        // The server's own checksum is not trusted: read the object back.
        found = get(store, path).await?;
        if found.is_some() {
            break;
        }
        // The put was refused because of a concurrent request (S3's 409), or the object was
        // collected since.
        tokio::time::sleep(PAUSE).await;
    }
    let Some(stored) = found else {
        return Err(StorageError::Store {
            action: "write",
            object: shown(store, path),
            hint: None,
            account: format!("refused {ATTEMPTS} times as existing, but it does not exist"),
        });
    };
    if stored == *bytes {
        return Ok(());
    }
    let (stored, ours) = (sha256_hex(&stored), sha256_hex(bytes));
    tracing::error!(object = %path, %stored, %ours, "conflict: an object exists with other bytes");
    Err(StorageError::Conflict {
        object: shown(store, path),
        stored,
        ours,
    })
}

/// Puts files create-only, in order. If the last file refers to the others, a reader that sees it
/// finds them all. Existing files must have equal bytes. This is for outputs other than data sets.
///
/// ```
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), picofarm_store::StorageError> {
/// use object_store::{memory::InMemory, path::Path};
/// use picofarm_store::{objects, publish_files};
///
/// let store = InMemory::new();
/// let files = [("a.txt".to_owned(), "a".into()), ("index.txt".to_owned(), "a.txt".into())];
/// publish_files(&store, &Path::from("out"), &files).await?;
/// let index = objects::get(&store, &Path::from("out/index.txt")).await?;
/// assert_eq!(index.as_deref(), Some(&b"a.txt"[..]));
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// [`StorageError::Conflict`] for different bytes, [`StorageError::Store`].
pub async fn publish_files(
    store: &dyn ObjectStore,
    prefix: &Path,
    files: &[(String, Bytes)],
) -> Result<(), StorageError> {
    for (name, bytes) in files {
        create_or_match(store, &path_of(prefix, name), bytes.clone()).await?;
    }
    Ok(())
}

/// Puts an object, overwriting an existing one (for metadata that grows).
pub async fn overwrite(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
) -> Result<(), StorageError> {
    let put = store.put_opts(path, bytes.into(), PutOptions::default());
    put.await
        .map(drop)
        .map_err(|e| StorageError::store("replace", shown(store, path), e))
}

/// Overwrites an object with one atomic put, and reads it back.
///
/// # Errors
/// [`StorageError::Damaged`] if the store returns other bytes than those written;
/// [`StorageError::Store`].
pub async fn replace(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
) -> Result<(), StorageError> {
    overwrite(store, path, bytes.clone()).await?;
    match get(store, path).await? {
        Some(stored) if stored == bytes => Ok(()),
        _ => Err(StorageError::Damaged {
            object: shown(store, path),
            what: "it was written again, but does not read back as written; check the store".into(),
        }),
    }
}

/// Replaces metadata that `counts_fewer` by metadata with a higher count; an equal or higher count
/// stays. Among concurrent writers the highest count remains, in any order: an object is replaced
/// only if it has not changed since it was read. A store without conditional puts (a folder) is
/// read again right before the put.
pub async fn grow(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
    counts_fewer: impl Fn(&[u8]) -> bool,
) -> Result<(), StorageError> {
    let (mut before, mut conditional) = (None, true);
    loop {
        let read = async {
            let result = store.get(path).await?;
            let version = UpdateVersion {
                e_tag: result.meta.e_tag.clone(),
                version: result.meta.version.clone(),
            };
            Ok::<_, Error>((result.bytes().await?, version))
        };
        let (found, version) = match read.await {
            Ok(read) => read,
            Err(Error::NotFound { .. }) => return overwrite(store, path, bytes).await,
            Err(e) => return Err(StorageError::store("read", shown(store, path), e)),
        };
        if !counts_fewer(&found) {
            return Ok(());
        }
        if !conditional {
            return overwrite(store, path, bytes).await;
        }
        let options = PutOptions::from(PutMode::Update(version));
        match store.put_opts(path, bytes.clone().into(), options).await {
            Ok(_) => return Ok(()),
            // Another writer was faster. Each replacement has a higher count, so the loop ends.
            Err(Error::Precondition { .. } | Error::AlreadyExists { .. })
                if before.as_ref() != Some(&found) =>
            {
                before = Some(found);
            }
            // The store has no conditional puts, or refuses one although nobody changed the object.
            Err(error) => {
                tracing::debug!(object = %path, %error, "metadata are put without a condition");
                conditional = false;
            }
        }
    }
}

/// Returns the bytes; `None` if there is no such object.
///
/// # Errors
/// [`StorageError::Store`].
pub async fn get(store: &dyn ObjectStore, path: &Path) -> Result<Option<Bytes>, StorageError> {
    let result = match store.get(path).await {
        Ok(result) => result.bytes().await,
        Err(e) => Err(e),
    };
    match result {
        Ok(bytes) => Ok(Some(bytes)),
        Err(e @ Error::NotFound { .. }) if !no_bucket(&e) => Ok(None),
        Err(e) => Err(StorageError::store("read", shown(store, path), e)),
    }
}

/// Returns the bytes of an object that must exist.
pub async fn require(store: &dyn ObjectStore, path: &Path) -> Result<Bytes, StorageError> {
    get(store, path)
        .await?
        .ok_or_else(|| StorageError::Damaged {
            object: shown(store, path),
            what: "the object is missing".into(),
        })
}

/// Returns the size; `None` if there is no such object.
pub async fn size(store: &dyn ObjectStore, path: &Path) -> Result<Option<u64>, StorageError> {
    match store.head(path).await {
        Ok(meta) => Ok(Some(meta.size)),
        Err(e @ Error::NotFound { .. }) if !no_bucket(&e) => Ok(None),
        Err(e) => Err(StorageError::store("look up", shown(store, path), e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_is_damaged_is_read_again_from_a_network_and_not_from_a_folder() {
        let missing = || StorageError::Damaged {
            object: "a".into(),
            what: "the object is missing".into(),
        };
        let memory = object_store::memory::InMemory::new();
        let mut rereads = Rereads::new(&memory);
        assert_eq!(rereads.pause::<()>(&Err(missing())), None);
        rereads.remote = true;
        assert_eq!(rereads.pause(&Ok(())), None);
        for pause in REREAD_MS {
            let again = rereads.pause::<()>(&Err(missing()));
            assert_eq!(again, Some(Duration::from_millis(pause)));
        }
        assert_eq!(rereads.pause::<()>(&Err(missing())), None);
    }
}
