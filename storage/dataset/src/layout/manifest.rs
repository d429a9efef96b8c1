//! A scene's manifest: the durable record of its completion, its objects and its provenance.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::coding::squareroot::EncodeError;
use crate::layout::quantity::Quantity;
use crate::layout::record::Provenance;
use crate::layout::spec::Profile;
use picofarm_store::StorageError;
use picofarm_store::sealed::{ObjectEntry, no_strange_member, sha256_hex, unseal};

/// Format version of the layout on disk. Data sets of older formats retain theirs: they can be
/// read, and scenes can be added.
///
/// 1: histograms are stored pixel by pixel, in inner chunks of all bins. 2: bin by bin, in inner
/// chunks of 128 bins.
pub const FORMAT_VERSION: u32 = 2;

/// Version of the encoder's output. It changes whenever the same record could produce different
/// bytes.
pub const ENCODER_VERSION: &str = "encoder-2";

/// Returns the encoder named in the root of a data set of the given format, which is the first one
/// that wrote it.
pub(crate) fn encoder_of(format: u32) -> &'static str {
    match format {
        1 => "encoder-1",
        _ => "encoder-2",
    }
}

/// The encoding of an additional transient.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SubsetCoding {
    /// The encoding error.
    pub error: EncodeError,
    /// Saturated bins: (flat index in `[row][column][bin]`, for `transient_spots` in
    /// `[spot][row][column][bin]`; exact value of h), by index.
    pub overflow: Vec<(u64, f32)>,
}

/// The contents of a published scene. It is a pure function of the task, so every run produces the
/// same bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT_VERSION`] at the time of writing.
    pub format: u32,
    /// Scene index.
    pub scene: u64,
    /// Codec of the transient.
    pub profile: Profile,
    /// [`ENCODER_VERSION`] at the time of writing.
    pub encoder: String,
    /// Photons per unit of h.
    pub scale: f32,
    /// Error of the encoded transient.
    pub error: EncodeError,
    /// The origin of the scene.
    pub provenance: Provenance,
    /// Saturated bins: (flat index in `[row][column][bin]`, exact value of h), by index.
    pub overflow: Vec<(u64, f32)>,
    /// Encodings of the additional transients, by array name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub subsets: BTreeMap<String, SubsetCoding>,
    /// The scene's objects.
    pub objects: Vec<ObjectEntry>,
    /// Checksum of the other fields, from `seal`, to detect flipped bits; `None` in manifests
    /// from before it existed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub checksum: Option<String>,
}

impl Manifest {
    /// Returns the manifest with its checksum set.
    pub fn sealed(mut self) -> Self {
        self.checksum = None;
        self.checksum = Some(sha256_hex(&self.to_bytes()));
        self
    }

    /// Returns whether both are equal except for the checksum.
    pub fn same_as(&self, other: &Self) -> bool {
        let bare = |manifest: &Self| Self {
            checksum: None,
            ..manifest.clone()
        };
        bare(self) == bare(other)
    }

    /// Returns the key of a scene's manifest, relative to the data set.
    pub fn key(scene: u64) -> String {
        format!("manifests/{scene}.json")
    }

    /// Returns the total size of all objects in bytes.
    pub fn total_bytes(&self) -> u64 {
        self.objects.iter().map(|o| o.size).sum()
    }

    /// Returns the names of quantities that the scene's source did not have and that are stored as
    /// fill values. This concerns imports and scenes derived from them. The list is empty if all
    /// quantities are known.
    pub fn missing(&self) -> Vec<String> {
        let listed = self.provenance.plan["missing"].as_array();
        let names = listed.into_iter().flatten().filter_map(Value::as_str);
        names.map(str::to_owned).collect()
    }

    /// Returns the entry of an object.
    pub fn object(&self, key: &str) -> Option<&ObjectEntry> {
        self.objects.iter().find(|o| o.key == key)
    }

    /// Returns the saturated bins of a transient.
    pub fn overflow_of(&self, quantity: Quantity) -> &[(u64, f32)] {
        match quantity {
            Quantity::Transient => &self.overflow,
            other => self.subsets.get(other.name()).map_or(&[], |s| &s.overflow),
        }
    }

    /// Returns the bytes to store.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self)
            .expect("a manifest has only string keys and finite numbers");
        bytes.push(b'\n');
        bytes
    }

    /// Parses the manifest of `scene` stored at `object`.
    pub(crate) fn parse(bytes: &[u8], scene: u64, object: &str) -> Result<Self, StorageError> {
        let damaged = |what: String| StorageError::Damaged {
            object: object.to_string(),
            what,
        };
        let manifest: Self =
            serde_json::from_slice(bytes).map_err(|e| damaged(format!("not a manifest: {e}")))?;
        if manifest.format > FORMAT_VERSION {
            return Err(damaged(format!(
                "written in format {}, this program knows formats up to {FORMAT_VERSION}: use a newer one",
                manifest.format
            )));
        }
        if manifest.scene != scene {
            return Err(damaged(format!(
                "holds scene {}, not {scene}",
                manifest.scene
            )));
        }
        match &manifest.checksum {
            Some(checksum) => drop(unseal(bytes, checksum).map_err(damaged)?),
            // Older programs wrote no checksum. A manifest with a damaged name of the member
            // `checksum` must not count as one of these.
            None => no_strange_member(bytes, &manifest).map_err(damaged)?,
        }
        Ok(manifest)
    }
}
