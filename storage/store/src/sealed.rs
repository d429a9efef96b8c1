//! Documents that carry a checksum of themselves, and entries for objects with SHA-256.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::error::StorageError;

/// One object that a manifest lists.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectEntry {
    /// Key relative to the folder of the manifest.
    pub key: String,
    /// Size in bytes.
    pub size: u64,
    /// SHA-256 of the bytes, in hexadecimal.
    pub sha256: String,
}

/// Appends to an object's pretty JSON a last member `checksum`: the SHA-256, in hexadecimal, of its
/// bytes without that member.
pub fn seal(json: &[u8]) -> Vec<u8> {
    let body = json
        .strip_suffix(END)
        .expect("pretty JSON of an object ends so");
    [body, tail(&sha256_hex(json)).as_bytes()].concat()
}

/// Returns the JSON without its `checksum`, if it matches; otherwise a description of the problem.
pub fn unseal(sealed: &[u8], checksum: &str) -> Result<Vec<u8>, String> {
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
pub fn no_strange_member(bytes: &[u8], written: &impl Serialize) -> Result<(), String> {
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
pub fn unsealed(bytes: &[u8]) -> Result<Vec<u8>, String> {
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
/// [`StorageError::Damaged`] if it is not a valid `what`.
pub fn read_unsealed<T: DeserializeOwned>(
    bytes: &[u8],
    what: &str,
    object: String,
) -> Result<T, StorageError> {
    let read = unsealed(bytes)
        .and_then(|json| serde_json::from_slice(&json).map_err(|e| format!("is not {what}: {e}")));
    read.map_err(|what| StorageError::Damaged { object, what })
}

/// Parses a document with a last member `checksum`, as written by [`seal`]. `what` is its
/// description, and `format` is the newest version that this program supports.
pub fn read_sealed<T: DeserializeOwned>(
    bytes: &[u8],
    what: &str,
    format: u32,
    object: &str,
) -> Result<T, StorageError> {
    /// The members common to all such documents.
    #[derive(Deserialize)]
    struct Head {
        format: u32,
        checksum: Option<String>,
    }
    let damaged = |what: String| StorageError::Damaged {
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
