//! Checks whether a store has results as they were reported: by the SHA-256 of a manifest's bytes,
//! and by the sizes of its objects. It only reads and changes nothing.

use std::sync::Arc;

use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use object_store::path::Path;
use serde::Deserialize;
use sha2::{Digest, Sha256};

use crate::models::{MODELS, Models};
use crate::reports::REPORTS;
use picofarm_dataset::Dataset;
use picofarm_dataset::Manifest;
use picofarm_dataset::{PartName, SMALL};
use picofarm_store::StorageError;
use picofarm_store::concurrent::CONCURRENCY;
use picofarm_store::get_sized;
use picofarm_store::objects;
use picofarm_store::sealed::ObjectEntry;

/// Maximum size of a manifest in bytes, so that a huge object cannot exhaust the memory.
const LARGEST: u64 = 64 << 20;
/// Maximum size of a scene in bytes for a comparison of its content.
const LARGEST_SCENE: u64 = 256 << 20;

/// The state of a result in the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Held {
    /// The reported result.
    Equal,
    /// The manifest or some of its objects are missing.
    Gone,
    /// Another manifest, or objects that do not match the manifest.
    Other,
}

/// A store to check for results.
#[derive(Debug, Clone)]
pub struct Holdings {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
}

/// The members common to all manifests.
#[derive(Deserialize)]
struct Named {
    objects: Vec<ObjectEntry>,
    /// Present only in manifests of a data set's scenes.
    #[serde(default)]
    provenance: Option<serde::de::IgnoredAny>,
}

impl Holdings {
    /// Returns the store at `prefix`.
    pub fn new(store: Arc<dyn ObjectStore>, prefix: Path) -> Self {
        Self { store, prefix }
    }

