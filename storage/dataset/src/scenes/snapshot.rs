//! Snapshots of a data set: `snapshots/<name>.json.gz`, which scenes there were with which manifests. Create-only and
//! never changed; since a manifest names its objects by SHA-256, a snapshot pins every byte. Growth of the data set does
//! not change it, and [`Dataset::collect`] spares whatever belongs to a scene that it names.

use std::io::{Read, Write};

use flate2::{Compression, GzBuilder, bufread::GzDecoder};
use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::error::DatasetError;
use crate::layout::manifest::Manifest;
use crate::layout::spec::DatasetSpec;
use crate::scenes::dataset::Dataset;
use crate::store::objects;
use crate::verify::report::Watch;

/// Version of snapshots.
const FORMAT: u32 = 1;
/// Manifests read at a time.
const CONCURRENCY: usize = 32;
/// A snapshot is so many times its packed size at most: it consists of hashes, which do not pack well.
const RATIO: u64 = 64;

/// Scenes of a data set, pinned.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pinned {
    /// What pins every byte of them, and their order, hexadecimal.
    pub id: String,
    /// Scenes of which something is not known, with [`Manifest::missing`], in their order.
    pub missing: Vec<(u64, Vec<String>)>,
    /// SHA-256 of each scene's manifest, in their order.
    pub manifests: Vec<[u8; 32]>,
}

/// Which scenes a data set had, and which manifests.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Its name; empty for one that is not stored.
    pub name: String,
    /// When it was made, as its maker says.
    pub created: String,
    /// The data set's properties then.
    pub spec: DatasetSpec,
    /// Bytes of all objects, without manifests.
    pub bytes: u64,
    /// By scene, ascending: SHA-256 of the manifest.
    manifests: Vec<(u64, [u8; 32])>,
}

/// The form in which it is stored.
#[derive(Serialize, Deserialize)]
struct Stored {
    format: u32,
    name: String,
    created: String,
    spec: DatasetSpec,
    /// [`Snapshot::id`].
    id: String,
    bytes: u64,
    /// Intervals of scenes, the ends not included.
    scenes: Vec<(u64, u64)>,
    /// Hexadecimal, in the order of the scenes.
    manifest_sha256: Vec<String>,
}

/// A scene, the SHA-256 of its manifest, and its bytes.
type Looked = (u64, [u8; 32], u64);

/// How two snapshots differ; scenes ascending.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Difference {
    /// Only in the second.
    pub added: Vec<u64>,
    /// Only in the first.
    pub removed: Vec<u64>,
    /// In both, with different manifests.
    pub changed: Vec<u64>,
    /// In both, alike.
    pub same: u64,
}

