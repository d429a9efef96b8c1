//! Checks a data set against its manifests: fast by a listing, or in full by the content of every
//! object.
//!
//! Memory use is bounded: eight bytes per object for the listing, a few scenes' manifests at a
//! time, and in full mode the objects that are decoded concurrently.

mod metadata;

use std::sync::Arc;

use bytes::Bytes;
use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt, TryStreamExt, stream};

use crate::layout::manifest::Manifest;
use crate::repair::listing::Listing;
use crate::scenes::dataset::Dataset;
use crate::scenes::snapshot::Snapshot;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::{ObjectEntry, sha256_hex};

pub use metadata::metadata_fault;
use picofarm_store::{Fault, Problem, Verification, VerifyMode, Watch};

/// Number of manifests read concurrently.
const MANIFESTS: usize = 32;
/// Number of a scene's objects read concurrently.
const OBJECTS: usize = 4;
/// Maximum number of scenes checked in full concurrently; each needs memory for a decoded
/// histogram.
const SCENES: usize = 4;

/// Options of a check.
#[derive(Clone, Copy)]
pub struct VerifyOptions<'a> {
    /// The thoroughness.
    pub mode: VerifyMode,
    /// Whether a scene without a manifest is a problem, up to the data set's capacity.
    pub complete: bool,
    /// If set, checks only the scenes of this snapshot, which must be unchanged since then.
    pub snapshot: Option<&'a Snapshot>,
    /// Called regularly with the progress.
    pub watch: Watch<'a>,
}

impl VerifyOptions<'_> {
    /// Returns options to check all scenes, without progress.
    pub fn new(mode: VerifyMode) -> Self {
        Self {
            mode,
            complete: false,
            snapshot: None,
            watch: &|_, _| {},
        }
    }
}

impl Dataset {
    /// Checks the data set and reports each broken, missing or foreign object.
    ///
    /// # Errors
    /// [`StorageError::Store`] if the store fails; faults of the data are in the report.
    pub async fn verify(&self, mode: VerifyMode) -> Result<Verification, StorageError> {
        self.verify_with(&VerifyOptions::new(mode)).await
    }

    /// Like [`Self::verify`], with options.
    ///
    /// # Errors
    /// [`StorageError::Store`] if the store fails; faults of the data are in the report.
    pub async fn verify_with(
        &self,
        options: &VerifyOptions<'_>,
    ) -> Result<Verification, StorageError> {
        let listing = self.listing().await?;
        let mut report = Verification::default();
        self.verify_metadata(&mut report).await?;
        let scenes: Vec<u64> = match options.snapshot {
            Some(snapshot) => {
                let (there, missing): (Vec<u64>, Vec<u64>) =
                    snapshot.scenes().partition(|s| listing.is_published(*s));
                self.missing_manifests(&missing, &mut report);
                there
            }
            None => {
                let expected = if options.complete {
                    0..self.spec.scenes
                } else {
                    0..0
                };
                let missing = expected.filter(|s| !listing.is_published(*s));
                self.missing_manifests(&missing.collect::<Vec<_>>(), &mut report);
                self.verify_records(&listing, &mut report).await?;
                listing.manifests.clone()
            }
        };
        let unusable = self
            .verify_scenes(&scenes, &listing, options, &mut report)
            .await?;
        if options.snapshot.is_none() {
            self.leftover(&listing, &unusable, &mut report);
        }
        report.problems.sort_by(|a, b| a.object.cmp(&b.object));
        report.unpublished.sort();
        Ok(report)
    }

    /// Checks only these scenes.
    ///
    /// # Errors
    /// [`StorageError::Store`] if the store fails; faults of the data are in the report.
    pub async fn verify_only(
        &self,
        scenes: &[u64],
        mode: VerifyMode,
    ) -> Result<Verification, StorageError> {
        let mut report = Verification::default();
        for scene in scenes {
            let mut sizes = Vec::new();
            for array in self.arrays.iter() {
                let path = self.path(&array.layout.key(*scene));
                sizes.push(objects::size(&*self.store, &path).await?);
            }
            let manifest = self.path(&Manifest::key(*scene));
            if objects::size(&*self.store, &manifest).await?.is_none() {
                self.missing_manifests(&[*scene], &mut report);
                continue;
            }
            let checked = self.verify_scene(*scene, sizes, None, mode).await?;
            checked.add_to(&mut report);
        }
        report.problems.sort_by(|a, b| a.object.cmp(&b.object));
        Ok(report)
    }

