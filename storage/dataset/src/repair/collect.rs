//! Garbage collection: finds and deletes objects that belong to no published scene.
//!
//! A killed worker leaves objects without a manifest. They may still be useful: the next worker
//! that renders the scene finds them equal and publishes them. Therefore only old ones are deleted,
//! and a published scene never loses an object, whenever its manifest appears:
//!
//! - a scene in a snapshot is not touched even if its manifest was lost;
//! - objects are listed first and manifests after them, and the scene's manifest is looked up again
//!   right before an object is deleted;
//! - the publisher checks its objects again after writing the manifest
//!   ([`Dataset::publish_encoded`]);
//! - the collector looks up the manifest again after deleting an object, and restores the object if
//!   there is one.
//!
//! Thus the publisher notices a deletion before the manifest, and the collector one after it. The
//! remaining risk is a collector that is killed or disconnected between a deletion and its last
//! lookup, after finding no manifest just before. In that case `verify` reports the object, and
//! publishing the scene again restores it.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::path::Path;
use object_store::{Error, ObjectMeta, ObjectStoreExt};

use crate::layout::manifest::Manifest;
use crate::scenes::dataset::Dataset;
use crate::scenes::parts::part_scene;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::{PROBE, leftovers, probe_leftovers};

/// The minimum grace period while workers may be writing. It is longer than publishing a scene ever
/// takes.
pub const MIN_GRACE: Duration = Duration::from_secs(3600);

/// Number of concurrent deletions. Each has its object in memory.
const CONCURRENCY: usize = 4;

/// An object that belongs to no published scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Orphan {
    /// Full key (its path, in a local store).
    pub object: String,
    /// Size in bytes.
    pub bytes: u64,
    /// The scene it would belong to; `None` for parts in transit, models, and objects left by a
    /// killed probe or local write.
    pub scene: Option<u64>,
    /// The reason why it can be deleted.
    pub cause: OrphanCause,
}

/// The reason why an object can be deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OrphanCause {
    /// Its scene has no manifest.
    Scene,
    /// It is a part of a scene that was never joined.
    Part,
    /// It was left by a killed probe of the store.
    Probe,
    /// It is the unfinished file of a killed local write.
    Write,
    /// It is a checkpoint of an abandoned training.
    Checkpoint,
    /// It is a shard of an evaluation that was never joined.
    Shard,
    /// It is a call of the processes of an abandoned training.
    Call,
    /// No manifest of its model lists it.
    Model,
}

impl Orphan {
    /// Returns the reason why it can be deleted, as text.
    pub fn why(&self) -> &'static str {
        match self.cause {
            OrphanCause::Scene => "its scene has no manifest: left by a killed worker",
            OrphanCause::Probe => "left by a killed probe of the store",
            OrphanCause::Write => "unfinished file of a killed write",
            OrphanCause::Checkpoint => "checkpoint of a training that nobody goes on with",
            OrphanCause::Model => {
                "its model has no manifest that names it: left by a killed worker"
            }
            OrphanCause::Shard => "shard of an evaluation that nobody joined",
            OrphanCause::Call => "call of a training that nobody goes on with",
            OrphanCause::Part => "part of a scene that nobody joined",
        }
    }
}

/// The result of [`Dataset::collect`].
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Collection {
    /// Orphans past the grace period, ordered by key; deleted, if requested.
    pub orphans: Vec<Orphan>,
    /// Number of objects without a manifest that were retained because they are too young.
    pub young: u64,
    /// Number of orphans that were retained because their scene was published in the meantime.
    pub published: u64,
    /// Number of objects without a manifest that were retained because a snapshot lists their
    /// scene. The manifest was lost, and `repair` can restore it.
    pub pinned: u64,
}

impl Collection {
    /// Returns the total size of the orphans in bytes.
    pub fn bytes(&self) -> u64 {
        self.orphans.iter().map(|o| o.bytes).sum()
    }
}

/// A candidate for deletion.
enum Candidate {
    Object(ObjectMeta, Option<u64>, OrphanCause),
    /// An unfinished file of a local store.
    File(PathBuf, u64, OrphanCause),
}

impl Dataset {
    /// Finds objects that were last written at least `grace` ago and belong neither to a published
    /// scene nor to a scene in a snapshot: objects of scenes without a manifest, parts of scenes
    /// that were never joined, and leftovers of killed probes and local writes. Deletes them if
    /// `delete` is set. Objects listed in a manifest, and unknown objects, are never touched. With
    /// a period below [`MIN_GRACE`], no worker may be writing to this data set.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if a snapshot cannot be read, so that its scenes are unknown;
    /// [`StorageError::Store`], [`StorageError::Io`]. Objects deleted before the error stay
    /// deleted; the collection can be repeated.
    pub async fn collect(&self, grace: Duration, delete: bool) -> Result<Collection, StorageError> {
        let limit = self.age_limit(grace, delete).await?;
        self.collect_before(limit, grace, delete).await
    }

