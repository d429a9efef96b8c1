//! Collection: finding and deleting what belongs to no published scene.
//!
//! A killed worker leaves objects without a manifest. They are not rubbish by themselves: whoever renders the scene
//! next finds them equal and publishes them. So only old ones are deleted, and a published scene never loses an
//! object, whenever its manifest appears:
//!
//! - a scene that a snapshot names is spared although its manifest was lost;
//! - objects are listed first, manifests after them, and the scene's manifest is looked for once more right before the
//!   deletion of an object;
//! - the publisher looks after its objects once more when its manifest stands ([`Dataset::publish_encoded`]);
//! - the collector looks for the manifest once more when an object is gone, and puts it back if there is one.
//!
//! So a deletion before the manifest is noticed by the publisher, one after it by the collector. What remains is a
//! collector killed or cut off in the instant between a deletion and its last look, which had found no manifest an instant before;
//! then `verify` names the object, and publishing the scene again restores it.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::path::Path;
use object_store::{Error, ObjectMeta, ObjectStoreExt};

use crate::checkpoints;
use crate::error::DatasetError;
use crate::layout::manifest::Manifest;
use crate::models::Models;
use crate::scenes::dataset::Dataset;
use crate::scenes::parts::part_scene;
use crate::store::objects;
use crate::store::{PROBE, leftovers, probe_leftovers};

/// The shortest grace period where workers may be writing: longer than publishing a scene ever takes.
pub const MIN_GRACE: Duration = Duration::from_secs(3600);

/// Deletions in flight. Each holds its object in memory.
const CONCURRENCY: usize = 4;

/// Something that belongs to no published scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Orphan {
    /// Full key (its path, in a local store).
    pub object: String,
    /// Its size.
    pub bytes: u64,
    /// The scene it would belong to; `None` for parts on their way, models, and what a killed probe or a killed local write
    /// left.
    pub scene: Option<u64>,
}

impl Orphan {
    /// Why it is rubbish.
    pub fn why(&self) -> &'static str {
        let name = self.object.rsplit('/').next().unwrap_or_default();
        match self.scene {
            Some(_) => "its scene has no manifest: left by a killed worker",
            None if name.starts_with(PROBE) => "left by a killed probe of the store",
            None if name.contains('#') => "unfinished file of a killed write",
            None if name.ends_with(".ckpt") || name.ends_with(checkpoints::PART) => {
                "checkpoint of a training that nobody goes on with"
            }
            None if !name.ends_with(".zst") => {
                "its model has no manifest that names it: left by a killed worker"
            }
            None => "part of a scene that nobody joined",
        }
    }
}

/// What [`Dataset::collect`] found.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Collection {
    /// Orphans past the grace period, ordered by key; deleted, if that was asked for.
    pub orphans: Vec<Orphan>,
    /// Objects without a manifest that were left alone because they are younger.
    pub young: u64,
    /// Orphans that were left alone because their scene was published in the meantime.
    pub published: u64,
    /// Objects without a manifest that were left alone because a snapshot names their scene: its manifest was lost, and
    /// `repair` can put it back.
    pub pinned: u64,
}

impl Collection {
    /// Bytes of the orphans.
    pub fn bytes(&self) -> u64 {
        self.orphans.iter().map(|o| o.bytes).sum()
    }
}

/// A candidate.
enum Found {
    Object(ObjectMeta, Option<u64>),
    /// An unfinished file of a local store.
    File(PathBuf, u64),
}

impl Dataset {
    /// Finds what belongs to no published scene nor to one that a snapshot names, and was last written `grace` ago or
    /// earlier: objects of scenes without a manifest, parts of scenes that nobody joined, and what killed probes and
    /// killed local writes left; and of the store's models, checkpoints that nobody goes on with and objects that no
    /// manifest names. Deletes it if `delete` says so. Never touches
    /// an object that a manifest names, or that it does not know. With less than [`MIN_GRACE`] no worker may be writing
    /// to this data set.
    ///
    /// # Errors
    /// [`DatasetError::Damaged`] where a snapshot cannot be read, so that it is unknown what it names;
    /// [`DatasetError::Store`], [`DatasetError::Io`]. What was deleted until then stays deleted; collect again.
    pub async fn collect(&self, grace: Duration, delete: bool) -> Result<Collection, DatasetError> {
        let now = match delete {
            true => self.store_time().await?,
            false => SystemTime::now(),
        };
        let limit = now.checked_sub(grace).unwrap_or(SystemTime::UNIX_EPOCH);
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
        if let Some(store) = self.parent() {
            let models = Models::new(self.store.clone(), &store);
            report
                .orphans
                .extend(models.collect(limit, grace, delete).await?);
        }
        report.orphans.sort_by(|a, b| a.object.cmp(&b.object));
        Ok(report)
    }