    fn missing_manifests(&self, scenes: &[u64], report: &mut Verification) {
        report.problems.extend(scenes.iter().map(|scene| Problem {
            object: self.shown(&self.path(&Manifest::key(*scene))),
            scene: Some(*scene),
            fault: Fault::Missing,
        }));
    }

    /// Checks published scenes. Returns those without a usable manifest.
    async fn verify_scenes(
        &self,
        scenes: &[u64],
        listing: &Listing,
        options: &VerifyOptions<'_>,
        report: &mut Verification,
    ) -> Result<Vec<u64>, StorageError> {
        let at_once = match options.mode {
            VerifyMode::Fast => MANIFESTS,
            VerifyMode::Full => std::thread::available_parallelism()
                .map_or(1, usize::from)
                .min(SCENES),
        };
        let of = scenes.len() as u64;
        let check = |scene: u64| -> BoxFuture<'_, Result<CheckedScene, StorageError>> {
            let arrays = 0..self.arrays.len();
            let sizes = arrays.map(|array| listing.size(array, scene)).collect();
            let expected = options.snapshot.and_then(|s| s.manifest_sha256(scene));
            self.verify_scene(scene, sizes, expected, options.mode)
                .boxed()
        };
        let mut checks = stream::iter(scenes.iter().copied().map(check)).buffer_unordered(at_once);
        let mut unusable = Vec::new();
        let mut done = 0;
        while let Some(checked) = checks.try_next().await? {
            done += 1;
            (options.watch)(done, of);
            if !checked.usable {
                unusable.push(checked.scene);
            }
            checked.add_to(report);
        }
        unusable.sort_unstable();
        Ok(unusable)
    }

    async fn verify_scene(
        &self,
        scene: u64,
        sizes: Vec<Option<u64>>,
        expected: Option<String>,
        mode: VerifyMode,
    ) -> Result<CheckedScene, StorageError> {
        let mut checked = CheckedScene {
            scene,
            usable: false,
            problems: Vec::new(),
            objects: 0,
            bytes: 0,
        };
        let path = self.path(&Manifest::key(scene));
        let mut problem = |object: String, fault| {
            checked.problems.push(Problem {
                object,
                scene: Some(scene),
                fault,
            });
        };
        let bytes = objects::require(&*self.store, &path).await?;
        if let Some(expected) = expected {
            let found = sha256_hex(&bytes);
            if found != expected {
                problem(self.shown(&path), Fault::WrongHash { expected, found });
                return Ok(checked);
            }
        }
        let manifest = match self.usable_manifest(&bytes, scene, &self.shown(&path)) {
            Ok(manifest) => Arc::new(manifest),
            Err(why) => {
                problem(self.shown(&path), Fault::BadManifest(why));
                return Ok(checked);
            }
        };
        let mut to_read = Vec::new();
        for (array, (object, size)) in manifest.objects.iter().zip(&sizes).enumerate() {
            let expected = object.size;
            match *size {
                None => problem(self.shown(&self.path(&object.key)), Fault::Missing),
                Some(found) if found != expected => problem(
                    self.shown(&self.path(&object.key)),
                    Fault::WrongSize { expected, found },
                ),
                Some(_) => to_read.push(array),
            }
        }
        if mode == VerifyMode::Full {
            let read =
                |array: usize| -> BoxFuture<'_, Result<(usize, Option<Fault>), StorageError>> {
                    let fault = self.content(manifest.clone(), array);
                    async move { Ok((array, fault.await?)) }.boxed()
                };
            let mut reads = stream::iter(to_read.into_iter().map(read)).buffer_unordered(OBJECTS);
            while let Some((array, fault)) = reads.try_next().await? {
                if let Some(fault) = fault {
                    problem(self.shown(&self.path(&manifest.objects[array].key)), fault);
                }
            }
        }
        checked.usable = true;
        checked.objects = sizes.iter().flatten().count() as u64;
        checked.bytes = sizes.iter().flatten().sum();
        Ok(checked)
    }

    /// Parses the manifest, and checks that it belongs to this data set and lists exactly the
    /// scene's objects.
    pub(crate) fn usable_manifest(
        &self,
        bytes: &[u8],
        scene: u64,
        object: &str,
    ) -> Result<Manifest, String> {
        let manifest = match Manifest::parse(bytes, scene, object) {
            Ok(manifest) => manifest,
            Err(StorageError::Damaged { what, .. }) => return Err(what),
            Err(e) => return Err(e.to_string()),
        };
        if manifest.checksum.is_none() && manifest.to_bytes() != bytes {
            return Err(
                "it has no checksum and is not written as manifests without one were".into(),
            );
        }
        if scene >= self.spec.scenes {
            return Err(format!(
                "the data set has room for {} scenes",
                self.spec.scenes
            ));
        }
        if manifest.profile != self.spec.profile {
            return Err("its codec profile is not the data set's".into());
        }
        let keys = self.arrays.iter().map(|array| array.layout.key(scene));
        if !keys.eq(manifest.objects.iter().map(|o| o.key.clone())) {
            return Err("it does not list exactly the scene's objects".into());
        }
        Ok(manifest)
    }

    /// Reads an object (by its position in the manifest) and checks it on a thread for blocking
    /// work.
    async fn content(
        &self,
        manifest: Arc<Manifest>,
        array: usize,
    ) -> Result<Option<Fault>, StorageError> {
        let path = self.path(&manifest.objects[array].key);
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            return Ok(Some(Fault::Missing));
        };
        let dataset = self.clone();
        let check = move || dataset.content_fault(&manifest, array, &bytes);
        let checked = tokio::task::spawn_blocking(check).await;
        Ok(checked.expect("checking bytes never panics"))
    }

    fn content_fault(&self, manifest: &Manifest, array: usize, bytes: &Bytes) -> Option<Fault> {
        let ObjectEntry { sha256, .. } = &manifest.objects[array];
        let found = sha256_hex(bytes);
        if found != *sha256 {
            return Some(Fault::WrongHash {
                expected: sha256.clone(),
                found,
            });
        }
        let array = &self.arrays[array];
        let decoded = match array.layout.quantity {
            q if q.is_transient() => self.decode_shard(manifest, array, bytes).map(drop),
            _ => array.codec.decode(bytes).map(drop),
        };
        decoded.err().map(|e| Fault::Undecodable(e.to_string()))
    }

    /// Reports the objects that no manifest lists.
    fn leftover(&self, listing: &Listing, unusable: &[u64], report: &mut Verification) {
        for scene in 0..listing.end() {
            let published = listing.is_published(scene);
            if published && unusable.binary_search(&scene).is_err() {
                continue;
            }
            let arrays = self.arrays.iter().enumerate();
            let there = arrays.filter(|(at, _)| listing.size(*at, scene).is_some());
            let keys = there.map(|(_, array)| self.path(&array.layout.key(scene)));
            let before = report.unpublished.len();
            report
                .unpublished
                .extend(keys.map(|path| self.shown(&path)));
            if !published && report.unpublished.len() > before {
                report.unfinished.push(scene);
            }
        }
        let parts = listing.parts.iter().map(|key| self.path(key));
        report
            .unpublished
            .extend(parts.map(|path| self.shown(&path)));
        report
            .problems
            .extend(listing.foreign.iter().map(|key| Problem {
                object: self.shown(&self.path(key)),
                scene: None,
                fault: Fault::Foreign,
            }));
    }
}

struct CheckedScene {
    scene: u64,
    /// Whether it has a usable manifest.
    usable: bool,
    problems: Vec<Problem>,
    /// Number of its objects.
    objects: u64,
    /// Their total size in bytes.
    bytes: u64,
}

impl CheckedScene {
    fn add_to(self, report: &mut Verification) {
        report.scenes += 1;
        report.objects += self.objects;
        report.bytes += self.bytes;
        report.problems.extend(self.problems);
    }
}
