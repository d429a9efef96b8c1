//! Trained models: `models/<name>/` in a store, next to its data sets. A model outlives the data
//! set of its training and is applied to others in the same store, reprocessed or rendered later.
//! Therefore its name has the same meaning for all of them.
//!
//! A model is published like a scene: objects first, in a folder named after their content, then
//! `manifest.json`, create-only. Killed trainings with other settings under the same name leave
//! objects in other folders and checkpoints under other keys. They do not interfere, and
//! [`crate::collect_garbage`] eventually deletes them.

mod call;
mod checkpoint;
mod collect;
mod evaluation;
mod manifest;
mod remove;
mod repair;
mod shard;
mod speed;
mod sweep;
mod verify;

use std::sync::Arc;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::path::Path;
use object_store::{Error, ObjectStore, ObjectStoreExt};

use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::{ObjectEntry, sha256_hex};

pub use evaluation::Evaluation;
pub use manifest::{DepthsUsed, Lineage, Measurement, ModelManifest, Promoted, SplitUsed};
pub use remove::{Dependents, Removed};
pub use repair::ModelRepair;
pub use shard::ShardName;
pub use speed::TrainingSpeed;
pub use sweep::{Rung, TrialEnd, TrialRecord};
pub use verify::ModelCheck;

/// The folder of models in a store. No data set can have this name.
pub const MODELS: &str = "models";
/// Name of the manifest, which marks a model as published.
const MANIFEST: &str = "manifest.json";

/// The models of a store. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Models {
    store: Arc<dyn ObjectStore>,
    folder: Path,
}

/// A model to be published.
#[derive(Debug, Clone)]
pub struct NewModel {
    /// Its manifest. Format, objects and checksum are set on publishing.
    pub manifest: ModelManifest,
    /// Its objects: `weights.safetensors`, `history.jsonl`, …
    pub objects: Vec<(String, Bytes)>,
}

/// A published model.
#[derive(Debug, Clone, PartialEq)]
pub struct Published {
    /// Its stored manifest.
    pub manifest: ModelManifest,
    /// Whether another run of the same training was published first and has different bits (as is
    /// possible on GPUs), so that its model was adopted.
    pub adopted: bool,
}

impl Models {
    /// Returns the models of the store at `prefix`.
    pub fn new(store: Arc<dyn ObjectStore>, prefix: &Path) -> Self {
        Self {
            store,
            folder: prefix.clone().join(MODELS),
        }
    }

    /// Returns a model's location for messages.
    pub fn place(&self, name: &str) -> String {
        objects::shown(&*self.store, &self.folder.clone().join(name))
    }