    /// Returns the time `grace` ago. If `delete` is set, it is by the clock that sets the
    /// timestamps of this store's objects.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn age_limit(
        &self,
        grace: Duration,
        delete: bool,
    ) -> Result<SystemTime, StorageError> {
        let now = match delete {
            true => self.store_time().await?,
            false => SystemTime::now(),
        };
        Ok(now.checked_sub(grace).unwrap_or(SystemTime::UNIX_EPOCH))
    }

    /// Like [`Self::collect`], with the time before which objects are old.
    ///
    /// # Errors
    /// Those of [`Self::collect`].
    pub async fn collect_before(
        &self,
        limit: SystemTime,
        grace: Duration,
        delete: bool,
    ) -> Result<Collection, StorageError> {
        let mut report = Collection::default();
        let mut found = self.unpublished(limit, &mut report).await?;
        found.extend(self.leavings(limit, grace).await?);
        let removals: Vec<_> = found
            .into_iter()
            .map(|found| self.collect_one(found, limit, delete))
            .collect();
        let mut removed = stream::iter(removals).buffer_unordered(CONCURRENCY);
        while let Some(orphan) = removed.try_next().await? {
            match orphan {
                Some(orphan) => report.orphans.push(orphan),
                None => report.published += 1,
            }
        }
        report.orphans.sort_by(|a, b| a.object.cmp(&b.object));
        Ok(report)
    }

    /// Finds objects written before `limit`, of scenes without a manifest that are not in a
    /// snapshot either. Counts the younger ones.
    async fn unpublished(
        &self,
        limit: SystemTime,
        report: &mut Collection,
    ) -> Result<Vec<Candidate>, StorageError> {
        let failed = |e| StorageError::store("list", self.shown(&self.prefix), e);
        // Published scenes stay published, so their objects need not be remembered until the
        // manifests are listed again.
        let seen = self.scenes_present().await?;
        let mut objects: Vec<(u64, ObjectMeta)> = Vec::new();
        let mut listing = self.store.list(Some(&self.prefix));
        let mut parts = Vec::new();
        while let Some(object) = listing.try_next().await.map_err(failed)? {
            let key = self.relative(&object.location);
            let place = self.object_place(&key);
            if part_scene(&key).is_some() {
                parts.push(object);
            } else if let Some((_, scene)) = place
                && seen.binary_search(&scene).is_err()
            {
                objects.push((scene, object));
            }
        }
        drop((listing, seen));
        if !objects.is_empty() {
            let published = self.scenes_present().await?;
            objects.retain(|(scene, _)| published.binary_search(scene).is_err());
            let found = objects.len();
            let pinned = self.pinned().await?;
            objects.retain(|(scene, _)| !pinned.contains(scene));
            report.pinned = (found - objects.len()) as u64;
        }
        let all = objects.len() + parts.len();
        let old = |object: &ObjectMeta| SystemTime::from(object.last_modified) <= limit;
        objects.retain(|(_, object)| old(object));
        // No manifest lists a part, before or after its scene is published. A worker that misses a
        // part renders it again.
        parts.retain(old);
        report.young = (all - objects.len() - parts.len()) as u64;
        let scenes = objects.into_iter();
        let scenes = scenes
            .map(|(scene, object)| Candidate::Object(object, Some(scene), OrphanCause::Scene));
        let parts = parts.into_iter();
        let parts = parts.map(|object| Candidate::Object(object, None, OrphanCause::Part));
        Ok(scenes.chain(parts).collect())
    }

    /// Returns the scenes in any snapshot.
    async fn pinned(&self) -> Result<BTreeSet<u64>, StorageError> {
        let mut pinned = BTreeSet::new();
        for name in self.snapshots().await? {
            pinned.extend(self.snapshot(&name).await?.scenes());
        }
        Ok(pinned)
    }

    /// Finds leftovers of killed probes next to the data set, and of killed local writes in it.
    async fn leavings(
        &self,
        limit: SystemTime,
        grace: Duration,
    ) -> Result<Vec<Candidate>, StorageError> {
        let Some(parent) = self.parent() else {
            return Ok(Vec::new());
        };
        let listed = self.store.list_with_delimiter(Some(&parent)).await;
        let listed = listed.map_err(|e| StorageError::store("list", self.shown(&parent), e))?;
        let is_probe = |object: &ObjectMeta| {
            let name = object.location.filename().unwrap_or_default();
            name.starts_with(PROBE) && SystemTime::from(object.last_modified) <= limit
        };
        let probes = listed.objects.into_iter().filter(is_probe);
        let mut found: Vec<_> = probes
            .map(|object| Candidate::Object(object, None, OrphanCause::Probe))
            .collect();
        let folder = |path| objects::folder(&*self.store, path);
        if let (Some(here), Some(parent_folder)) = (folder(&self.prefix), folder(&parent)) {
            let file = |cause| move |(path, bytes)| Candidate::File(path, bytes, cause);
            let files = leftovers(&here, grace)?;
            found.extend(files.into_iter().map(file(OrphanCause::Write)));
            let probes = probe_leftovers(&parent_folder, grace)?;
            found.extend(probes.into_iter().map(file(OrphanCause::Probe)));
        }
        Ok(found)
    }

    /// Returns the data set's parent, where stores are probed; `None` if the data set is the root
    /// of its store.
    pub fn parent(&self) -> Option<Path> {
        let parts: Vec<_> = self.prefix.parts().collect();
        let (_, parent) = parts.split_last()?;
        Some(parent.iter().cloned().collect())
    }

    /// Deletes an orphan, if it still is one. Returns `None` otherwise.
    async fn collect_one(
        &self,
        found: Candidate,
        limit: SystemTime,
        delete: bool,
    ) -> Result<Option<Orphan>, StorageError> {
        let (object, scene, cause) = match found {
            Candidate::File(path, bytes, cause) => {
                if delete {
                    match std::fs::remove_file(&path) {
                        Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                            return Err(StorageError::io("delete", &path, e));
                        }
                        _ => {}
                    }
                }
                return Ok(Some(Orphan {
                    object: path.display().to_string(),
                    bytes,
                    scene: None,
                    cause,
                }));
            }
            Candidate::Object(object, scene, cause) => (object, scene, cause),
        };
        let path = &object.location;
        if delete && !self.delete_orphan(path, scene, limit).await? {
            return Ok(None);
        }
        Ok(Some(Orphan {
            object: self.shown(path),
            bytes: object.size,
            scene,
            cause,
        }))
    }

    /// Deletes an object. Returns `false` if a manifest protects it, or it was rewritten.
    async fn delete_orphan(
        &self,
        path: &Path,
        scene: Option<u64>,
        limit: SystemTime,
    ) -> Result<bool, StorageError> {
        let Some(bytes) = self.still_old(path, limit).await? else {
            return Ok(false);
        };
        if self.is_published(scene).await? {
            return Ok(false);
        }
        match self.store.delete(path).await {
            Ok(()) | Err(Error::NotFound { .. }) => {}
            Err(e) => return Err(StorageError::store("delete", self.shown(path), e)),
        }
        if self.is_published(scene).await? {
            objects::create_or_match(&*self.store, path, bytes).await?;
            return Ok(false);
        }
        Ok(true)
    }

    /// Reads an object, if it was not rewritten since it was listed.
    async fn still_old(
        &self,
        path: &Path,
        limit: SystemTime,
    ) -> Result<Option<Bytes>, StorageError> {
        let failed = |e| StorageError::store("read", self.shown(path), e);
        let result = match self.store.get(path).await {
            Ok(result) => result,
            Err(Error::NotFound { .. }) => return Ok(None),
            Err(e) => return Err(failed(e)),
        };
        if SystemTime::from(result.meta.last_modified) > limit {
            return Ok(None);
        }
        result.bytes().await.map(Some).map_err(failed)
    }

    async fn is_published(&self, scene: Option<u64>) -> Result<bool, StorageError> {
        let Some(scene) = scene else {
            return Ok(false);
        };
        let manifest = self.path(&Manifest::key(scene));
        Ok(objects::size(&*self.store, &manifest).await?.is_some())
    }

    /// Returns the time of the clock that sets the timestamps of this store's objects, which may
    /// differ from the local clock.
    async fn store_time(&self) -> Result<SystemTime, StorageError> {
        let name = format!("{PROBE}{}-time", uuid::Uuid::new_v4());
        let parent = self.parent().unwrap_or_default();
        let path = parent.join(name);
        objects::create(&*self.store, &path, Bytes::from_static(b"what time is it?")).await?;
        let meta = self.store.head(&path).await;
        let deleted = self.store.delete(&path).await;
        let meta = meta.map_err(|e| StorageError::store("look up", self.shown(&path), e))?;
        deleted.map_err(|e| StorageError::store("delete", self.shown(&path), e))?;
        Ok(meta.last_modified.into())
    }
}
