//! Speed of a model's training: `models/<name>/speed.json`, create-only. A speed depends on the
//! machine and the model's bytes do not, so it is stored separately from the manifest, and it is
//! optional.

use serde::{Deserialize, Serialize};

use super::{Models, check_name};
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::{read_unsealed, seal, sha256_hex};

pub(super) const FILE: &str = "speed.json";

/// The speed of a model's training, measured by the worker that finished it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingSpeed {
    /// Key of the training.
    pub training_key: String,
    /// Training examples per second, excluding the time for validation.
    pub samples_per_s: f64,
    /// Share of that time in which the network waited for data.
    pub data_wait_share: f64,
    /// Number of threads of the worker.
    pub threads: usize,
    /// Name of the GPU used; none for the CPU.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gpu: Option<String>,
}

impl TrainingSpeed {
    /// Returns the SHA-256 of its bytes, in hexadecimal.
    pub fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }

    fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self).expect("finite numbers");
        bytes.push(b'\n');
        seal(&bytes)
    }
}

impl Models {
    /// Stores the speed of a training. An existing record is retained.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn put_speed(&self, name: &str, speed: &TrainingSpeed) -> Result<(), StorageError> {
        check_name(name)?;
        let path = self.path(name, FILE);
        objects::create(&*self.store, &path, speed.to_bytes().into()).await?;
        Ok(())
    }

    /// Returns the speed of a model's training, if the record belongs to this training.
    ///
    /// # Errors
    /// [`StorageError::Store`], [`StorageError::Damaged`].
    pub async fn speed(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<Option<TrainingSpeed>, StorageError> {
        let path = self.path(name, FILE);
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        let speed: TrainingSpeed =
            read_unsealed(&bytes, "the speed of a training", self.shown(&path))?;
        Ok(Some(speed).filter(|speed| speed.training_key == training_key))
    }
}