    /// Objects of scenes without a manifest that no snapshot names either, written before `limit`. Counts the younger
    /// ones.
    async fn unpublished(
        &self,
        limit: SystemTime,
        report: &mut Collection,
    ) -> Result<Vec<Found>, DatasetError> {
        let failed = |e| DatasetError::store("list", self.shown(&self.prefix), e);
        // What is published stays published: these need not be kept until the manifests are listed once more.
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
        // No manifest names a part, before or after its scene is published: who misses one renders it again.
        parts.retain(old);
        report.young = (all - objects.len() - parts.len()) as u64;
        let scenes = objects.into_iter();
        let scenes = scenes.map(|(scene, object)| Found::Object(object, Some(scene)));
        let parts = parts.into_iter().map(|object| Found::Object(object, None));
        Ok(scenes.chain(parts).collect())
    }

    /// The scenes that some snapshot names.
    async fn pinned(&self) -> Result<BTreeSet<u64>, DatasetError> {
        let mut pinned = BTreeSet::new();
        for name in self.snapshots().await? {
            pinned.extend(self.snapshot(&name).await?.scenes());
        }
        Ok(pinned)
    }

    /// What killed probes left beside the data set, and killed local writes in it.
    async fn leavings(
        &self,
        limit: SystemTime,
        grace: Duration,
    ) -> Result<Vec<Found>, DatasetError> {
        let Some(parent) = self.parent() else {
            return Ok(Vec::new());
        };
        let listed = self.store.list_with_delimiter(Some(&parent)).await;
        let listed = listed.map_err(|e| DatasetError::store("list", self.shown(&parent), e))?;
        let is_probe = |object: &ObjectMeta| {
            let name = object.location.filename().unwrap_or_default();
            name.starts_with(PROBE) && SystemTime::from(object.last_modified) <= limit
        };
        let probes = listed.objects.into_iter().filter(is_probe);
        let mut found: Vec<_> = probes.map(|object| Found::Object(object, None)).collect();
        let folder = |path| objects::folder(&*self.store, path);
        if let (Some(here), Some(beside)) = (folder(&self.prefix), folder(&parent)) {
            let files = leftovers(&here, grace)?;
            let files = files.into_iter().chain(probe_leftovers(&beside, grace)?);
            found.extend(files.map(|(path, bytes)| Found::File(path, bytes)));
        }
        Ok(found)
    }

    /// The prefix that the data set lies in, where stores are probed; `None` if it is the root of its store.
    fn parent(&self) -> Option<Path> {
        let parts: Vec<_> = self.prefix.parts().collect();
        let (_, parent) = parts.split_last()?;
        Some(parent.iter().cloned().collect())
    }

    /// Deletes an orphan, if it still is one; `None` if it is not.
    async fn collect_one(
        &self,
        found: Found,
        limit: SystemTime,
        delete: bool,
    ) -> Result<Option<Orphan>, DatasetError> {
        let (object, scene) = match found {
            Found::File(path, bytes) => {
                if delete {
                    match std::fs::remove_file(&path) {
                        Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                            return Err(DatasetError::io("delete", &path, e));
                        }
                        _ => {}
                    }
                }
                return Ok(Some(Orphan {
                    object: path.display().to_string(),
                    bytes,
                    scene: None,
                }));
            }
            Found::Object(object, scene) => (object, scene),
        };
        let path = &object.location;
        if delete && !self.delete_orphan(path, scene, limit).await? {
            return Ok(None);
        }
        Ok(Some(Orphan {
            object: self.shown(path),
            bytes: object.size,
            scene,
        }))
    }

    /// `false` if a manifest protects it, or it was written anew.
    async fn delete_orphan(
        &self,
        path: &Path,
        scene: Option<u64>,
        limit: SystemTime,
    ) -> Result<bool, DatasetError> {
        let Some(bytes) = self.still_old(path, limit).await? else {
            return Ok(false);
        };
        if self.is_published(scene).await? {
            return Ok(false);
        }
        match self.store.delete(path).await {
            Ok(()) | Err(Error::NotFound { .. }) => {}
            Err(e) => return Err(DatasetError::store("delete", self.shown(path), e)),
        }
        if self.is_published(scene).await? {
            objects::create_or_match(&*self.store, path, bytes).await?;
            return Ok(false);
        }
        Ok(true)
    }

    /// The bytes of an object that was not written again since it was listed.
    async fn still_old(
        &self,
        path: &Path,
        limit: SystemTime,
    ) -> Result<Option<Bytes>, DatasetError> {
        let failed = |e| DatasetError::store("read", self.shown(path), e);
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

    async fn is_published(&self, scene: Option<u64>) -> Result<bool, DatasetError> {
        let Some(scene) = scene else {
            return Ok(false);
        };
        let manifest = self.path(&Manifest::key(scene));
        Ok(objects::size(&*self.store, &manifest).await?.is_some())
    }

    /// The time by the clock that stamps this store's objects, which need not agree with ours.
    async fn store_time(&self) -> Result<SystemTime, DatasetError> {
        let name = format!("{PROBE}{}-time", uuid::Uuid::new_v4());
        let parent = self.parent().unwrap_or_default();
        let path = parent.join(name);
        objects::create(&*self.store, &path, Bytes::from_static(b"what time is it?")).await?;
        let meta = self.store.head(&path).await;
        let deleted = self.store.delete(&path).await;
        let meta = meta.map_err(|e| DatasetError::store("look up", self.shown(&path), e))?;
        deleted.map_err(|e| DatasetError::store("delete", self.shown(&path), e))?;
        Ok(meta.last_modified.into())
    }
}
