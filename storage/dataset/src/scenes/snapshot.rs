//! Snapshots of a data set: `snapshots/<name>.json.gz`, a list of scenes and their manifests. A
//! snapshot is create-only and never changes. Because a manifest contains the SHA-256 of its
//! objects, a snapshot pins every byte. It is not affected when the data set grows, and
//! [`Dataset::collect`] does not delete objects of its scenes.

use std::io::{Read, Write};

use flate2::{Compression, GzBuilder, bufread::GzDecoder};
use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::layout::manifest::Manifest;
use crate::layout::spec::DatasetSpec;
use crate::scenes::dataset::Dataset;
use picofarm_store::StorageError;
use picofarm_store::Watch;
use picofarm_store::objects;

/// Format version of snapshots.
const FORMAT: u32 = 1;
/// Number of manifests read concurrently.
const CONCURRENCY: usize = 32;
/// Maximum ratio of a snapshot's size to its packed size. Snapshots consist of hashes, which
/// compress poorly.
const RATIO: u64 = 64;

/// A pinned list of scenes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pinned {
    /// Hash that pins every byte of the scenes, and their order, in hexadecimal.
    pub id: String,
    /// Scenes with missing quantities, from [`Manifest::missing`], in the scenes' order.
    pub missing: Vec<(u64, Vec<String>)>,
    /// SHA-256 of each scene's manifest, in the scenes' order.
    pub manifests: Vec<[u8; 32]>,
}

/// The scenes of a data set at one time, and their manifests.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Its name; empty if it is not stored.
    pub name: String,
    /// Creation time, as given by its creator.
    pub created: String,
    /// The data set's properties at that time.
    pub spec: DatasetSpec,
    /// Total size of all objects in bytes, without manifests.
    pub bytes: u64,
    /// Scenes and the SHA-256 of their manifests, ascending by scene.
    manifests: Vec<(u64, [u8; 32])>,
}

/// The stored form of a snapshot.
#[derive(Serialize, Deserialize)]
struct Stored {
    format: u32,
    name: String,
    created: String,
    spec: DatasetSpec,
    /// [`Snapshot::id`].
    id: String,
    bytes: u64,
    /// Half-open intervals of scenes.
    scenes: Vec<(u64, u64)>,
    /// SHA-256 of the manifests in hexadecimal, in the order of the scenes.
    manifest_sha256: Vec<String>,
}

/// A scene, the SHA-256 of its manifest, and its size in bytes.
type Looked = (u64, [u8; 32], u64);

/// The difference between two snapshots, with scenes ascending.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Difference {
    /// Scenes only in the second.
    pub added: Vec<u64>,
    /// Scenes only in the first.
    pub removed: Vec<u64>,
    /// Scenes in both, with different manifests.
    pub changed: Vec<u64>,
    /// Number of scenes that are equal in both.
    pub same: u64,
}

