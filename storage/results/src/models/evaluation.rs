//! Results of evaluations, in the folder of the model: `models/<name>/evaluations/<key>.json`,
//! create-only.

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Models, SplitUsed, check_name};
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::{seal, unseal};

/// A model's metrics on scenes. It is a pure function of model, scenes and code.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Key of the evaluation: model, scenes and code.
    pub key: String,
    /// The model.
    pub model: String,
    /// SHA-256 of the model's manifest, in hexadecimal.
    pub model_sha256: String,
    /// For stored predictions: the predicted quantity (`tof`, `shadow`, `specular`). Empty for
    /// models, whose manifest names it.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub predicts: String,
    /// Folder of the data set in the same store.
    pub dataset: String,
    /// [`picofarm_dataset::Snapshot::id`] of the scenes.
    pub data: String,
    /// The split.
    pub split: SplitUsed,
    /// The side of the split.
    pub side: String,
    /// Number of scenes.
    pub scenes: u64,
    /// Name of the model's input histogram.
    pub histogram: String,
    /// Source of the two-bounce times for a shadow network that uses them: `truth`, or the folder
    /// of the predictions from which they are computed.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub times: String,
    /// Whether the sensor of the model's training was applied to the histograms.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sensor: bool,
    /// Code version of networks and metrics.
    pub code: String,
    /// The metrics.
    pub metrics: Value,
}

impl Evaluation {
    /// Returns the bytes to store, with their checksum, see `picofarm_store::sealed::seal`.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut sorted = self.clone();
        sorted.metrics.sort_all_objects();
        let mut bytes = serde_json::to_vec_pretty(&sorted)
            .expect("an evaluation has only string keys and finite numbers");
        bytes.push(b'\n');
        seal(&bytes)
    }

    pub(crate) fn parse(bytes: &[u8]) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Head {
            checksum: String,
        }
        let not = |e: serde_json::Error| format!("not an evaluation: {e}");
        let head: Head = serde_json::from_slice(bytes).map_err(not)?;
        serde_json::from_slice(&unseal(bytes, &head.checksum)?).map_err(not)
    }
}

impl Models {
    /// Stores an evaluation. Returns `false` if one already exists; it is retained even if its
    /// metrics differ slightly, as they may on a GPU.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn put_evaluation(&self, evaluation: &Evaluation) -> Result<bool, StorageError> {
        check_name(&evaluation.model)?;
        let path = self.path(&evaluation.model, &key(&evaluation.key));
        objects::create(&*self.store, &path, Bytes::from(evaluation.to_bytes())).await
    }

    /// Reads the evaluation with this key.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn evaluation(
        &self,
        model: &str,
        evaluation: &str,
    ) -> Result<Option<Evaluation>, StorageError> {
        let path = self.path(model, &key(evaluation));
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        let parsed = Evaluation::parse(&bytes).map_err(|what| StorageError::Damaged {
            object: self.shown(&path),
            what,
        });
        parsed.map(Some)
    }

    /// Returns the evaluations of a model, ordered by key.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn evaluations(&self, model: &str) -> Result<Vec<Evaluation>, StorageError> {
        let mut found = Vec::new();
        for object in self.list(&self.path(model, FOLDER)).await? {
            let name = object
                .location
                .filename()
                .and_then(|n| n.strip_suffix(".json"));
            if let Some(name) = name {
                found.extend(self.evaluation(model, name).await?);
            }
        }
        found.sort_by(|a, b| a.key.cmp(&b.key));
        Ok(found)
    }
}

const FOLDER: &str = "evaluations";

fn key(evaluation: &str) -> String {
    format!("{FOLDER}/{evaluation}.json")
}