    /// Returns the names of the models, ascending, including those still in training.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn names(&self) -> Result<Vec<String>, StorageError> {
        let listed = self.store.list_with_delimiter(Some(&self.folder)).await;
        let listed = listed.map_err(|e| self.failed("list", &self.folder, e))?;
        let mut names = Vec::new();
        for path in &listed.common_prefixes {
            // On a disk, the folder of a removed model remains.
            let on_disk = objects::folder(&*self.store, path).is_some();
            if on_disk && self.list(path).await?.is_empty() {
                continue;
            }
            names.extend(path.filename().map(str::to_owned));
        }
        names.sort();
        Ok(names)
    }

    /// Returns the manifest of a model; `None` if there is none of this name, or it is still in
    /// training.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn look(&self, name: &str) -> Result<Option<ModelManifest>, StorageError> {
        let path = self.path(name, MANIFEST);
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        ModelManifest::parse(&bytes, name, &self.shown(&path)).map(Some)
    }

    /// Returns the manifest of a model that must exist.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] lists the existing models; those of [`Self::look`].
    pub async fn manifest(&self, name: &str) -> Result<ModelManifest, StorageError> {
        check_name(name)?;
        if let Some(manifest) = self.look(name).await? {
            return Ok(manifest);
        }
        let mut there = Vec::new();
        let mut unfinished = false;
        for other in self.names().await? {
            match objects::size(&*self.store, &self.path(&other, MANIFEST)).await? {
                Some(_) => there.push(other),
                None => unfinished |= other == name,
            }
        }
        let place = objects::shown(&*self.store, &self.folder);
        let there = match there.is_empty() {
            true => "none".to_owned(),
            false => there.join(", "),
        };
        let what = match unfinished {
            true => {
                format!("{name:?} in {place} is not trained to its end yet; finished are: {there}")
            }
            false => format!("{place} holds no {name:?}; there are: {there}"),
        };
        Err(StorageError::invalid("model", what))
    }

    /// Returns the manifest of a model that this training has published, after checking the SHA-256
    /// of each object. Returns `None` if it is not published.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the name belongs to another training; [`StorageError::Damaged`]
    /// if an object is missing or changed; [`StorageError::Store`].
    pub async fn finished(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<Option<ModelManifest>, StorageError> {
        check_name(name)?;
        let Some(manifest) = self.look(name).await? else {
            return Ok(None);
        };
        self.check_owner(&manifest, training_key)?;
        for object in &manifest.objects {
            let path = self.path(name, &object.key);
            let what = match objects::size(&*self.store, &path).await? {
                // Reading a model is cheap compared with training it.
                Some(size) if size == object.size => {
                    let bytes = objects::require(&*self.store, &path).await?;
                    if sha256_hex(&bytes) == object.sha256 {
                        continue;
                    }
                    "its SHA-256 is not the manifest's".into()
                }
                Some(size) => format!("expected {} bytes, found {size}", object.size),
                None => "the object is missing".into(),
            };
            let object = self.shown(&path);
            return Err(StorageError::Damaged { object, what });
        }
        Ok(Some(manifest))
    }

    /// Publishes a model: objects first, the manifest last, all create-only. Existing objects with
    /// equal bytes count as written. If an equal manifest exists, missing or changed objects are
    /// restored. If another run of the same training published different bits first, its model is
    /// retained, unless `exact` requests an error.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for a name of another training, or an invalid name;
    /// [`StorageError::Conflict`] with `exact`, for different bits; [`StorageError::Store`].
    pub async fn publish(&self, model: NewModel, exact: bool) -> Result<Published, StorageError> {
        let NewModel { manifest, objects } = model;
        let name = manifest.name.clone();
        check_name(&name)?;
        let entries: Vec<ObjectEntry> = objects
            .iter()
            .map(|(file, bytes)| entry(file, bytes))
            .collect();
        let folder = content(&manifest.training_key, &entries);
        let in_folder = |entry: ObjectEntry| ObjectEntry {
            key: format!("{folder}/{}", entry.key),
            ..entry
        };
        let entries = entries.into_iter().map(in_folder).collect();
        let manifest = manifest.with_objects(entries);
        let bytes: Vec<Bytes> = objects.into_iter().map(|(_, bytes)| bytes).collect();
        let path = self.path(&name, MANIFEST);
        let ours = manifest.to_bytes();
        if objects::get(&*self.store, &path).await?.as_deref() == Some(&ours[..]) {
            // It was published before; objects damaged since then are restored.
            self.restore(&manifest, &bytes).await?;
            return Ok(Published {
                manifest,
                adopted: false,
            });
        }
        self.put_objects(&manifest, &bytes).await?;
        if !objects::create(&*self.store, &path, ours.clone().into()).await? {
            let stored = objects::require(&*self.store, &path).await?;
            if stored != ours {
                return self.other_bits(&manifest, &stored, exact).await;
            }
        }
        // A collector may have deleted an object before the manifest protected it.
        self.put_objects(&manifest, &bytes).await?;
        Ok(Published {
            manifest,
            adopted: false,
        })
    }

    /// Handles an existing manifest under the name, of the same training or of another one.
    async fn other_bits(
        &self,
        ours: &ModelManifest,
        stored: &[u8],
        exact: bool,
    ) -> Result<Published, StorageError> {
        let path = self.path(&ours.name, MANIFEST);
        let theirs = ModelManifest::parse(stored, &ours.name, &self.shown(&path))?;
        let same = self.check_owner(&theirs, &ours.training_key);
        if same.is_ok() && exact {
            return Err(StorageError::Conflict {
                object: self.shown(&path),
                stored: sha256_hex(stored),
                ours: sha256_hex(&ours.to_bytes()),
            });
        }
        // The new objects do not interfere, but they are not needed either.
        let named = |key: &str| theirs.objects.iter().any(|object| object.key == key);
        for object in ours.objects.iter().filter(|object| !named(&object.key)) {
            self.delete(&self.path(&ours.name, &object.key)).await?;
        }
        same?;
        // Its damaged objects cannot be restored from different bits.
        self.finished(&ours.name, &ours.training_key).await?;
        Ok(Published {
            manifest: theirs,
            adopted: true,
        })
    }

    /// Reads one of a model's objects, by its file name, and checks it against the manifest.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn read(&self, manifest: &ModelManifest, file: &str) -> Result<Bytes, StorageError> {
        let Some(object) = manifest.object(file) else {
            return Err(StorageError::Damaged {
                object: self.shown(&self.path(&manifest.name, MANIFEST)),
                what: format!("names no {file}"),
            });
        };
        let path = self.path(&manifest.name, &object.key);
        let bytes = objects::require(&*self.store, &path).await?;
        match sha256_hex(&bytes) == object.sha256 {
            true => Ok(bytes),
            false => Err(StorageError::Damaged {
                object: self.shown(&path),
                what: format!(
                    "its SHA-256 is not the manifest's; `picofarm model repair` says how to get it back ({})",
                    manifest.name
                ),
            }),
        }
    }

    async fn put_objects(
        &self,
        manifest: &ModelManifest,
        bytes: &[Bytes],
    ) -> Result<(), StorageError> {
        for (object, bytes) in manifest.objects.iter().zip(bytes) {
            let path = self.path(&manifest.name, &object.key);
            if objects::size(&*self.store, &path).await? != Some(object.size) {
                objects::create_or_match(&*self.store, &path, bytes.clone()).await?;
            }
        }
        Ok(())
    }

    fn check_owner(&self, found: &ModelManifest, training_key: &str) -> Result<(), StorageError> {
        if found.training_key == training_key {
            return Ok(());
        }
        let what = format!(
            "{} holds the model of another training (key {}, this one's is {training_key}); choose another name, or delete \
             that folder if nothing needs it",
            self.place(&found.name),
            found.training_key
        );
        Err(StorageError::invalid("model", what))
    }

    async fn delete(&self, path: &Path) -> Result<(), StorageError> {
        match self.store.delete(path).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(self.failed("delete", path, e)),
        }
    }

    /// Lists all objects in a folder of a model.
    async fn list(&self, folder: &Path) -> Result<Vec<object_store::ObjectMeta>, StorageError> {
        let listed = self.store.list(Some(folder)).try_collect().await;
        listed.map_err(|e| self.failed("list", folder, e))
    }

    fn path(&self, name: &str, key: &str) -> Path {
        objects::path_of(&self.folder.clone().join(name), key)
    }

    fn shown(&self, path: &Path) -> String {
        objects::shown(&*self.store, path)
    }

    fn failed(&self, action: &'static str, path: &Path, error: Error) -> StorageError {
        StorageError::store(action, self.shown(path), error)
    }
}