impl Snapshot {
    /// Returns the snapshot with a name and a creation time.
    #[must_use]
    pub fn named(self, name: impl Into<String>, created: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            created: created.into(),
            ..self
        }
    }

    /// Returns its scenes, ascending.
    pub fn scenes(&self) -> impl Iterator<Item = u64> {
        self.manifests.iter().map(|(scene, _)| *scene)
    }

    /// Returns the number of its scenes.
    pub fn len(&self) -> u64 {
        self.manifests.len() as u64
    }

    /// Returns whether it has no scenes.
    pub fn is_empty(&self) -> bool {
        self.manifests.is_empty()
    }

    /// Returns the SHA-256 of a scene's manifest, in hexadecimal.
    pub fn manifest_sha256(&self, scene: u64) -> Option<String> {
        let at = self
            .manifests
            .binary_search_by_key(&scene, |(s, _)| *s)
            .ok()?;
        Some(hex::encode(self.manifests[at].1))
    }

    /// Returns an id that can be cited: the SHA-256 over each scene (8 bytes, little-endian) and
    /// the SHA-256 of its manifest (32 bytes). Snapshots with equal ids have equal bytes in every
    /// object; name and time are not part of the id.
    pub fn id(&self) -> String {
        let mut hash = Sha256::new();
        for (scene, manifest) in &self.manifests {
            hash.update(scene.to_le_bytes());
            hash.update(manifest);
        }
        hex::encode(hash.finalize())
    }

    /// Returns the changes from `self` to `later`.
    pub fn difference(&self, later: &Self) -> Difference {
        let mut found = Difference::default();
        for (scene, manifest) in &later.manifests {
            match self.manifests.binary_search_by_key(scene, |(s, _)| *s) {
                Err(_) => found.added.push(*scene),
                Ok(at) if self.manifests[at].1 != *manifest => found.changed.push(*scene),
                Ok(_) => found.same += 1,
            }
        }
        let gone = |scene: &u64| {
            later
                .manifests
                .binary_search_by_key(scene, |(s, _)| *s)
                .is_err()
        };
        found.removed = self.scenes().filter(gone).collect();
        found
    }

    fn to_bytes(&self) -> Vec<u8> {
        let stored = Stored {
            format: FORMAT,
            name: self.name.clone(),
            created: self.created.clone(),
            spec: self.spec,
            id: self.id(),
            bytes: self.bytes,
            scenes: intervals(self.scenes()),
            manifest_sha256: self.manifests.iter().map(|(_, m)| hex::encode(m)).collect(),
        };
        let json = serde_json::to_vec(&stored)
            .expect("a snapshot has only string keys and finite numbers");
        let mut packed = GzBuilder::new()
            .mtime(0)
            .write(Vec::new(), Compression::best());
        packed.write_all(&json).expect("memory can be written");
        packed.finish().expect("memory can be written")
    }

    /// Parses the content of a snapshot object, and checks that it is intact.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Self, String> {
        let mut json = Vec::new();
        let mut packed = GzDecoder::new(bytes);
        let most = bytes.len() as u64 * RATIO + (1 << 16);
        let unpacked = packed.by_ref().take(most + 1).read_to_end(&mut json);
        unpacked.map_err(|e| format!("not gzip: {e}"))?;
        if json.len() as u64 > most {
            return Err(format!(
                "unpacks to more than {most} bytes: it is no list of scenes"
            ));
        }
        if !packed.into_inner().is_empty() {
            return Err("has bytes after its end: it was changed".into());
        }
        let stored: Stored =
            serde_json::from_slice(&json).map_err(|e| format!("not a snapshot: {e}"))?;
        if stored.format > FORMAT {
            return Err(format!(
                "written in format {}, this program knows formats up to {FORMAT}: use a newer one",
                stored.format
            ));
        }
        let scenes = stored.scenes.iter().flat_map(|(start, end)| *start..*end);
        let mut manifests = Vec::with_capacity(stored.manifest_sha256.len());
        for (scene, text) in scenes.zip(&stored.manifest_sha256) {
            let mut manifest = [0; 32];
            hex::decode_to_slice(text, &mut manifest)
                .map_err(|e| format!("the SHA-256 of manifest {scene}: {e}"))?;
            manifests.push((scene, manifest));
        }
        let count: u64 = stored
            .scenes
            .iter()
            .map(|(a, b)| b.saturating_sub(*a))
            .sum();
        let snapshot = Self {
            name: stored.name,
            created: stored.created,
            spec: stored.spec,
            bytes: stored.bytes,
            manifests,
        };
        if count != snapshot.len()
            || snapshot.len() != stored.manifest_sha256.len() as u64
            || snapshot.id() != stored.id
        {
            return Err("its scenes do not have the id that it states: it was changed".into());
        }
        Ok(snapshot)
    }
}

