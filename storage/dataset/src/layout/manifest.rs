//! A scene's manifest: the durable record of its completion, its objects and its provenance.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_json::Value;
use sha2::{Digest, Sha256};

use crate::coding::squareroot::EncodeError;
use crate::error::DatasetError;
use crate::layout::quantity::Quantity;
use crate::layout::record::Provenance;
use crate::layout::spec::Profile;

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

/// One object of a scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectEntry {
    /// Key relative to the data set.
    pub key: String,
    /// Size in bytes.
    pub size: u64,
    /// SHA-256 of the bytes, in hexadecimal.
    pub sha256: String,
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
    pub(crate) fn parse(bytes: &[u8], scene: u64, object: &str) -> Result<Self, DatasetError> {
        let damaged = |what: String| DatasetError::Damaged {
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

/// Appends to an object's pretty JSON a last member `checksum`: the SHA-256, in hexadecimal, of its
/// bytes without that member.
pub(crate) fn seal(json: &[u8]) -> Vec<u8> {
    let body = json
        .strip_suffix(END)
        .expect("pretty JSON of an object ends so");
    [body, tail(&sha256_hex(json)).as_bytes()].concat()
}

/// Returns the JSON without its `checksum`, if it matches; otherwise a description of the problem.
pub(crate) fn unseal(sealed: &[u8], checksum: &str) -> Result<Vec<u8>, String> {
    let Some(body) = sealed.strip_suffix(tail(checksum).as_bytes()) else {
        return Err(
            "its checksum does not stand where it was written: the object was changed".into(),
        );
    };
    let json = [body, END].concat();
    match sha256_hex(&json) {
        found if found == checksum => Ok(json),
        found => Err(format!(
            "its content has the checksum {found}, but says {checksum}: the object was changed"
        )),
    }
}

/// Returns an error if an object's JSON has members other than those of `written`.
fn no_strange_member(bytes: &[u8], written: &impl Serialize) -> Result<(), String> {
    let members = |value: serde_json::Result<serde_json::Value>| match value {
        Ok(serde_json::Value::Object(members)) => members,
        _ => serde_json::Map::new(),
    };
    let known = members(serde_json::to_value(written));
    let found = members(serde_json::from_slice(bytes));
    match found.keys().find(|key| !known.contains_key(*key)) {
        Some(_) => {
            Err("has no checksum and a member that is not known: the object was changed".into())
        }
        None => Ok(()),
    }
}

/// Returns the document in a sealed object; see [`seal`].
///
/// # Errors
/// A description of the problem: the object was changed, or never sealed.
pub(crate) fn unsealed(bytes: &[u8]) -> Result<Vec<u8>, String> {
    #[derive(Deserialize)]
    struct Head {
        checksum: Option<String>,
    }
    let head: Head = serde_json::from_slice(bytes).map_err(|e| {
        format!(
            "not JSON (line {}, column {}): it was changed",
            e.line(),
            e.column()
        )
    })?;
    match head.checksum {
        Some(checksum) => unseal(bytes, &checksum),
        None => Err("has no checksum: it was changed, or written by an older program".into()),
    }
}

/// Parses a sealed object as a document.
///
/// # Errors
/// [`DatasetError::Damaged`] if it is not a valid `what`.
pub(crate) fn read_unsealed<T: DeserializeOwned>(
    bytes: &[u8],
    what: &str,
    object: String,
) -> Result<T, DatasetError> {
    let read = unsealed(bytes)
        .and_then(|json| serde_json::from_slice(&json).map_err(|e| format!("is not {what}: {e}")));
    read.map_err(|what| DatasetError::Damaged { object, what })
}

/// Parses a document with a last member `checksum`, as written by [`seal`]. `what` is its
/// description, and `format` is the newest version that this program supports.
pub(crate) fn read_sealed<T: DeserializeOwned>(
    bytes: &[u8],
    what: &str,
    format: u32,
    object: &str,
) -> Result<T, DatasetError> {
    /// The members common to all such documents.
    #[derive(Deserialize)]
    struct Head {
        format: u32,
        checksum: Option<String>,
    }
    let damaged = |what: String| DatasetError::Damaged {
        object: object.to_owned(),
        what,
    };
    let not = |e: serde_json::Error| damaged(format!("not {what}: {e}"));
    let head: Head = serde_json::from_slice(bytes).map_err(not)?;
    if head.format > format {
        return Err(damaged(format!(
            "written in format {}, this program knows formats up to {format}: use a newer one",
            head.format
        )));
    }
    let Some(checksum) = &head.checksum else {
        return Err(damaged("has no checksum: the object was changed".into()));
    };
    unseal(bytes, checksum).map_err(damaged)?;
    serde_json::from_slice(bytes).map_err(not)
}

const END: &[u8] = b"\n}\n";

fn tail(checksum: &str) -> String {
    format!(",\n  \"checksum\": \"{checksum}\"\n}}\n")
}

/// Returns the SHA-256 in hexadecimal.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}
