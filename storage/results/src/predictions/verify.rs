//! Checks predictions: metadata, manifests, and the existence and content of each object.

use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt, TryStreamExt, stream};

use super::{Plate, PredictionManifest, Predictions};
use picofarm_dataset::METADATA;
use picofarm_dataset::Manifest;
use picofarm_dataset::metadata_fault;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::ObjectEntry;
use picofarm_store::verify::looked_at;
use picofarm_store::{Fault, Problem, Verification, VerifyMode, Watch};

/// Number of scenes checked concurrently.
const SCENES: usize = 4;

impl Predictions {
    /// Checks the published predictions. With `complete`, a scene without a manifest is a problem.
    /// `watch` is called with the number of checked scenes and of all scenes.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn verify(
        &self,
        mode: VerifyMode,
        complete: bool,
        watch: Watch<'_>,
    ) -> Result<Verification, StorageError> {
        let mut report = Verification::default();
        let arrays = self.plates.iter().map(|plate| {
            let metadata = plate.metadata(self.spec.scenes);
            (self.metadata_path(plate), metadata)
        });
        for (path, expected) in std::iter::once((self.path(METADATA), self.root())).chain(arrays) {
            let fault = match objects::get(&*self.store, &path).await? {
                None => Some(Fault::Missing),
                Some(bytes) => metadata_fault(&bytes, &expected),
            };
            report.problems.extend(fault.map(|fault| Problem {
                object: self.shown(&path),
                scene: None,
                fault,
            }));
        }
        let present = self.scenes_present().await?;
        if complete {
            for scene in (0..self.spec.scenes).filter(|s| present.binary_search(s).is_err()) {
                report.problems.push(Problem {
                    object: self.shown(&self.path(&Manifest::key(scene))),
                    scene: Some(scene),
                    fault: Fault::Missing,
                });
            }
        }
        let look = |scene: u64| -> BoxFuture<'_, Result<Verification, StorageError>> {
            self.verify_scene(scene, mode).boxed()
        };
        let looks = present.iter().map(|scene| look(*scene));
        let mut checks = stream::iter(looks).buffered(SCENES);
        while let Some(found) = checks.try_next().await? {
            report.scenes += 1;
            report.objects += found.objects;
            report.bytes += found.bytes;
            report.problems.extend(found.problems);
            watch(report.scenes, present.len() as u64);
        }
        drop(checks);
        report.problems.sort_by(|a, b| a.object.cmp(&b.object));
        Ok(report)
    }

    async fn verify_scene(
        &self,
        scene: u64,
        mode: VerifyMode,
    ) -> Result<Verification, StorageError> {
        let mut report = Verification::default();
        let problem = |object: String, fault| Problem {
            object,
            scene: Some(scene),
            fault,
        };
        let at = self.shown(&self.path(&Manifest::key(scene)));
        let manifest = match self.manifest(scene).await {
            Ok(manifest) => manifest,
            Err(StorageError::Damaged { object, what }) => {
                let fault = Fault::BadManifest(what);
                report.problems.push(problem(object, fault));
                return Ok(report);
            }
            Err(error) => return Err(error),
        };
        for plate in self.plates.iter() {
            let Some(entry) = entry(&manifest, plate) else {
                let what = format!("names no object of {}", plate.name);
                report
                    .problems
                    .push(problem(at.clone(), Fault::BadManifest(what)));
                continue;
            };
            report.objects += 1;
            report.bytes += entry.size;
            if let Some(fault) = self.object_fault(entry, plate, mode).await? {
                let object = self.shown(&self.path(&entry.key));
                report.problems.push(problem(object, fault));
            }
        }
        Ok(report)
    }

    async fn object_fault(
        &self,
        entry: &ObjectEntry,
        plate: &Plate,
        mode: VerifyMode,
    ) -> Result<Option<Fault>, StorageError> {
        let path = self.path(&entry.key);
        let bytes = match looked_at(&*self.store, &path, entry, mode).await? {
            Err(fault) => return Ok(Some(fault)),
            Ok(None) => return Ok(None),
            Ok(Some(bytes)) => bytes,
        };
        let decoded = plate.codec.decode(&bytes);
        Ok(decoded.err().map(|e| Fault::Undecodable(e.to_string())))
    }
}

fn entry<'a>(manifest: &'a PredictionManifest, plate: &Plate) -> Option<&'a ObjectEntry> {
    let key = plate.key(manifest.scene);
    manifest.objects.iter().find(|object| object.key == key)
}
