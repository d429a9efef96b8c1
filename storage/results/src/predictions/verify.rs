//! Checks predictions: metadata, manifests, and the existence and content of each object.

use bytes::Bytes;

use super::spec::root;
use super::{PredictionManifest, Predictions};
use picofarm_dataset::{METADATA, metadata_fault};
use picofarm_store::published::Examine;
use picofarm_store::{Fault, ObjectEntry, Problem, Verification, VerifyMode, Watch};
use picofarm_store::{StorageError, objects};

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
        let arrays = self.arrays.iter().map(|array| {
            let metadata = array.metadata(self.spec.scenes);
            (self.metadata_path(array), metadata)
        });
        let root = (self.path(METADATA), root(&self.spec, &self.arrays));
        for (path, expected) in std::iter::once(root).chain(arrays) {
            let fault = match objects::get(&**self.published.store(), &path).await? {
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
                    object: self.shown(&self.published.manifest_path(&scene)),
                    scene: Some(scene),
                    fault: Fault::Missing,
                });
            }
        }
        let checked = self.published.verify(mode, self, watch).await?;
        report.problems.extend(checked.problems);
        report.problems.sort_by(|a, b| a.object.cmp(&b.object));
        Ok(Verification {
            problems: report.problems,
            ..checked
        })
    }
}

impl Examine<PredictionManifest> for Predictions {
    fn manifest(&self, manifest: &PredictionManifest) -> Option<String> {
        let mut arrays = self.arrays.iter();
        let unnamed = arrays.find(|array| array.entry(manifest).is_none())?;
        Some(format!("names no object of {}", unnamed.name))
    }

    fn object(
        &self,
        manifest: &PredictionManifest,
        entry: &ObjectEntry,
        bytes: Option<&Bytes>,
    ) -> Option<Fault> {
        let mut arrays = self.arrays.iter();
        let array = arrays.find(|array| array.key(manifest.scene) == entry.key)?;
        let decoded = array.codec.decode(bytes?);
        decoded.err().map(|e| Fault::Undecodable(e.to_string()))
    }
}
