//! Predictions of scenes by models: a separate Zarr v3 group in a store, next to the data set of
//! the input scenes. It has the same number of scenes, and one object per scene and array: `depth`,
//! `lit`, `specular`, `confidence` and `evidence`, as far as they are predicted.
//!
//! A scene's predictions are published like scenes: objects first, `manifests/<scene>.json` last,
//! all create-only and pure functions of the task.

mod array;
mod evaluation;
mod manifest;
mod publish;
mod read;
mod spec;
mod verify;

use std::sync::Arc;

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;
use serde_json::Value;

use array::{PredictedArray, arrays};
use picofarm_dataset::{METADATA, create_metadata, is_predictions, pretty};
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::published::Published;
use spec::{difference, parse_root, root};

pub use manifest::{ModelUsed, PredictionManifest, SceneUsed, TimesUsed};
pub use read::PinnedDepths;
pub use spec::PredictionSpec;

/// The predictions of one scene, for the group's arrays.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Predicted {
    /// z-depth, metres: `[row][column]`.
    pub depth_m: Vec<f32>,
    /// Probability times 255 that a spot lights the visible point: `[spot][row][column]`.
    pub lit: Vec<u8>,
    /// Probability times 255 of a mirror: `[row][column]`.
    pub specular: Vec<u8>,
    /// Confidence of the depth, times 255: `[row][column]`.
    pub confidence: Vec<u8>,
    /// Codes of the evidence: `[spot][plane][row][column]`; empty if none is stored.
    pub evidence: Vec<u8>,
}

/// Encoded predictions of one scene, ready to be published.
#[derive(Debug, Clone)]
pub struct EncodedPredictions {
    /// Their manifest.
    pub manifest: PredictionManifest,
    bytes: Vec<Bytes>,
}

/// Predictions in a store. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Predictions {
    published: Published<PredictionManifest>,
    spec: PredictionSpec,
    arrays: Arc<[PredictedArray]>,
}

impl Predictions {
    /// Creates the group at `prefix`, or opens an existing one. It grows to `spec.scenes` as data
    /// sets do.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the location contains something else;
    /// [`StorageError::SpecMismatch`]; [`StorageError::Store`].
    pub async fn create_or_open(
        store: Arc<dyn ObjectStore>,
        prefix: Path,
        spec: &PredictionSpec,
    ) -> Result<Self, StorageError> {
        let asked = Self::assume(store.clone(), prefix.clone(), spec.clone());
        let path = asked.path(METADATA);
        let ours = pretty(&root(spec, &asked.arrays));
        let stored = match objects::get(&*store, &path).await? {
            Some(bytes) => parse_root(&bytes, &asked.shown(&path))?,
            None => {
                for array in asked.arrays.iter() {
                    let path = asked.metadata_path(array);
                    create_metadata(&*store, &path, spec.scenes, |n| array.metadata(n)).await?;
                }
                if objects::create(&*store, &path, ours.clone()).await? {
                    return Ok(asked);
                }
                // Another worker created it first.
                let bytes = objects::require(&*store, &path).await?;
                parse_root(&bytes, &asked.shown(&path))?
            }
        };
        if let Some((field, stored, asked)) = difference(&stored, spec) {
            return Err(StorageError::SpecMismatch {
                prefix: objects::shown(&*store, &prefix),
                field: field.into(),
                stored,
                asked,
            });
        }
        if spec.scenes <= stored.scenes {
            return Ok(Self::assume(store, prefix, stored));
        }
        for array in asked.arrays.iter() {
            let bytes = pretty(&array.metadata(spec.scenes));
            objects::overwrite(&*store, &asked.metadata_path(array), bytes).await?;
        }
        objects::overwrite(&*store, &path, ours).await?;
        Ok(asked)
    }

    /// Opens the group at `prefix`.
    ///
    /// # Errors
    /// [`StorageError::NoDataset`]; [`StorageError::Invalid`] if the location contains something
    /// else; [`StorageError::Store`].
    pub async fn open(store: Arc<dyn ObjectStore>, prefix: Path) -> Result<Self, StorageError> {
        let root = objects::path_of(&prefix, METADATA);
        let Some(bytes) = objects::get(&*store, &root).await? else {
            return Err(StorageError::NoDataset {
                prefix: objects::shown(&*store, &prefix),
            });
        };
        let spec = parse_root(&bytes, &objects::shown(&*store, &root))?;
        Ok(Self::assume(store, prefix, spec))
    }

    /// Like [`Self::open`], but returns `None` if there are no predictions at `prefix`.
    ///
    /// # Errors
    /// [`StorageError::Invalid`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn find(
        store: Arc<dyn ObjectStore>,
        prefix: Path,
    ) -> Result<Option<Self>, StorageError> {
        let root = objects::path_of(&prefix, METADATA);
        let bytes = objects::get(&*store, &root).await?;
        let parsed = bytes.and_then(|bytes| serde_json::from_slice::<Value>(&bytes).ok());
        match parsed.is_some_and(|root| is_predictions(&root)) {
            true => Self::open(store, prefix).await.map(Some),
            false => Ok(None),
        }
    }

    fn assume(store: Arc<dyn ObjectStore>, prefix: Path, spec: PredictionSpec) -> Self {
        Self {
            published: Published::new(store, prefix),
            arrays: arrays(&spec).into(),
            spec,
        }
    }

    /// Returns the predicted quantities.
    pub fn spec(&self) -> &PredictionSpec {
        &self.spec
    }

    /// Returns its location for messages.
    pub fn place(&self) -> String {
        self.shown(self.published.folder())
    }

    /// Returns the scenes with published predictions, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn scenes_present(&self) -> Result<Vec<u64>, StorageError> {
        self.published.list().await
    }

    /// Returns the manifest of a scene's predictions.
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn manifest(&self, scene: u64) -> Result<PredictionManifest, StorageError> {
        self.published.scene(scene).await
    }

    fn metadata_path(&self, array: &PredictedArray) -> Path {
        self.path(&format!("{}/{METADATA}", array.name))
    }

    fn path(&self, key: &str) -> Path {
        objects::path_of(self.published.folder(), key)
    }

    fn shown(&self, path: &Path) -> String {
        self.published.shown(path)
    }
}
