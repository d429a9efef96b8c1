//! Errors of stored predictions, in the folder of the predictions: `evaluations/<key>.json`,
//! create-only.

use bytes::Bytes;
use futures::{FutureExt, StreamExt, TryStreamExt, stream};
use object_store::ObjectMeta;
use sha2::{Digest, Sha256};

use super::{ModelUsed, PinnedDepths, PredictionManifest, Predictions};
use crate::models::Evaluation;
use picofarm_store::StorageError;
use picofarm_store::concurrent::CONCURRENCY;
use picofarm_store::objects;
use picofarm_store::published::Manifest as _;

/// Folder of the evaluations.
const FOLDER: &str = "evaluations";

impl Predictions {
    /// Stores an evaluation. Returns `false` if one already exists; it is retained.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn put_evaluation(&self, evaluation: &Evaluation) -> Result<bool, StorageError> {
        let path = self.path(&key(&evaluation.key));
        objects::create(
            &**self.published.store(),
            &path,
            Bytes::from(evaluation.to_bytes()),
        )
        .await
    }

    /// Reads the evaluation with this key.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn evaluation(&self, evaluation: &str) -> Result<Option<Evaluation>, StorageError> {
        let path = self.path(&key(evaluation));
        let Some(bytes) = objects::get(&**self.published.store(), &path).await? else {
            return Ok(None);
        };
        let parsed = Evaluation::parse(&bytes).map_err(|what| StorageError::Damaged {
            object: self.shown(&path),
            what,
        });
        parsed.map(Some)
    }

    /// Returns all evaluations, ordered by key.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn evaluations(&self) -> Result<Vec<Evaluation>, StorageError> {
        let folder = self.path(FOLDER);
        let listed = self
            .published
            .store()
            .list(Some(&folder))
            .try_collect()
            .await;
        let listed: Vec<ObjectMeta> =
            listed.map_err(|e| StorageError::store("list", self.shown(&folder), e))?;
        let names = listed
            .iter()
            .filter_map(|object| object.location.filename());
        let names = names.filter_map(|name| name.strip_suffix(".json"));
        let mut keys: Vec<String> = names.map(str::to_owned).collect();
        keys.sort();
        let mut found = Vec::with_capacity(keys.len());
        for key in keys {
            found.extend(self.evaluation(&key).await?);
        }
        Ok(found)
    }

    /// Returns a hash that pins every byte of the predictions of these scenes, in order, and the
    /// model that predicted the quantity `kind` (`tof`, `shadow`, `specular`). `seen` contains the
    /// SHA-256 of the scenes' manifests ([`picofarm_dataset::Pinned::manifests`]), which the
    /// model's inputs must match. Objects are not checked.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the quantity is not predicted, or if predictions belong to
    /// another scene or to several models; [`StorageError::NotPublished`],
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn pin(
        &self,
        kind: &str,
        scenes: &[u64],
        seen: &[[u8; 32]],
    ) -> Result<PinnedDepths, StorageError> {
        let invalid = |what: String| StorageError::invalid("predictions", what);
        let looks = scenes.iter().map(|scene| self.manifest(*scene).boxed());
        let looks = stream::iter(looks).buffered(CONCURRENCY);
        let found: Vec<PredictionManifest> = looks.try_collect().await?;
        let mut hash = Sha256::new();
        let mut by: Option<ModelUsed> = None;
        for (manifest, seen) in found.iter().zip(seen) {
            if manifest.source.manifest_sha256 != hex::encode(seen) {
                return Err(invalid(format!(
                    "{} holds predictions of scene {} of {:?}, which is not the scene that is read here; name \
                     predictions of this data set",
                    self.place(),
                    manifest.scene,
                    manifest.source.dataset,
                )));
            }
            let Some(model) = manifest.models.get(kind) else {
                return Err(invalid(format!(
                    "{} does not say which model predicts {kind:?} of scene {}",
                    self.place(),
                    manifest.scene
                )));
            };
            match &by {
                Some(other) if other != model => {
                    return Err(invalid(format!(
                        "{} holds predictions of {kind:?} by {:?} and by {:?}; one model must predict all",
                        self.place(),
                        other.name,
                        model.name
                    )));
                }
                Some(_) => {}
                None => by = Some(model.clone()),
            }
            hash.update(manifest.scene.to_le_bytes());
            hash.update(Sha256::digest(manifest.to_bytes()));
        }
        Ok(PinnedDepths {
            id: hex::encode(hash.finalize()),
            model: by,
        })
    }
}

fn key(evaluation: &str) -> String {
    format!("{FOLDER}/{evaluation}.json")
}