impl Dataset {
    /// Returns an unstored snapshot of the data set's current state.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] names an unusable manifest, or an object that is missing or has
    /// another size; [`StorageError::Store`].
    pub async fn present(&self, watch: Watch<'_>) -> Result<Snapshot, StorageError> {
        let listing = self.listing().await?;
        let scenes: Vec<u64> = listing
            .manifests
            .iter()
            .copied()
            .filter(|s| *s < self.spec.scenes)
            .collect();
        let listing = &listing;
        let look = |scene: u64| -> BoxFuture<'_, Result<Looked, StorageError>> {
            async move {
                let path = self.path(&Manifest::key(scene));
                let bytes = objects::require(&*self.store, &path).await?;
                let damaged = |object: String, what: String| StorageError::Damaged { object, what };
                let manifest = self
                    .usable_manifest(&bytes, scene, &self.shown(&path))
                    .map_err(|what| damaged(self.shown(&path), what))?;
                for (array, object) in manifest.objects.iter().enumerate() {
                    let what = match listing.size(array, scene) {
                        Some(size) if size == object.size => continue,
                        Some(size) => format!("expected {} bytes, found {size}", object.size),
                        None => "the object is missing".into(),
                    };
                    return Err(damaged(self.shown(&self.path(&object.key)), what));
                }
                Ok((scene, Sha256::digest(&bytes).into(), manifest.total_bytes()))
            }
            .boxed()
        };
        let of = scenes.len() as u64;
        let mut looks = stream::iter(scenes.into_iter().map(look)).buffer_unordered(CONCURRENCY);
        let (mut manifests, mut total) = (Vec::new(), 0);
        while let Some((scene, manifest, bytes)) = looks.try_next().await? {
            manifests.push((scene, manifest));
            total += bytes;
            watch(manifests.len() as u64, of);
        }
        manifests.sort_unstable();
        Ok(Snapshot {
            name: String::new(),
            created: String::new(),
            spec: self.spec,
            bytes: total,
            manifests,
        })
    }

    /// Returns a pin of these scenes and their order, with their missing quantities. If the scenes
    /// are ascending, the id is the [`Snapshot::id`] of these scenes alone. Objects are not
    /// checked.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`] names a missing scene; [`StorageError::Damaged`] for an
    /// unreadable manifest; [`StorageError::Store`].
    pub async fn pin(&self, scenes: &[u64]) -> Result<Pinned, StorageError> {
        /// A manifest's hash, and the scene's missing quantities.
        type Look = Result<([u8; 32], Vec<String>), StorageError>;
        let look = |scene: u64| -> BoxFuture<'_, Look> {
            async move {
                let path = self.path(&Manifest::key(scene));
                let Some(bytes) = objects::get(&*self.store, &path).await? else {
                    return Err(StorageError::NotPublished {
                        scene,
                        object: self.shown(&path),
                    });
                };
                let manifest = Manifest::parse(&bytes, scene, &self.shown(&path))?;
                Ok((Sha256::digest(&bytes).into(), manifest.missing()))
            }
            .boxed()
        };
        let looks = stream::iter(scenes.iter().map(|scene| look(*scene))).buffered(CONCURRENCY);
        let found: Vec<([u8; 32], Vec<String>)> = looks.try_collect().await?;
        let (mut hash, mut missing) = (Sha256::new(), Vec::new());
        let mut manifests = Vec::with_capacity(scenes.len());
        for (scene, (manifest, of_scene)) in scenes.iter().zip(found) {
            hash.update(scene.to_le_bytes());
            hash.update(manifest);
            manifests.push(manifest);
            if !of_scene.is_empty() {
                missing.push((*scene, of_scene));
            }
        }
        Ok(Pinned {
            id: hex::encode(hash.finalize()),
            missing,
            manifests,
        })
    }

    /// Stores a snapshot create-only under its name. Returns its size, or `None` if the name
    /// already has a snapshot with the same id.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the name is invalid or belongs to another snapshot;
    /// [`StorageError::Store`].
    pub async fn create_snapshot(&self, snapshot: &Snapshot) -> Result<Option<u64>, StorageError> {
        check_name(&snapshot.name)?;
        let bytes = snapshot.to_bytes();
        let size = bytes.len() as u64;
        let path = self.path(&key(&snapshot.name));
        if objects::create(&*self.store, &path, bytes.into()).await? {
            return Ok(Some(size));
        }
        let stored = self.snapshot(&snapshot.name).await?;
        if stored.id() == snapshot.id() {
            return Ok(None);
        }
        let what = format!(
            "{:?} is that of another snapshot ({} scenes, {}), and snapshots never change; choose another name",
            stored.name,
            stored.len(),
            stored.created
        );
        Err(StorageError::invalid("snapshot", what))
    }

    /// Reads a stored snapshot.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if there is none of this name; [`StorageError::Damaged`];
    /// [`StorageError::Store`].
    pub async fn snapshot(&self, name: &str) -> Result<Snapshot, StorageError> {
        check_name(name)?;
        let path = self.path(&key(name));
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            let there = self.snapshots().await?;
            let there = match there.is_empty() {
                true => "none".to_owned(),
                false => there.join(", "),
            };
            let what = format!(
                "{} has no snapshot {name:?}; there are: {there}",
                self.shown(&self.prefix)
            );
            return Err(StorageError::invalid("snapshot", what));
        };
        Snapshot::parse(&bytes).map_err(|what| StorageError::Damaged {
            object: self.shown(&path),
            what,
        })
    }

    /// Returns the names of the stored snapshots, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn snapshots(&self) -> Result<Vec<String>, StorageError> {
        let folder = self.path("snapshots");
        let failed = |e| StorageError::store("list", self.shown(&folder), e);
        let mut names = Vec::new();
        let mut listed = self.store.list(Some(&folder));
        while let Some(object) = listed.try_next().await.map_err(failed)? {
            let key = self.relative(&object.location);
            names.extend(name_of(&key).map(str::to_owned));
        }
        names.sort();
        Ok(names)
    }

    /// Returns a snapshot's location for messages.
    pub fn snapshot_place(&self, name: &str) -> String {
        self.shown(&self.path(&key(name)))
    }
}

fn key(name: &str) -> String {
    format!("snapshots/{name}.json.gz")
}

fn check_name(name: &str) -> Result<(), StorageError> {
    if is_name(name) {
        return Ok(());
    }
    let what = format!(
        "{name:?} must be up to 64 letters, digits, '-', '_' and '.', and not begin with '.'"
    );
    Err(StorageError::invalid("snapshot", what))
}

fn is_name(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    (1..=64).contains(&name.len()) && !name.starts_with('.') && name.chars().all(plain)
}

fn name_of(key: &str) -> Option<&str> {
    let name = key.strip_prefix("snapshots/")?.strip_suffix(".json.gz")?;
    is_name(name).then_some(name)
}

/// Returns whether a key relative to the data set belongs to a snapshot.
pub(crate) fn is_snapshot(key: &str) -> bool {
    name_of(key).is_some()
}

fn intervals(scenes: impl Iterator<Item = u64>) -> Vec<(u64, u64)> {
    let mut intervals: Vec<(u64, u64)> = Vec::new();
    for scene in scenes {
        match intervals.last_mut() {
            Some((_, end)) if *end == scene => *end += 1,
            _ => intervals.push((scene, scene + 1)),
        }
    }
    intervals
}