    /// Checks scenes of a data set, or predictions of scenes, given by index and SHA-256 of the
    /// manifest. Returns the states in this order. `thorough` selects the scenes with a lookup of
    /// their objects, too.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn scenes(
        &self,
        dataset: &str,
        scenes: &[(u64, [u8; 32])],
        thorough: impl Fn(u64) -> bool,
    ) -> Result<Vec<Held>, StorageError> {
        let folder = objects::path_of(&self.prefix, dataset);
        let folder = &folder;
        let looks: Vec<_> = scenes
            .iter()
            .map(|(scene, sha256)| {
                let thorough = thorough(*scene);
                async move {
                    let key = Manifest::key(*scene);
                    self.by_manifest(folder, &key, *sha256, thorough).await
                }
            })
            .collect();
        in_order(looks).await
    }

    /// Checks a trained or promoted model.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn model(&self, name: &str, sha256: [u8; 32]) -> Result<Held, StorageError> {
        let folder = self.prefix.clone().join(MODELS).join(name);
        self.by_manifest(&folder, "manifest.json", sha256, true)
            .await
    }

    /// Checks a report.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn report(&self, name: &str, sha256: [u8; 32]) -> Result<Held, StorageError> {
        let folder = self.prefix.clone().join(REPORTS).join(name);
        self.by_manifest(&folder, "manifest.json", sha256, true)
            .await
    }

    /// Checks the record of a sweep's trial.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn trial(
        &self,
        (sweep, id, index): (&str, &str, u64),
        sha256: [u8; 32],
    ) -> Result<Held, StorageError> {
        let models = Models::new(self.store.clone(), &self.prefix);
        match models.trial(sweep, id, index).await {
            Ok(None) => Ok(Held::Gone),
            Ok(Some(record)) if record.sha256() == hex::encode(sha256) => Ok(Held::Equal),
            Ok(Some(_)) | Err(StorageError::Damaged { .. }) => Ok(Held::Other),
            Err(error) => Err(error),
        }
    }

    /// Checks a split, in any of its versions.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn split(
        &self,
        dataset: &str,
        name: &str,
        sha256: [u8; 32],
    ) -> Result<Held, StorageError> {
        let folder = objects::path_of(&self.prefix, dataset);
        let dataset = match Dataset::open(self.store.clone(), folder).await {
            Ok(dataset) => dataset,
            Err(StorageError::NoDataset { .. }) => return Ok(Held::Gone),
            Err(error @ StorageError::Store { .. }) => return Err(error),
            Err(_) => return Ok(Held::Other),
        };
        let versions = dataset.split_versions(name).await?;
        for version in versions.iter().rev() {
            let bytes = dataset.read_split(name, *version).await?;
            if digest(&bytes) == sha256 {
                return Ok(Held::Equal);
            }
        }
        Ok(match versions.is_empty() {
            true => Held::Gone,
            false => Held::Other,
        })
    }

    /// Checks parts of scenes: each part exists, or its scene does.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn parts(
        &self,
        dataset: &str,
        parts: &[PartName],
    ) -> Result<Vec<Held>, StorageError> {
        let folder = objects::path_of(&self.prefix, dataset);
        let folder = &folder;
        let looks: Vec<_> = parts
            .iter()
            .map(|part| async move {
                for key in [part.key(), Manifest::key(part.scene)] {
                    let path = objects::path_of(folder, &key);
                    if objects::size(&*self.store, &path).await?.is_some() {
                        return Ok(Held::Equal);
                    }
                }
                Ok(Held::Gone)
            })
            .collect();
        in_order(looks).await
    }

    /// Checks scenes written as one binary glTF file each, by the SHA-256 over the file's name and
    /// the SHA-256 of its bytes. The files are read.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn gltf_scenes(&self, scenes: &[(u64, [u8; 32])]) -> Result<Vec<Held>, StorageError> {
        let looks: Vec<_> = scenes
            .iter()
            .map(|(scene, sha256)| async move {
                let name = format!("{scene:06}.glb");
                let path = objects::path_of(&self.prefix, &name);
                let Some(bytes) = self.read(&path, LARGEST_SCENE).await? else {
                    return Ok(Held::Gone);
                };
                let mut hash = Sha256::new();
                hash.update(&name);
                hash.update(Sha256::digest(&bytes));
                Ok(match <[u8; 32]>::from(hash.finalize()) == *sha256 {
                    true => Held::Equal,
                    false => Held::Other,
                })
            })
            .collect();
        in_order(looks).await
    }

    async fn by_manifest(
        &self,
        folder: &Path,
        key: &str,
        sha256: [u8; 32],
        thorough: bool,
    ) -> Result<Held, StorageError> {
        let path = objects::path_of(folder, key);
        let Some(bytes) = self.read(&path, LARGEST).await? else {
            return Ok(Held::Gone);
        };
        if digest(&bytes) != sha256 {
            return Ok(Held::Other);
        }
        let Ok(named) = serde_json::from_slice::<Named>(&bytes) else {
            return Ok(Held::Other);
        };
        if named.objects.is_empty() {
            return Ok(Held::Other);
        }
        let size = named.objects.iter().map(|object| object.size).sum::<u64>();
        let small = named.provenance.is_some() && size <= SMALL;
        let path = |object: &ObjectEntry| objects::path_of(folder, &object.key);
        if small && thorough {
            let objects = named.objects.iter();
            let sized: Vec<_> = objects.map(|object| (path(object), object.size)).collect();
            let found = get_sized(&*self.store, &sized).await?;
            for (object, bytes) in named.objects.iter().zip(found) {
                match bytes {
                    None => return Ok(Held::Gone),
                    Some(bytes) if hex::encode(digest(&bytes)) != object.sha256 => {
                        return Ok(Held::Other);
                    }
                    Some(_) => {}
                }
            }
            return Ok(Held::Equal);
        }
        for object in named.objects.iter().filter(|_| thorough) {
            if objects::size(&*self.store, &path(object)).await? != Some(object.size) {
                return Ok(Held::Gone);
            }
        }
        Ok(Held::Equal)
    }

    /// Reads an object of at most `most` bytes. A larger one is treated as empty.
    async fn read(&self, path: &Path, most: u64) -> Result<Option<bytes::Bytes>, StorageError> {
        match objects::size(&*self.store, path).await? {
            None => Ok(None),
            Some(size) if size > most => Ok(Some(bytes::Bytes::new())),
            Some(_) => objects::get(&*self.store, path).await,
        }
    }
}

