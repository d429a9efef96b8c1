//! Parts of scenes that several workers render together, on their way to who joins them: `parts/<scene>/<task key>/<part>-of-<ranges>.zst`
//! in the data set. Nobody else needs them; they are deleted when the scene is published, and
//! [`Dataset::collect`] deletes what a killed job left.

use bytes::Bytes;
use object_store::path::Path;
use object_store::{Error, ObjectStoreExt};

use crate::dataset::Dataset;
use crate::error::DatasetError;
use crate::objects;

/// The folder of the parts.
const FOLDER: &str = "parts";
/// zstd level: a part is read once.
const LEVEL: i32 = 1;

/// Names a part of a scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PartName {
    /// The scene.
    pub scene: u64,
    /// Key of the task that joins it, hexadecimal.
    pub task_key: String,
    /// Which part, and of how many.
    pub part: (u32, u32),
}

impl PartName {
    fn key(&self) -> String {
        let (index, of) = self.part;
        format!(
            "{FOLDER}/{}/{}/{index}-of-{of}.zst",
            self.scene, self.task_key
        )
    }
}

/// The scene that an object belongs to, if it is a part of one.
pub(crate) fn part_scene(key: &str) -> Option<u64> {
    let rest = key.strip_prefix(FOLDER)?.strip_prefix('/')?;
    let (scene, name) = rest.split_once('/')?;
    (name.ends_with(".zst") && name.matches('/').count() == 1).then(|| scene.parse().ok())?
}

impl Dataset {
    /// Puts a part, over a damaged one if need be.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn put_part(&self, name: &PartName, bytes: &[u8]) -> Result<(), DatasetError> {
        let path = self.path(&name.key());
        // With a checksum, so that whoever reads it knows that it is whole.
        let packed = zstd::bulk::Compressor::new(LEVEL).and_then(|mut packer| {
            packer.include_checksum(true)?;
            packer.compress(bytes)
        });
        let packed = packed.map_err(|e| DatasetError::codec("part of a scene", e))?;
        objects::overwrite(&*self.store, &path, packed.into()).await
    }

    /// A part; `None` where there is none, or a damaged one.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn part(&self, name: &PartName) -> Result<Option<Bytes>, DatasetError> {
        let path = self.path(&name.key());
        let Some(packed) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        match zstd::decode_all(&packed[..]) {
            Ok(bytes) => Ok(Some(bytes.into())),
            Err(error) => {
                tracing::warn!(object = %path, %error, "a part of a scene is damaged; it is rendered again");
                Ok(None)
            }
        }
    }

    /// Deletes a part, if it is there.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn delete_part(&self, name: &PartName) -> Result<(), DatasetError> {
        let path: Path = self.path(&name.key());
        match self.store.delete(&path).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(DatasetError::store("delete", self.shown(&path), e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
