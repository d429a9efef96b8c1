//! Checks published results: manifests, and the existence and content of each object.

use bytes::Bytes;
use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt, TryStreamExt, stream};

use super::{Manifest, Published, ResultId};
use crate::error::StorageError;
use crate::sealed::ObjectEntry;
use crate::verify::{Fault, Problem, Verification, VerifyMode, Watch, inspect};

/// Number of results checked concurrently.
const RESULTS: usize = 4;

/// Examines a result beyond the sizes and SHA-256 of its objects.
pub trait Examine<M>: Sync {
    /// Returns why a manifest is unusable, if it is.
    fn manifest(&self, manifest: &M) -> Option<String> {
        let _ = manifest;
        None
    }

    /// Returns the fault of an object with the recorded size, and with [`VerifyMode::Full`] the
    /// recorded SHA-256. Without it the bytes are `None`, because they were not read.
    fn object(&self, manifest: &M, entry: &ObjectEntry, bytes: Option<&Bytes>) -> Option<Fault> {
        let _ = (manifest, entry, bytes);
        None
    }
}

/// Examines nothing more.
impl<M> Examine<M> for () {}

impl<M: Manifest> Published<M> {
    /// Checks all published results. `watch` is called with the number of checked
    /// results and of all results.
    ///
    /// # Errors
    /// [`StorageError::Store`]; faults of the data are in the report.
    pub async fn verify(
        &self,
        mode: VerifyMode,
        examine: &dyn Examine<M>,
        watch: Watch<'_>,
    ) -> Result<Verification, StorageError> {
        let ids = self.list().await?;
        let mut report = Verification::default();
        let checks = ids.iter().map(|id| {
            let check: BoxFuture<'_, _> = self.verify_one(id, mode, examine).boxed();
            check
        });
        let mut checks = stream::iter(checks).buffered(RESULTS);
        while let Some(found) = checks.try_next().await? {
            report.scenes += 1;
            report.objects += found.objects;
            report.bytes += found.bytes;
            report.problems.extend(found.problems);
            watch(report.scenes, ids.len() as u64);
        }
        drop(checks);
        report.problems.sort_by(|a, b| a.object.cmp(&b.object));
        Ok(report)
    }

    /// Checks one result like [`Self::verify`]. A result without a manifest has no problems.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn verify_one(
        &self,
        id: &M::Id,
        mode: VerifyMode,
        examine: &dyn Examine<M>,
    ) -> Result<Verification, StorageError> {
        let mut report = Verification::default();
        let problem = |object: String, fault| Problem {
            object,
            scene: id.scene(),
            fault,
        };
        let manifest = match self.manifest(id).await {
            Ok(Some(manifest)) => manifest,
            Ok(None) => return Ok(report),
            Err(StorageError::Damaged { object, what }) => {
                report
                    .problems
                    .push(problem(object, Fault::BadManifest(what)));
                return Ok(report);
            }
            Err(error) => return Err(error),
        };
        if let Some(what) = examine.manifest(&manifest) {
            let object = self.shown(&self.manifest_path(id));
            report
                .problems
                .push(problem(object, Fault::BadManifest(what)));
        }
        for entry in manifest.objects() {
            let path = self.object_path(id, &entry.key);
            report.objects += 1;
            report.bytes += entry.size;
            let fault = match inspect(&*self.store, &path, entry, mode).await? {
                Err(fault) => Some(fault),
                Ok(bytes) => examine.object(&manifest, entry, bytes.as_ref()),
            };
            report
                .problems
                .extend(fault.map(|fault| problem(self.shown(&path), fault)));
        }
        Ok(report)
    }
}
