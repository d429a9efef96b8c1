//! Encodes, publishes and restores predictions.

use bytes::Bytes;

use super::array::EVIDENCE;
use super::manifest::FORMAT;
use super::{EncodedPredictions, Predicted, PredictionManifest, Predictions};
use picofarm_store::{ObjectEntry, StorageError, VerifyMode};

impl Predictions {
    /// Returns the manifest of a scene that this task has published, after checking the SHA-256 of
    /// each object. This check is acceptable because predictions are small, and cheap to read
    /// compared with making them. Returns `None` if the scene is not published.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if another task has published it; [`StorageError::Damaged`] if an
    /// object is missing or changed ([`Self::restore`] repairs it); [`StorageError::Store`].
    pub async fn finished(
        &self,
        scene: u64,
        task_key: &str,
    ) -> Result<Option<PredictionManifest>, StorageError> {
        let mode = VerifyMode::Full;
        self.published.finished(&scene, task_key, mode).await
    }

    /// Encodes the predictions of the scene in `manifest`. The manifest's format, objects and
    /// checksum are set here.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the values do not match the group's arrays, or a depth is not
    /// finite; [`StorageError::SceneOutOfRange`].
    pub fn encode(
        &self,
        manifest: PredictionManifest,
        predicted: &Predicted,
    ) -> Result<EncodedPredictions, StorageError> {
        let scene = manifest.scene;
        if scene >= self.spec.scenes {
            return Err(StorageError::SceneOutOfRange {
                scene,
                scenes: self.spec.scenes,
            });
        }
        if let Some(at) = predicted.depth_m.iter().position(|z| !z.is_finite()) {
            let z = predicted.depth_m[at];
            let what = format!(
                "scene {scene}: expected finite depths, found {z} at pixel {at}; NaN stands for a scene that is not there"
            );
            return Err(StorageError::invalid("depth", what));
        }
        let (mut objects, mut bytes) = (Vec::new(), Vec::new());
        for array in self.arrays.iter() {
            let values: &[u8] = match array.name {
                "depth" => bytemuck::cast_slice(&predicted.depth_m),
                "lit" => &predicted.lit,
                "confidence" => &predicted.confidence,
                EVIDENCE => &predicted.evidence,
                _ => &predicted.specular,
            };
            if values.len() != array.bytes() {
                let what = format!(
                    "{} bytes of values, expected {}",
                    values.len(),
                    array.bytes()
                );
                return Err(StorageError::invalid(array.name, what));
            }
            let coded = array.codec.encode(values)?;
            objects.push(ObjectEntry::new(array.key(scene), &coded));
            bytes.push(Bytes::from(coded));
        }
        let manifest = PredictionManifest {
            format: FORMAT,
            objects,
            ..manifest
        };
        Ok(EncodedPredictions {
            manifest: manifest.sealed(),
            bytes,
        })
    }

    /// Publishes encoded predictions like [`picofarm_dataset::Dataset::publish_encoded`] publishes
    /// scenes.
    ///
    /// # Errors
    /// [`StorageError::Conflict`] if an object exists with different bytes;
    /// [`StorageError::Store`].
    pub async fn publish(&self, encoded: &EncodedPredictions) -> Result<(), StorageError> {
        let EncodedPredictions { manifest, bytes } = encoded;
        let scene = manifest.scene;
        self.published.publish(&scene, manifest, bytes).await
    }

    /// Restores missing or changed objects of a scene's predictions from regenerated ones. Only
    /// this code overwrites them. The existing manifest proves that they equal the originals. If
    /// the manifest itself is broken, the remaining objects are the proof, and each must be equal.
    /// Returns the objects written.
    ///
    /// # Errors
    /// [`StorageError::Diverged`] if the predictions differ from the manifest, and
    /// [`StorageError::Damaged`] if nothing proves the original content; in both cases nothing was
    /// written. [`StorageError::Store`].
    pub async fn restore(&self, encoded: &EncodedPredictions) -> Result<Vec<String>, StorageError> {
        let EncodedPredictions { manifest, bytes } = encoded;
        let scene = manifest.scene;
        self.published.restore(&scene, manifest, bytes).await
    }
}
