//! Results that consist of objects and a manifest: publishing, listing, reading, checking,
//! restoring and removing them.
//!
//! A result is published once its manifest exists, because the manifest is written last. All
//! objects are created, never overwritten, so several writers of equal results do not interfere.
//! Only [`Published::restore`] overwrites objects, and only by bytes with the recorded SHA-256.

mod id;
mod remove;
mod restore;
mod verify;

use std::marker::PhantomData;
use std::sync::Arc;

use bytes::Bytes;
use futures::FutureExt;
use object_store::path::Path;
use object_store::{Error, ObjectStore, ObjectStoreExt};

use crate::concurrent::{check_size, create_all, create_missing, run_all};
use crate::error::StorageError;
use crate::objects;
use crate::sealed::{ObjectEntry, sha256_hex};
use crate::together::create_together;
use crate::verify::{VerifyMode, read_intact};

pub use id::ResultId;
pub use remove::Removal;
pub use verify::Examine;

/// The manifest of a result: the record of its completion, its objects and its origin.
///
/// A manifest is a pure function of the task that made the result, so every run writes the same
/// bytes.
pub trait Manifest: Sized + Send + Sync {
    /// A scene's index, or a name.
    type Id: ResultId;

    /// Parses the manifest of the result `id`, stored at `object`.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if it is not a manifest of this result, or was changed.
    fn parse(bytes: &[u8], id: &Self::Id, object: &str) -> Result<Self, StorageError>;

    /// Returns the bytes to store.
    fn to_bytes(&self) -> Vec<u8>;

    /// Returns the result's objects, with keys relative to [`ResultId::folder`].
    fn objects(&self) -> &[ObjectEntry];

    /// Returns the key of the task that made the result.
    fn task_key(&self) -> &str;

    /// Describes that the result at `place` belongs to another task than `task_key`, and how to
    /// proceed.
    fn taken(&self, place: &str, task_key: &str) -> StorageError;

    /// Returns the total size of all objects in bytes.
    fn total_bytes(&self) -> u64 {
        self.objects().iter().map(|object| object.size).sum()
    }

    /// Returns the SHA-256 of the stored bytes, in hexadecimal.
    fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }
}