impl Snapshot {
    /// The same under a name, made at the given time.
    #[must_use]
    pub fn named(self, name: impl Into<String>, created: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            created: created.into(),
            ..self
        }
    }

    /// Its scenes, ascending.
    pub fn scenes(&self) -> impl Iterator<Item = u64> {
        self.manifests.iter().map(|(scene, _)| *scene)
    }

    /// Number of its scenes.
    pub fn len(&self) -> u64 {
        self.manifests.len() as u64
    }

    /// Whether it has no scene.
    pub fn is_empty(&self) -> bool {
        self.manifests.is_empty()
    }

    /// SHA-256 of a scene's manifest, hexadecimal.
    pub fn manifest_sha256(&self, scene: u64) -> Option<String> {
        let at = self
            .manifests
            .binary_search_by_key(&scene, |(s, _)| *s)
            .ok()?;
        Some(hex::encode(self.manifests[at].1))
    }

    /// What it pins, in a line that can be quoted: SHA-256 over each scene (8 bytes, little-endian) and the SHA-256 of
    /// its manifest (32 bytes). Equal ids, equal bytes of every object; name and time do not count.
    pub fn id(&self) -> String {
        let mut hash = Sha256::new();
        for (scene, manifest) in &self.manifests {
            hash.update(scene.to_le_bytes());
            hash.update(manifest);
        }
        hex::encode(hash.finalize())
    }

    /// What became different from `self` to `later`.
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

    /// The snapshot in an object, if it is whole.
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
    /// The data set as it is now, in a snapshot that is not stored yet.
    ///
    /// # Errors
    /// [`DatasetError::Damaged`] names an unusable manifest, or an object that is missing or has another size;
    /// [`DatasetError::Store`].
    pub async fn present(&self, watch: Watch<'_>) -> Result<Snapshot, DatasetError> {
        let listing = self.listing().await?;
        let scenes: Vec<u64> = listing
            .manifests
            .iter()
            .copied()
            .filter(|s| *s < self.spec.scenes)
            .collect();
        let listing = &listing;
        let look = |scene: u64| -> BoxFuture<'_, Result<Looked, DatasetError>> {
            async move {
                let path = self.path(&Manifest::key(scene));
                let bytes = objects::require(&*self.store, &path).await?;
                let damaged = |object: String, what: String| DatasetError::Damaged { object, what };
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

    /// What pins every byte of these scenes, and their order: [`Snapshot::id`] of them alone, if they are ascending; and
    /// what is not known of them. Their objects are not looked at.
    ///
    /// # Errors
    /// [`DatasetError::NotPublished`] names a scene that is not there; [`DatasetError::Damaged`] for a manifest that cannot be
    /// read; [`DatasetError::Store`].
    pub async fn pin(&self, scenes: &[u64]) -> Result<Pinned, DatasetError> {
        /// A manifest's hash, and what the scene lacks.
        type Look = Result<([u8; 32], Vec<String>), DatasetError>;
        let look = |scene: u64| -> BoxFuture<'_, Look> {
            async move {
                let path = self.path(&Manifest::key(scene));
                let Some(bytes) = objects::get(&*self.store, &path).await? else {
                    return Err(DatasetError::NotPublished {
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

    /// Stores a snapshot create-only under its name; gives its size. `None`: one with the same id has this name already.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] for a name that cannot be used or that another snapshot has; [`DatasetError::Store`].
    pub async fn create_snapshot(&self, snapshot: &Snapshot) -> Result<Option<u64>, DatasetError> {
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
        Err(DatasetError::invalid("snapshot", what))
    }

    /// A stored snapshot.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] where there is none of this name; [`DatasetError::Damaged`]; [`DatasetError::Store`].
    pub async fn snapshot(&self, name: &str) -> Result<Snapshot, DatasetError> {
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
            return Err(DatasetError::invalid("snapshot", what));
        };
        Snapshot::parse(&bytes).map_err(|what| DatasetError::Damaged {
            object: self.shown(&path),
            what,
        })
    }

    /// The names of the stored snapshots, ascending.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn snapshots(&self) -> Result<Vec<String>, DatasetError> {
        let folder = self.path("snapshots");
        let failed = |e| DatasetError::store("list", self.shown(&folder), e);
        let mut names = Vec::new();
        let mut listed = self.store.list(Some(&folder));
        while let Some(object) = listed.try_next().await.map_err(failed)? {
            let key = self.relative(&object.location);
            names.extend(name_of(&key).map(str::to_owned));
        }
        names.sort();
        Ok(names)
    }

    /// Where a snapshot lies, for a message.
    pub fn snapshot_place(&self, name: &str) -> String {
        self.shown(&self.path(&key(name)))
    }
}

fn key(name: &str) -> String {
    format!("snapshots/{name}.json.gz")
}

fn check_name(name: &str) -> Result<(), DatasetError> {
    if is_name(name) {
        return Ok(());
    }
    let what = format!(
        "{name:?} must be up to 64 letters, digits, '-', '_' and '.', and not begin with '.'"
    );
    Err(DatasetError::invalid("snapshot", what))
}

fn is_name(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    (1..=64).contains(&name.len()) && !name.starts_with('.') && name.chars().all(plain)
}

fn name_of(key: &str) -> Option<&str> {
    let name = key.strip_prefix("snapshots/")?.strip_suffix(".json.gz")?;
    is_name(name).then_some(name)
}

/// Whether a key relative to the data set is that of a snapshot.
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
