//! Stored splits of a data set: `splits/<name>/v<k>.json`. Each version is create-only, never
//! changes, and has a checksum.

use futures::TryStreamExt;
use object_store::ObjectStore;

use crate::scenes::dataset::Dataset;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::{seal, unsealed};

impl Dataset {
    /// Returns the stored versions of a split, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn split_versions(&self, name: &str) -> Result<Vec<u64>, StorageError> {
        let folder = self.path(&format!("splits/{name}"));
        let mut versions: Vec<u64> = self
            .store
            .list(Some(&folder))
            .try_filter_map(
                |object| async move { Ok(object.location.filename().and_then(version)) },
            )
            .try_collect()
            .await
            .map_err(|e| StorageError::store("list", self.shown(&folder), e))?;
        versions.sort_unstable();
        Ok(versions)
    }

    /// Reads a version of a split, with the content given to [`Self::create_split`].
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if it is missing or changed, because scenes may have moved from
    /// one side to another; [`StorageError::Store`].
    pub async fn read_split(&self, name: &str, version: u64) -> Result<Vec<u8>, StorageError> {
        let path = self.path(&split_key(name, version));
        let bytes = objects::require(&*self.store, &path).await?;
        check(&split_key(name, version), &bytes).map_err(|what| StorageError::Damaged {
            object: self.shown(&path),
            what: format!(
                "{what}; put a copy back, or delete the split and make it again with `picofarm dataset split` and the same \
                 counts and seed"
            ),
        })
    }

    /// Stores a version of a split as pretty JSON, create-only. Returns `false` if it already
    /// exists because another process created it first.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn create_split(
        &self,
        name: &str,
        version: u64,
        bytes: Vec<u8>,
    ) -> Result<bool, StorageError> {
        let path = self.path(&split_key(name, version));
        objects::create(&*self.store, &path, seal(&bytes).into()).await
    }

    /// Returns the location of a version of a split for messages.
    pub fn split_place(&self, name: &str, version: u64) -> String {
        self.shown(&self.path(&split_key(name, version)))
    }
}

/// Returns the key of a version of a split, relative to the data set.
fn split_key(name: &str, version: u64) -> String {
    format!("splits/{name}/v{version}.json")
}

/// Returns the split's JSON from the object at `key`, which is relative to the data set.
///
/// # Errors
/// If the object was changed, or belongs to another split.
pub(crate) fn check(key: &str, bytes: &[u8]) -> Result<Vec<u8>, String> {
    let json = unsealed(bytes)?;
    let record: serde_json::Value =
        serde_json::from_slice(&json).map_err(|e| format!("not a split: {e}"))?;
    let name = record["settings"]["name"].as_str().unwrap_or_default();
    let version = record["version"].as_u64().unwrap_or_default();
    match split_key(name, version) == key {
        true => Ok(json),
        false => Err(format!(
            "holds version {version} of {name:?}, another split"
        )),
    }
}

/// Returns whether a key relative to the data set belongs to a split.
pub(crate) fn is_split(key: &str) -> bool {
    let mut parts = key.split('/');
    let folder = parts.next() == Some("splits");
    let name = parts.next().is_some_and(|name| !name.is_empty());
    folder && name && parts.next().and_then(version).is_some() && parts.next().is_none()
}

fn version(file: &str) -> Option<u64> {
    let number = file.strip_prefix('v')?.strip_suffix(".json")?;
    let version: u64 = number.parse().ok()?;
    (version > 0 && version.to_string() == number).then_some(version)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_splits_are_taken_for_splits() {
        assert!(is_split("splits/default/v1.json"));
        assert!(is_split(&split_key("a-b", 12)));
        for other in [
            "splits/v1.json",
            "splits/a/v0.json",
            "splits/a/v01.json",
            "splits/a/b/v1.json",
            "splits/a/v1.txt",
            "depth/c/0/0/0",
        ] {
            assert!(!is_split(other), "{other}");
        }
    }
}
