//! What evaluations found, beside the model: `models/<name>/evaluations/<key>.json`, create-only.

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Models, SplitUsed, check_name};
use crate::error::DatasetError;
use crate::layout::manifest::{seal, unseal};
use crate::store::objects;

/// A model's figures on scenes. A pure function of model, scenes and code.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Key of the evaluation: model, scenes and code.
    pub key: String,
    /// The model.
    pub model: String,
    /// SHA-256 of its manifest, hexadecimal.
    pub model_sha256: String,
    /// Folder of the data set in the same store.
    pub dataset: String,
    /// [`crate::Snapshot::id`] of the scenes.
    pub data: String,
    /// The split.
    pub split: SplitUsed,
    /// The side.
    pub side: String,
    /// Number of scenes.
    pub scenes: u64,
    /// Name of the histogram that the model saw.
    pub histogram: String,
    /// For a shadow network that is given two-bounce times: `truth`, or the folder of the predictions that they follow from.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub times: String,
    /// Whether histograms went through the sensor that the model was trained with.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sensor: bool,
    /// Version of networks and metrics.
    pub code: String,
    /// The figures.
    pub metrics: Value,
}

impl Evaluation {
    /// Its bytes as they lie in the store: with their checksum, as [`crate::layout::manifest::seal`] has it.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut sorted = self.clone();
        sorted.metrics.sort_all_objects();
        let mut bytes = serde_json::to_vec_pretty(&sorted)
            .expect("an evaluation has only string keys and finite numbers");
        bytes.push(b'\n');
        seal(&bytes)
    }

    fn parse(bytes: &[u8]) -> Result<Self, String> {
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
    /// Stores an evaluation. `false` where it was there: then that one stands, even if a graphics processor came to
    /// slightly other figures.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn put_evaluation(&self, evaluation: &Evaluation) -> Result<bool, DatasetError> {
        check_name(&evaluation.model)?;
        let path = self.path(&evaluation.model, &key(&evaluation.key));
        objects::create(&*self.store, &path, Bytes::from(evaluation.to_bytes())).await
    }

    /// An evaluation of this key.
    ///
    /// # Errors
    /// [`DatasetError::Damaged`], [`DatasetError::Store`].
    pub async fn evaluation(
        &self,
        model: &str,
        evaluation: &str,
    ) -> Result<Option<Evaluation>, DatasetError> {
        let path = self.path(model, &key(evaluation));
        let Some(bytes) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        let parsed = Evaluation::parse(&bytes).map_err(|what| DatasetError::Damaged {
            object: self.shown(&path),
            what,
        });
        parsed.map(Some)
    }

    /// The evaluations of a model, by key.
    ///
    /// # Errors
    /// [`DatasetError::Damaged`], [`DatasetError::Store`].
    pub async fn evaluations(&self, model: &str) -> Result<Vec<Evaluation>, DatasetError> {
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