/// The results of one kind in a folder of a store. Cheap to clone.
///
/// ```
/// use bytes::Bytes;
/// use object_store::{memory::InMemory, path::Path};
/// use picofarm_store::published::{Manifest, Published};
/// use picofarm_store::sealed::{document, read_sealed, seal};
/// use picofarm_store::{ObjectEntry, StorageError, VerifyMode};
/// use serde::{Deserialize, Serialize};
///
/// #[derive(Debug, PartialEq, Serialize, Deserialize)]
/// struct Picture {
///     format: u32,
///     task_key: String,
///     objects: Vec<ObjectEntry>,
/// }
///
/// impl Manifest for Picture {
///     type Id = String;
///
///     fn parse(bytes: &[u8], _: &String, object: &str) -> Result<Self, StorageError> {
///         read_sealed(bytes, "a picture's manifest", 1, object)
///     }
///     fn to_bytes(&self) -> Vec<u8> {
///         seal(&document(self))
///     }
///     fn objects(&self) -> &[ObjectEntry] {
///         &self.objects
///     }
///     fn task_key(&self) -> &str {
///         &self.task_key
///     }
///     fn taken(&self, place: &str, task_key: &str) -> StorageError {
///         StorageError::invalid("output", format!("{place} is not by {task_key}"))
///     }
/// }
///
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), StorageError> {
/// let store = std::sync::Arc::new(InMemory::new());
/// let pictures: Published<Picture> = Published::new(store, Path::from("pictures"));
/// let (name, pixels) = ("room".to_owned(), Bytes::from("pixels"));
/// let manifest = Picture {
///     format: 1,
///     task_key: "k".into(),
///     objects: vec![ObjectEntry::new("room.png", &pixels)],
/// };
/// pictures.publish(&name, &manifest, &[pixels]).await?;
/// assert_eq!(pictures.list().await?, ["room"]);
/// let finished = pictures.finished(&name, "k", VerifyMode::Full).await?;
/// assert_eq!(finished, Some(manifest));
/// pictures.remove(&name).await?;
/// assert!(pictures.list().await?.is_empty());
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Published<M> {
    store: Arc<dyn ObjectStore>,
    folder: Path,
    manifest: PhantomData<fn() -> M>,
}

impl<M> Clone for Published<M> {
    fn clone(&self) -> Self {
        Self {
            store: self.store.clone(),
            folder: self.folder.clone(),
            manifest: PhantomData,
        }
    }
}

impl<M: Manifest> Published<M> {
    /// Returns the results in `folder`, which need not exist.
    pub fn new(store: Arc<dyn ObjectStore>, folder: Path) -> Self {
        Self {
            store,
            folder,
            manifest: PhantomData,
        }
    }

    /// Returns the store.
    pub fn store(&self) -> &Arc<dyn ObjectStore> {
        &self.store
    }

    /// Returns the folder of all results.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the path of an object of a result, given by its key in the manifest.
    pub fn object_path(&self, id: &M::Id, key: &str) -> Path {
        objects::path_of(&self.folder_of(id), key)
    }

    /// Returns the path of a result's manifest.
    pub fn manifest_path(&self, id: &M::Id) -> Path {
        objects::path_of(&self.folder, &id.manifest_key())
    }

    /// Returns a path as text for messages.
    pub fn shown(&self, path: &Path) -> String {
        objects::shown(&*self.store, path)
    }

    /// Returns the location of a result for messages.
    pub fn location(&self, id: &M::Id) -> String {
        self.shown(&self.folder_of(id))
    }

    /// Returns the published results, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn list(&self) -> Result<Vec<M::Id>, StorageError> {
        let mut ids = M::Id::list(&*self.store, &self.folder).await?;
        ids.sort_unstable();
        Ok(ids)
    }

    /// Returns the manifest of a result; `None` if the result is not published.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn manifest(&self, id: &M::Id) -> Result<Option<M>, StorageError> {
        let path = self.manifest_path(id);
        match objects::get(&*self.store, &path).await? {
            Some(bytes) => M::parse(&bytes, id, &self.shown(&path)).map(Some),
            None => Ok(None),
        }
    }

    /// Publishes a result: its objects first, the manifest last, all create-only. `bytes` has the
    /// objects' contents in the manifest's order. Existing objects with equal bytes count as
    /// written, so a result left half-written by a killed writer is completed, and publishing twice
    /// succeeds. When the call returns, each object existed at a time when the manifest already
    /// protected it from a collector of garbage.
    ///
    /// # Errors
    /// [`StorageError::Conflict`] if an object or the manifest exists with different bytes; nothing
    /// stored is changed. [`StorageError::Store`].
    pub async fn publish(
        &self,
        id: &M::Id,
        manifest: &M,
        bytes: &[Bytes],
    ) -> Result<(), StorageError> {
        self.put_objects(id, manifest, bytes).await?;
        let path = self.manifest_path(id);
        objects::create_or_match(&*self.store, &path, manifest.to_bytes().into()).await?;
        create_missing(&*self.store, &self.with_paths(id, manifest, bytes)).await
    }

    /// Publishes a result like [`Self::publish`], and makes the objects of a small one in a folder
    /// durable with one flush. A power failure before the manifest exists may leave torn objects,
    /// with which this call conflicts, so the caller must be able to tell and replace them.
    ///
    /// # Errors
    /// Those of [`Self::publish`].
    pub async fn publish_together(
        &self,
        id: &M::Id,
        manifest: &M,
        bytes: &[Bytes],
    ) -> Result<(), StorageError> {
        let objects = self.with_paths(id, manifest, bytes);
        let (store, path) = (&*self.store, self.manifest_path(id));
        let manifest: Bytes = manifest.to_bytes().into();
        if create_together(store, &objects, (&path, manifest.clone())).await? {
            return Ok(());
        }
        create_all(store, &objects).await?;
        objects::create_last_or_match(store, &objects, &path, manifest).await?;
        create_missing(store, &objects).await
    }

    /// Puts the objects of a result that is not published yet, create-only.
    ///
    /// # Errors
    /// [`StorageError::Conflict`] if an object exists with different bytes;
    /// [`StorageError::Store`].
    pub async fn put_objects(
        &self,
        id: &M::Id,
        manifest: &M,
        bytes: &[Bytes],
    ) -> Result<(), StorageError> {
        create_all(&*self.store, &self.with_paths(id, manifest, bytes)).await
    }

    /// Returns the manifest of a result that the task `task_key` has published, after checking its
    /// objects: their sizes ([`VerifyMode::Fast`]) or SHA-256 ([`VerifyMode::Full`]). Returns
    /// `None` if the result is not published. This allows a worker to adopt work that was finished
    /// before a crash.
    ///
    /// # Errors
    /// [`Manifest::taken`] if another task has published it; [`StorageError::Damaged`] if an object
    /// is missing or changed; [`StorageError::Store`].
    pub async fn finished(
        &self,
        id: &M::Id,
        task_key: &str,
        mode: VerifyMode,
    ) -> Result<Option<M>, StorageError> {
        let Some(manifest) = self.manifest(id).await? else {
            return Ok(None);
        };
        self.check_owner(id, &manifest, task_key)?;
        self.check_objects(id, &manifest, mode).await?;
        Ok(Some(manifest))
    }

    /// Checks that a result belongs to the task `task_key`.
    ///
    /// # Errors
    /// [`Manifest::taken`].
    pub fn check_owner(
        &self,
        id: &M::Id,
        manifest: &M,
        task_key: &str,
    ) -> Result<(), StorageError> {
        match manifest.task_key() == task_key {
            true => Ok(()),
            false => Err(manifest.taken(&self.location(id), task_key)),
        }
    }

    /// Checks the size of each object of a manifest, or its SHA-256 ([`VerifyMode::Full`]).
    ///
    /// # Errors
    /// [`StorageError::Damaged`] names the first object that is missing or changed;
    /// [`StorageError::Store`].
    pub async fn check_objects(
        &self,
        id: &M::Id,
        manifest: &M,
        mode: VerifyMode,
    ) -> Result<(), StorageError> {
        let check = |object: &ObjectEntry| {
            let (store, path, object) = (
                &*self.store,
                self.object_path(id, &object.key),
                object.clone(),
            );
            async move {
                match mode {
                    VerifyMode::Full => read_intact(store, &path, &object).await.map(drop),
                    VerifyMode::Fast => check_size(store, path, object.size).await,
                }
            }
            .boxed()
        };
        let checks: Vec<_> = manifest.objects().iter().map(check).collect();
        run_all(checks).await
    }

    /// Reads an object and checks it against its manifest entry. Reads from a network store are
    /// repeated a few times before it counts as damaged.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if it is missing or differs; [`StorageError::Store`].
    pub async fn read(&self, id: &M::Id, entry: &ObjectEntry) -> Result<Bytes, StorageError> {
        read_intact(&*self.store, &self.object_path(id, &entry.key), entry).await
    }

    fn folder_of(&self, id: &M::Id) -> Path {
        match id.folder() {
            "" => self.folder.clone(),
            folder => objects::path_of(&self.folder, folder),
        }
    }

    fn with_paths(&self, id: &M::Id, manifest: &M, bytes: &[Bytes]) -> Vec<(Path, Bytes)> {
        let paths = manifest.objects().iter();
        let paths = paths.map(|object| self.object_path(id, &object.key));
        paths.zip(bytes.iter().cloned()).collect()
    }

    async fn delete(&self, path: &Path) -> Result<(), StorageError> {
        match self.store.delete(path).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(StorageError::store("delete", self.shown(path), e)),
        }
    }
}

impl<M: Manifest<Id = u64>> Published<M> {
    /// Returns the manifest of a scene that must be published.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn scene(&self, scene: u64) -> Result<M, StorageError> {
        let manifest = self.manifest(&scene).await?;
        manifest.ok_or_else(|| StorageError::NotPublished {
            scene,
            object: self.shown(&self.manifest_path(&scene)),
        })
    }
}
