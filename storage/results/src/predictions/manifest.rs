//! The manifest of a scene's predictions: the record of their completion, their objects and their
//! origin.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use picofarm_store::StorageError;
use picofarm_store::sealed::{ObjectEntry, read_sealed, sha256_hex};

/// Format version of groups of predictions and of their manifests.
pub(super) const FORMAT: u32 = 1;

/// The predictions of a scene. It is a pure function of the task, so every run produces the same
/// bytes.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PredictionManifest {
    /// Format version of the manifest. Set on encoding.
    pub format: u32,
    /// Scene index, equal to the source scene's.
    pub scene: u64,
    /// Key of the task that produced it: scene, models and code.
    pub task_key: String,
    /// Code version of networks and encoder.
    pub code: String,
    /// The models' input scene.
    pub source: SceneUsed,
    /// The models, by predicted quantity: `tof`, `shadow`, `specular`.
    pub models: BTreeMap<String, ModelUsed>,
    /// Source of the two-bounce times used by a shadow network: `truth`, or a model's depths.
    /// `None` if none were used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub two_bounce_times: Option<TimesUsed>,
    /// Whether the predictions agree with each other and with the spots, with figures and
    /// `reasons`; null if nothing was compared.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub agreement: Value,
    /// Its objects. Set on encoding.
    pub objects: Vec<ObjectEntry>,
    /// Checksum of the other fields, from `layout::manifest::seal`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

/// A reference to a scene used as input.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SceneUsed {
    /// Folder of the scene's data set.
    pub dataset: String,
    /// Key of the task that produced it.
    pub task_key: String,
    /// SHA-256 of its manifest, in hexadecimal, which pins every byte of it.
    pub manifest_sha256: String,
}

/// A reference to a model that was used.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ModelUsed {
    /// Its name.
    pub name: String,
    /// SHA-256 of its manifest, in hexadecimal.
    pub manifest_sha256: String,
    /// Name of its input histogram.
    pub histogram: String,
    /// The spots of `transient_spots` that were summed for it; empty for other histograms.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
}

/// The source of two-bounce times.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimesUsed {
    /// The ground truth's depths and paths.
    Truth,
    /// Depths predicted by a model.
    Model(ModelUsed),
}

impl PredictionManifest {
    pub(super) fn sealed(mut self) -> Self {
        self.checksum = None;
        self.checksum = Some(sha256_hex(&self.to_bytes()));
        self
    }

    /// Returns the total size of all objects in bytes.
    pub fn total_bytes(&self) -> u64 {
        self.objects.iter().map(|o| o.size).sum()
    }

    /// Returns the SHA-256 of its stored bytes, in hexadecimal.
    pub fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }

    /// Returns the bytes to store.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self).expect("a manifest has only string keys");
        bytes.push(b'\n');
        bytes
    }

    pub(super) fn parse(bytes: &[u8], scene: u64, object: &str) -> Result<Self, StorageError> {
        let manifest: Self = read_sealed(bytes, "a manifest of predictions", FORMAT, object)?;
        if manifest.scene != scene {
            return Err(StorageError::Damaged {
                object: object.to_owned(),
                what: format!("holds scene {}, not {scene}", manifest.scene),
            });
        }
        Ok(manifest)
    }
}
