//! Splits beside a data set: `splits/<name>/v<k>.json`, create-only and never changed, each with its checksum.

use futures::TryStreamExt;
use object_store::ObjectStore;

use crate::error::DatasetError;
use crate::layout::manifest::{seal, unsealed};
use crate::scenes::dataset::Dataset;
use crate::store::objects;

impl Dataset {
    /// The versions of a split that are stored, ascending.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn split_versions(&self, name: &str) -> Result<Vec<u64>, DatasetError> {
        let folder = self.path(&format!("splits/{name}"));
        let mut versions: Vec<u64> = self
            .store
            .list(Some(&folder))
            .try_filter_map(
                |object| async move { Ok(object.location.filename().and_then(version)) },
            )
            .try_collect()
            .await
            .map_err(|e| DatasetError::store("list", self.shown(&folder), e))?;
        versions.sort_unstable();
        Ok(versions)
    }

    /// A version of a split, as it was given to [`Self::create_split`].
    ///
    /// # Errors
    /// [`DatasetError::Damaged`] where it is missing or was changed: scenes may have moved from one side to another;
    /// [`DatasetError::Store`].
    pub async fn read_split(&self, name: &str, version: u64) -> Result<Vec<u8>, DatasetError> {
        let path = self.path(&split_key(name, version));
        let bytes = objects::require(&*self.store, &path).await?;
        check(&split_key(name, version), &bytes).map_err(|what| DatasetError::Damaged {
            object: self.shown(&path),
            what: format!(
                "{what}; put a copy back, or delete the split and make it again with `picofarm dataset split` and the same \
                 counts and seed"
            ),
        })
    }

    /// Stores a version of a split, pretty JSON, create-only. `false` where it exists already: somebody else was faster.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn create_split(
        &self,
        name: &str,
        version: u64,
        bytes: Vec<u8>,
    ) -> Result<bool, DatasetError> {
        let path = self.path(&split_key(name, version));
        objects::create(&*self.store, &path, seal(&bytes).into()).await
    }

    /// Where a version of a split lies, for a message.
    pub fn split_place(&self, name: &str, version: u64) -> String {
        self.shown(&self.path(&split_key(name, version)))
    }
}

/// Key of a version of a split, relative to the data set.
fn split_key(name: &str, version: u64) -> String {
    format!("splits/{name}/v{version}.json")
}

/// What the object under `key`, relative to the data set, holds as a split.
///
/// # Errors
/// It was changed, or is another split.
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

/// Whether a key relative to the data set is that of a split.
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
