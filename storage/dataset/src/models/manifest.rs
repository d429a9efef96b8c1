//! A model's manifest: what it is, where it comes from, how good it is, and what it consists of.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::DatasetError;
use crate::layout::manifest::{ObjectEntry, read_sealed, sha256_hex};

/// Version of manifests of models.
const FORMAT: u32 = 1;

/// What a trained model is. A pure function of its training, where that is one: no times, no machine.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ModelManifest {
    /// Version of this form.
    pub format: u32,
    /// The model's name.
    pub name: String,
    /// What it predicts: `tof`, `shadow` or `specular`.
    pub kind: String,
    /// Key of the training that made it: settings, data, split and code.
    pub training_key: String,
    /// What was asked for, as `train` in a job file.
    pub settings: Value,
    /// What the model runtime made of it: network, input and gate, all that it takes to ask the model.
    pub plan: Value,
    /// Where it comes from.
    pub lineage: Lineage,
    /// How good it is: figures of the validation scenes at its end, and what else the training says of itself.
    pub metrics: Value,
    /// Its objects; keys below the model's folder.
    pub objects: Vec<ObjectEntry>,
    /// What [`crate::layout::manifest::seal`] says of the rest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

/// Where a model comes from.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Lineage {
    /// Folder of the data set in the same store.
    pub dataset: String,
    /// [`crate::Snapshot::id`] of the scenes that were learnt from and validated on: pins every byte of them.
    pub data: String,
    /// The split.
    pub split: SplitUsed,
    /// What was measured in them.
    #[serde(default)]
    pub measurement: Measurement,
    /// Scenes learnt from.
    pub training_scenes: u64,
    /// Scenes validated on.
    pub validation_scenes: u64,
    /// Version of networks and training.
    pub code: String,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Models that it builds on, that whose predictions it learns from among them: name, and SHA-256 of the manifest.
    pub models: BTreeMap<String, String>,
    /// For shadows: the predictions that two-bounce times follow from, by their folder and what pins their bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub times: Option<DepthsUsed>,
    /// Where it is another model's copy under a name of its own: how it was chosen.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub promoted: Option<Promoted>,
}

/// Predicted depths as they were used.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DepthsUsed {
    /// Folder of the predictions in the same store.
    pub predictions: String,
    /// [`crate::PinnedDepths::id`] of the scenes that were used.
    pub id: String,
}

/// What was measured in scenes, as far as experiments differ by it. All zero = not known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Measurement {
    /// Rows of an image.
    pub rows: u32,
    /// Columns of an image.
    pub columns: u32,
    /// Spots that light at once.
    pub spots: u32,
    /// Bounces at most; 0 = all.
    pub max_bounces: u32,
    /// Whether photons were counted, with their noise.
    pub photon_noise: bool,
}

/// How a model was chosen among others.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Promoted {
    /// The model.
    pub model: String,
    /// SHA-256 of its manifest, hexadecimal.
    pub manifest_sha256: String,
    /// Its values where it was a trial, by the parameters' names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<String, Value>,
    /// Models that came to their end, itself among them.
    pub finished: u64,
    /// Models that were begun.
    pub begun: u64,
}

/// A split as it was used.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SplitUsed {
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: u64,
    /// SHA-256 of that version, hexadecimal.
    pub sha256: String,
}

impl ModelManifest {
    /// The same with objects, and the checksum that belongs to it.
    #[must_use]
    pub(super) fn with_objects(mut self, objects: Vec<ObjectEntry>) -> Self {
        self.format = FORMAT;
        self.objects = objects;
        // A feature of serde_json, which any crate may switch on, decides on the order of members otherwise.
        self.settings.sort_all_objects();
        self.plan.sort_all_objects();
        self.metrics.sort_all_objects();
        self.checksum = None;
        self.checksum = Some(sha256_hex(&self.to_bytes()));
        self
    }

    /// The object of this file name.
    pub fn object(&self, file: &str) -> Option<&ObjectEntry> {
        let named = |object: &&ObjectEntry| object.key.rsplit('/').next() == Some(file);
        self.objects.iter().find(named)
    }

    /// Bytes of all objects together.
    pub fn total_bytes(&self) -> u64 {
        self.objects.iter().map(|o| o.size).sum()
    }

    /// SHA-256 of its bytes as they lie in the store, hexadecimal.
    pub fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }

    /// The manifest as it lies in the store.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self)
            .expect("a manifest has only string keys and finite numbers");
        bytes.push(b'\n');
        bytes
    }

    pub(super) fn parse(bytes: &[u8], name: &str, object: &str) -> Result<Self, DatasetError> {
        let manifest: Self = read_sealed(bytes, "a model's manifest", FORMAT, object)?;
        if manifest.name != name {
            return Err(DatasetError::Damaged {
                object: object.to_owned(),
                what: format!("is that of the model {:?}", manifest.name),
            });
        }
        Ok(manifest)
    }
}