/// Awaits all lookups, some of them concurrently, and returns the results in order.
async fn in_order(
    looks: Vec<impl Future<Output = Result<Held, StorageError>>>,
) -> Result<Vec<Held>, StorageError> {
    stream::iter(looks)
        .buffered(CONCURRENCY)
        .try_collect()
        .await
}

fn digest(bytes: &[u8]) -> [u8; 32] {
    Sha256::digest(bytes).into()
}

#[cfg(test)]
mod tests {
    use object_store::memory::InMemory;
    use object_store::{ObjectStoreExt, PutPayload};

    use super::*;

    async fn put(store: &Arc<dyn ObjectStore>, key: &str, bytes: &[u8]) {
        let payload = PutPayload::from(bytes.to_vec());
        store.put(&Path::from(key), payload).await.unwrap();
    }

    #[tokio::test]
    async fn a_scene_is_held_if_its_manifest_is_the_reported_one_and_its_objects_are_there() {
        let store: Arc<dyn ObjectStore> = Arc::new(InMemory::new());
        let sha256 = hex::encode(digest(b"abc"));
        let manifest = format!(
            r#"{{"provenance": {{}}, "objects": [{{"key": "depth/c/0", "size": 3, "sha256": "{sha256}"}}]}}"#
        );
        let manifest = manifest.as_bytes();
        put(&store, "s/d/manifests/0.json", manifest).await;
        put(&store, "s/d/depth/c/0", b"abc").await;
        let holdings = Holdings::new(store.clone(), Path::from("s"));
        let asked = [(0, digest(manifest)), (1, digest(b"x")), (0, digest(b"y"))];
        let held = holdings.scenes("d", &asked, |_| true).await.unwrap();
        assert_eq!(held, [Held::Equal, Held::Gone, Held::Other]);
        put(&store, "s/d/depth/c/0", b"ab").await;
        let held = holdings.scenes("d", &asked[..1], |_| true).await.unwrap();
        assert_eq!(held, [Held::Gone], "an object was cut short");
        let held = holdings.scenes("d", &asked[..1], |_| false).await.unwrap();
        assert_eq!(held, [Held::Equal], "its manifest alone is looked at");
        put(&store, "s/d/depth/c/0", b"xyz").await;
        let held = holdings.scenes("d", &asked[..1], |_| true).await.unwrap();
        assert_eq!(held, [Held::Other], "an object has other bytes");
        let empty = br#"{"objects": []}"#;
        put(&store, "s/d/manifests/2.json", empty).await;
        let asked = [(2, digest(empty))];
        let held = holdings.scenes("d", &asked, |_| false).await.unwrap();
        assert_eq!(held, [Held::Other], "it names nothing");
    }

    #[tokio::test]
    async fn a_part_is_held_as_long_as_it_or_its_scene_is_there() {
        let store: Arc<dyn ObjectStore> = Arc::new(InMemory::new());
        let part = |scene| PartName {
            scene,
            task_key: "k".into(),
            part: (0, 2),
        };
        put(&store, "s/d/parts/0/k/0-of-2.zst", b"x").await;
        put(&store, "s/d/manifests/1.json", b"{}").await;
        let holdings = Holdings::new(store, Path::from("s"));
        let held = holdings.parts("d", &[part(0), part(1), part(2)]).await;
        assert_eq!(held.unwrap(), [Held::Equal, Held::Equal, Held::Gone]);
    }

    #[tokio::test]
    async fn a_scene_as_a_file_is_held_if_its_bytes_are_the_reported_ones() {
        let store: Arc<dyn ObjectStore> = Arc::new(InMemory::new());
        put(&store, "s/000007.glb", b"glTF").await;
        let mut hash = Sha256::new();
        hash.update("000007.glb");
        hash.update(Sha256::digest(b"glTF"));
        let sha256: [u8; 32] = hash.finalize().into();
        let holdings = Holdings::new(store, Path::from("s"));
        let asked = [(7, sha256), (8, sha256), (7, [0; 32])];
        let held = holdings.gltf_scenes(&asked).await.unwrap();
        assert_eq!(held, [Held::Equal, Held::Gone, Held::Other]);
    }
}