fn entry(file: &str, bytes: &Bytes) -> ObjectEntry {
    ObjectEntry {
        key: file.to_owned(),
        size: bytes.len() as u64,
        sha256: sha256_hex(bytes),
    }
}

/// Returns the name of the folder of objects: 16 hexadecimal digits, computed from the training and
/// the objects' bytes.
fn content(training_key: &str, entries: &[ObjectEntry]) -> String {
    let mut text = training_key.to_owned();
    for entry in entries {
        text += &format!("\n{} {}", entry.key, entry.sha256);
    }
    let mut name = sha256_hex(text.as_bytes());
    name.truncate(16);
    name
}

/// Returns the folder of an object, if its key relative to the model belongs to one of the model's
/// objects.
fn object_folder(key: &str) -> Option<&str> {
    let (folder, file) = key.split_once('/')?;
    let hex = folder.len() == 16 && folder.bytes().all(|b| b.is_ascii_hexdigit());
    (hex && !file.contains('/')).then_some(folder)
}

fn check_name(name: &str) -> Result<(), StorageError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if (1..=128).contains(&name.len()) && !name.starts_with('.') && name.chars().all(plain) {
        return Ok(());
    }
    let what = format!(
        "{name:?} must be up to 128 letters, digits, '-', '_' and '.', and not begin with '.'"
    );
    Err(StorageError::invalid("model", what))
}

/// Returns the key of an object relative to a folder.
fn key_below(folder: &Path, path: &Path) -> Option<String> {
    let parts: Vec<_> = path.prefix_match(folder)?.collect();
    let parts: Vec<&str> = parts.iter().map(AsRef::as_ref).collect();
    Some(parts.join("/"))
}
