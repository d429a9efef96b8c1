//! The manifest of what models predict of a scene: that it is whole, what it consists of, what it was made of.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::DatasetError;
use crate::layout::manifest::{ObjectEntry, read_sealed, sha256_hex};

/// Version of groups of predictions and of their manifests.
pub(super) const FORMAT: u32 = 1;

/// What is predicted of a scene. A pure function of the task: its bytes come out the same in every run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PredictionManifest {
    /// Version of this form; filled in.
    pub format: u32,
    /// Scene index, that of the source's scene.
    pub scene: u64,
    /// Key of the task that made it: scene, models and code.
    pub task_key: String,
    /// Version of networks and encoder.
    pub code: String,
    /// The scene that the models saw.
    pub source: SceneUsed,
    /// The models, by what they predict: `tof`, `shadow`, `specular`.
    pub models: BTreeMap<String, ModelUsed>,
    /// What the two-bounce times that a shadow network was given follow from: `truth`, or a model's depths. `None` where none
    /// was given any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub two_bounce_times: Option<TimesUsed>,
    /// Whether what is predicted agrees with itself and with the spots, with figures and `reasons`; null where nothing was
    /// compared.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub agreement: Value,
    /// Its objects; filled in.
    pub objects: Vec<ObjectEntry>,
    /// What [`crate::layout::manifest::seal`] says of the rest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

/// A scene as it was used.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SceneUsed {
    /// Folder of its data set.
    pub dataset: String,
    /// Key of the task that made it.
    pub task_key: String,
    /// SHA-256 of its manifest, hexadecimal: pins every byte of it.
    pub manifest_sha256: String,
}

/// A model as it was used.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ModelUsed {
    /// Its name.
    pub name: String,
    /// SHA-256 of its manifest, hexadecimal.
    pub manifest_sha256: String,
    /// Name of the histogram that it saw.
    pub histogram: String,
    /// The spots of `transient_spots` that were summed for it; empty for other histograms.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
}

/// What two-bounce times follow from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimesUsed {
    /// The ground truth's depths and paths.
    Truth,
    /// Depths that a model predicts.
    Model(ModelUsed),
}

impl PredictionManifest {
    pub(super) fn sealed(mut self) -> Self {
        self.checksum = None;
        self.checksum = Some(sha256_hex(&self.to_bytes()));
        self
    }

    /// Size of all objects together.
    pub fn total_bytes(&self) -> u64 {
        self.objects.iter().map(|o| o.size).sum()
    }

    /// SHA-256 of its bytes as they lie in the store, hexadecimal.
    pub fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }

    /// The manifest as it lies in the store.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self).expect("a manifest has only string keys");
        bytes.push(b'\n');
        bytes
    }

    pub(super) fn parse(bytes: &[u8], scene: u64, object: &str) -> Result<Self, DatasetError> {
        let manifest: Self = read_sealed(bytes, "a manifest of predictions", FORMAT, object)?;
        if manifest.scene != scene {
            return Err(DatasetError::Damaged {
                object: object.to_owned(),
                what: format!("holds scene {}, not {scene}", manifest.scene),
            });
        }
        Ok(manifest)
    }
}
