//! Parts of scenes that several workers render together, in transit to the worker that joins them:
//! `parts/<scene>/<task key>/<part>-of-<ranges>.zst` in the data set. They have no other use, and
//! are deleted when the scene is published. [`Dataset::collect`] deletes parts left by a killed
//! job.

use bytes::Bytes;
use object_store::path::Path;
use object_store::{Error, ObjectStoreExt};

use crate::scenes::dataset::Dataset;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::packed::{pack, unpack};

/// The folder of the parts in a data set.
const FOLDER: &str = "parts";

/// The name of a part of a scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PartName {
    /// The scene.
    pub scene: u64,
    /// Key of the joining task, in hexadecimal.
    pub task_key: String,
    /// The part's index and the number of parts.
    pub part: (u32, u32),
}

impl PartName {
    /// Returns its key relative to the data set.
    pub fn key(&self) -> String {
        let (index, of) = self.part;
        format!(
            "{FOLDER}/{}/{}/{index}-of-{of}.zst",
            self.scene, self.task_key
        )
    }
}

/// Returns the scene of an object, if the object is a part.
pub(crate) fn part_scene(key: &str) -> Option<u64> {
    let rest = key.strip_prefix(FOLDER)?.strip_prefix('/')?;
    let (scene, name) = rest.split_once('/')?;
    (name.ends_with(".zst") && name.matches('/').count() == 1).then(|| scene.parse().ok())?
}

impl Dataset {
    /// Stores a part, replacing a damaged one.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn put_part(&self, name: &PartName, bytes: &[u8]) -> Result<(), StorageError> {
        let path = self.path(&name.key());
        let packed = pack(bytes).map_err(|e| StorageError::codec("part of a scene", e))?;
        objects::overwrite(&*self.store, &path, packed.into()).await
    }

    /// Reads a part. Returns `None` if it is missing or damaged.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn part(&self, name: &PartName) -> Result<Option<Bytes>, StorageError> {
        let path = self.path(&name.key());
        let Some(packed) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        match unpack(&packed, self.most_of_a_part()) {
            Ok(bytes) => Ok(Some(bytes.into())),
            Err(error) => {
                tracing::warn!(object = %path, %error, "a part of a scene is damaged; it is rendered again");
                Ok(None)
            }
        }
    }

    /// Returns the maximum size in bytes of a scene's part: 64-bit sums, squares and draws of every
    /// histogram.
    fn most_of_a_part(&self) -> u64 {
        const HISTOGRAMS: u64 = 8;
        let spec = self.spec();
        let each = if spec.per_spot {
            u64::from(spec.spots)
        } else {
            0
        };
        let histograms = 1 + spec.subsets.sizes().len() as u64 + each;
        let values = spec.transient_len() as u64;
        values * histograms * HISTOGRAMS * 8 + (64 << 20)
    }

    /// Deletes a part, if it exists.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn delete_part(&self, name: &PartName) -> Result<(), StorageError> {
        let path: Path = self.path(&name.key());
        match self.store.delete(&path).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(StorageError::store("delete", self.shown(&path), e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_that_announces_too_much_or_another_size_is_not_unpacked() {
        let bomb = zstd::bulk::compress(&vec![0; 64 << 20], 1).unwrap();
        assert!(bomb.len() < 1 << 16);
        let said = unpack(&bomb, 1 << 20).unwrap_err().to_string();
        assert!(said.contains("announces 67108864 bytes"), "{said}");
        assert_eq!(unpack(&bomb, 64 << 20).unwrap().len(), 64 << 20);
        // A stream without a size in its header.
        let streamed = zstd::encode_all(&vec![0; 1 << 20][..], 1).unwrap();
        assert!(unpack(&streamed, 2 << 20).is_err());
    }

    #[test]
    fn only_names_of_parts_are_taken_for_parts() {
        let name = PartName {
            scene: 7,
            task_key: "ab".into(),
            part: (2, 4),
        };
        assert_eq!(part_scene(&name.key()), Some(7));
        for other in [
            "parts/7/ab",
            "parts/x/ab/2-of-4.zst",
            "transient/c/7/0/0/0",
            "parts/7/2-of-4.zst",
        ] {
            assert_eq!(part_scene(other), None, "{other}");
        }
    }
}
