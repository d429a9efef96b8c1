//! A model's manifest: its description, lineage, metrics and objects.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use picofarm_store::StorageError;
use picofarm_store::published::Manifest;
use picofarm_store::sealed::{ObjectEntry, document, read_sealed};

/// Format version of model manifests.
const FORMAT: u32 = 1;

/// The contents of a trained model. If the training is reproducible, it is a pure function of the
/// training, without times or machine names.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ModelManifest {
    /// Format version of the manifest.
    pub format: u32,
    /// The model's name.
    pub name: String,
    /// The predicted quantity: `tof`, `shadow` or `specular`.
    pub kind: String,
    /// Key of the training that produced it: settings, data, split and code.
    pub training_key: String,
    /// The requested settings: `train` in a job file.
    pub settings: Value,
    /// The model runtime's plan: network, input and gate, which suffice to run the model.
    pub plan: Value,
    /// The origin of the model.
    pub lineage: Lineage,
    /// Metrics on the validation scenes at the end of the training, and other facts about the
    /// training.
    pub metrics: Value,
    /// Its objects, with keys relative to the model's folder.
    pub objects: Vec<ObjectEntry>,
    /// Checksum of the other fields, from `picofarm_store::sealed::seal`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

/// The origin of a model.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Lineage {
    /// Folder of the data set in the same store.
    pub dataset: String,
    /// [`picofarm_dataset::Snapshot::id`] of the training and validation scenes, which pins every
    /// byte of them.
    pub data: String,
    /// The split.
    pub split: SplitUsed,
    /// The measurement in these scenes.
    #[serde(default)]
    pub measurement: Measurement,
    /// Number of training scenes.
    pub training_scenes: u64,
    /// Number of validation scenes.
    pub validation_scenes: u64,
    /// Code version of networks and training.
    pub code: String,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Models used for the training, including a teacher with predictions as labels: name, and
    /// SHA-256 of the manifest.
    pub models: BTreeMap<String, String>,
    /// For shadows, the predictions from which two-bounce times are computed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub times: Option<DepthsUsed>,
    /// If it is a promoted copy of another model, how it was selected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub promoted: Option<Promoted>,
    /// If another program than picofarm computed the training: its name, versions and device. The
    /// same training then gives similar weights, not the same bits.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub runtime: BTreeMap<String, String>,
}

/// The predicted depths that were used.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DepthsUsed {
    /// Folder of the predictions in the same store.
    pub predictions: String,
    /// [`crate::PinnedDepths::id`] of the scenes used.
    pub id: String,
}

/// The measurement in scenes, as far as it distinguishes experiments. All zero = unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Measurement {
    /// Number of image rows.
    pub rows: u32,
    /// Number of image columns.
    pub columns: u32,
    /// Number of simultaneous spots.
    pub spots: u32,
    /// Maximum number of bounces; 0 = all.
    pub max_bounces: u32,
    /// Whether photons were counted, with photon noise.
    pub photon_noise: bool,
}

/// The selection of a model among others.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Promoted {
    /// Name of the selected model.
    pub model: String,
    /// SHA-256 of its manifest, in hexadecimal.
    pub manifest_sha256: String,
    /// If it was a trial, its parameter values, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, Value>,
    /// Number of finished models, including this one.
    pub finished: u64,
    /// Number of models begun.
    pub begun: u64,
}

/// The split used.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SplitUsed {
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: u64,
    /// SHA-256 of that version, in hexadecimal.
    pub sha256: String,
}

impl ModelManifest {
    /// Returns the manifest with objects and checksum set.
    #[must_use]
    pub(super) fn with_objects(mut self, objects: Vec<ObjectEntry>) -> Self {
        self.format = FORMAT;
        self.objects = objects;
        // Otherwise the order of members depends on a feature of serde_json, which any crate may
        // enable.
        self.settings.sort_all_objects();
        self.plan.sort_all_objects();
        self.metrics.sort_all_objects();
        self.checksum = None;
        self.checksum = Some(self.sha256());
        self
    }

    /// Returns the object with this file name.
    pub fn object(&self, file: &str) -> Option<&ObjectEntry> {
        let named = |object: &&ObjectEntry| object.key.rsplit('/').next() == Some(file);
        self.objects.iter().find(named)
    }
}

impl Manifest for ModelManifest {
    type Id = String;

    fn parse(bytes: &[u8], name: &String, object: &str) -> Result<Self, StorageError> {
        let manifest: Self = read_sealed(bytes, "a model's manifest", FORMAT, object)?;
        match manifest.name == *name {
            true => Ok(manifest),
            false => Err(StorageError::Damaged {
                object: object.to_owned(),
                what: format!("is that of the model {:?}", manifest.name),
            }),
        }
    }

    fn to_bytes(&self) -> Vec<u8> {
        document(self)
    }

    fn objects(&self) -> &[ObjectEntry] {
        &self.objects
    }

    fn task_key(&self) -> &str {
        &self.training_key
    }

    fn taken(&self, place: &str, training_key: &str) -> StorageError {
        let what = format!(
            "{place} holds the model of another training (key {}, this one's is {training_key}); choose another name, or delete \
             that folder if nothing needs it",
            self.training_key
        );
        StorageError::invalid("model", what)
    }
}
