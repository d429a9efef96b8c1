//! Reads predictions, and pins their bytes for keys of tasks.

use super::array::{EVIDENCE, PredictedArray};
use super::{ModelUsed, Predicted, PredictionManifest, Predictions};
use picofarm_store::StorageError;

/// A pinned list of scenes' predictions of a quantity.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PinnedDepths {
    /// Hash that pins every byte of the predictions, and the order of the scenes, in hexadecimal.
    pub id: String,
    /// The model that predicted them; `None` if there are no scenes.
    pub model: Option<ModelUsed>,
}

impl Predictions {
    /// Returns a hash that pins every byte of the depths of these scenes, in order, and the model
    /// that predicted them. `seen` contains the SHA-256 of the scenes' manifests
    /// ([`picofarm_dataset::Pinned::manifests`]), which the model's inputs must match. Objects are
    /// not checked.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if there are no depths, or if they belong to another scene or to
    /// several models; [`StorageError::NotPublished`], [`StorageError::Damaged`],
    /// [`StorageError::Store`].
    pub async fn pin_depths(
        &self,
        scenes: &[u64],
        seen: &[[u8; 32]],
    ) -> Result<PinnedDepths, StorageError> {
        let invalid = |what: String| StorageError::invalid("predictions", what);
        if !self.spec.depth {
            return Err(invalid(format!(
                "{} holds no depths; give its infer stage a \"tof\" model, or name a demultiplex stage",
                self.place()
            )));
        }
        self.pin("tof", scenes, seen).await
    }

    /// Returns the predicted depth of a scene in metres, `[row][column]`, checked against its
    /// manifest.
    ///
    /// # Errors
    /// Those of [`Self::read`]; [`StorageError::Invalid`] if there are no depths.
    pub async fn read_depth(&self, scene: u64) -> Result<Vec<f32>, StorageError> {
        let Some(array) = self.arrays.iter().find(|array| array.name == "depth") else {
            let what = format!("{} holds no depths", self.place());
            return Err(StorageError::invalid("predictions", what));
        };
        let manifest = self.manifest(scene).await?;
        let values = self.values(array, &manifest).await?;
        Ok(bytemuck::pod_collect_to_vec(&values))
    }

    /// Returns a hash that pins every byte of the evidence of these scenes, in order, as
    /// [`Self::pin_depths`] does.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if there is no evidence; those of [`Self::pin_depths`].
    pub async fn pin_evidence(
        &self,
        scenes: &[u64],
        seen: &[[u8; 32]],
    ) -> Result<PinnedDepths, StorageError> {
        if self.spec.evidence.is_none() {
            return Err(self.no_evidence());
        }
        self.pin("shadow", scenes, seen).await
    }

    /// Returns the codes of a scene's evidence, `[spot][plane][row][column]`, checked against its
    /// manifest.
    ///
    /// # Errors
    /// Those of [`Self::read`]; [`StorageError::Invalid`] if there is no evidence.
    pub async fn read_evidence(&self, scene: u64) -> Result<Vec<u8>, StorageError> {
        let Some(array) = self.arrays.iter().find(|array| array.name == EVIDENCE) else {
            return Err(self.no_evidence());
        };
        let manifest = self.manifest(scene).await?;
        self.values(array, &manifest).await
    }

    fn no_evidence(&self) -> StorageError {
        let what = format!(
            "{} holds no evidence; name a demultiplex stage with evidence = true",
            self.place()
        );
        StorageError::invalid("predictions", what)
    }

    /// Returns a scene's values of an array, checked against its manifest.
    async fn values(
        &self,
        array: &PredictedArray,
        manifest: &PredictionManifest,
    ) -> Result<Vec<u8>, StorageError> {
        let Some(entry) = array.entry(manifest) else {
            let path = self.published.manifest_path(&manifest.scene);
            return Err(StorageError::Damaged {
                object: self.published.shown(&path),
                what: format!("names no object of {}", array.name),
            });
        };
        let bytes = self.published.read(&manifest.scene, entry).await?;
        array.codec.decode(&bytes)
    }

    /// Returns the predictions of a scene, checked against its manifest. The evidence, which is
    /// much larger, is not read ([`Self::read_evidence`]).
    ///
    /// # Errors
    /// [`StorageError::NotPublished`], [`StorageError::Damaged`], [`StorageError::Codec`],
    /// [`StorageError::Store`].
    pub async fn read(&self, scene: u64) -> Result<Predicted, StorageError> {
        let manifest = self.manifest(scene).await?;
        let mut predicted = Predicted::default();
        for array in self.arrays.iter().filter(|array| array.name != EVIDENCE) {
            let values = self.values(array, &manifest).await?;
            match array.name {
                "depth" => predicted.depth_m = bytemuck::pod_collect_to_vec(&values),
                "lit" => predicted.lit = values,
                "confidence" => predicted.confidence = values,
                _ => predicted.specular = values,
            }
        }
        Ok(predicted)
    }
}
