//! A scene's manifest: the durable record of its completion, its objects and its provenance.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::coding::squareroot::EncodeError;
use crate::layout::quantity::Quantity;
use crate::layout::record::Provenance;
use crate::layout::spec::Profile;
use picofarm_store::StorageError;
use picofarm_store::published;
use picofarm_store::sealed::{ObjectEntry, document, no_strange_member, same_scene, unseal};

/// Format version of the layout on disk. Other formats cannot be read.
pub const FORMAT_VERSION: u32 = 3;

/// Version of the encoder's output. It changes whenever the same record could produce different
/// bytes.
pub const ENCODER_VERSION: &str = "encoder-3";

/// Returns the message for data in another format.
pub(crate) fn other_format(found: u64) -> String {
    format!(
        "written in format {found}, and this program reads format {FORMAT_VERSION}: use the version of picofarm that wrote \
         it, or make the data set again"
    )
}

/// The encoding of an additional transient.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SubsetCoding {
    /// The encoding error.
    pub error: EncodeError,
    /// Saturated bins: (flat index in `[bin][row][column]`, for `transient_spots` in
    /// `[spot][bin][row][column]`; exact value of h), by index.
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
        self.checksum = Some(published::Manifest::sha256(&self));
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
}

impl published::Manifest for Manifest {
    type Id = u64;

    fn parse(bytes: &[u8], scene: &u64, object: &str) -> Result<Self, StorageError> {
        let damaged = |what: String| StorageError::Damaged {
            object: object.to_string(),
            what,
        };
        let manifest: Self =
            serde_json::from_slice(bytes).map_err(|e| damaged(format!("not a manifest: {e}")))?;
        if manifest.format != FORMAT_VERSION {
            return Err(damaged(other_format(manifest.format.into())));
        }
        same_scene(manifest.scene, *scene, object)?;
        match &manifest.checksum {
            Some(checksum) => drop(unseal(bytes, checksum).map_err(damaged)?),
            // Older programs wrote no checksum. A manifest with a damaged name of the member
            // `checksum` must not count as one of these.
            None => no_strange_member(bytes, &manifest).map_err(damaged)?,
        }
        Ok(manifest)
    }

    fn to_bytes(&self) -> Vec<u8> {
        document(self)
    }

    fn objects(&self) -> &[ObjectEntry] {
        &self.objects
    }

    fn task_key(&self) -> &str {
        &self.provenance.task_key
    }

    fn taken(&self, place: &str, task_key: &str) -> StorageError {
        let what = format!(
            "{place} holds scene {} of another task (key {}, this task's is {task_key}); choose another folder",
            self.scene, self.provenance.task_key
        );
        StorageError::invalid("output.dataset", what)
    }
}

/// Returns the scene of the manifest with this key.
pub(crate) fn manifest_scene(key: &str) -> Option<u64> {
    let scene = key
        .strip_prefix("manifests/")?
        .strip_suffix(".json")?
        .parse()
        .ok()?;
    (Manifest::key(scene) == key).then_some(scene)
}
