//! Checkpoints of trainings: `models/<name>/checkpoints/<training key>/<step>.ckpt`, each with its own checksum. Whoever
//! runs a training finds the newest one that is whole. The newest two are kept, so that one which is damaged costs no
//! more than the time between them; all are deleted when the model is published.

use bytes::Bytes;
use object_store::path::Path;
use object_store::{Error, ObjectMeta, ObjectStore, PutMode, PutOptions, PutPayload};
use sha2::{Digest, Sha256};

use super::{Models, check_name};
use crate::error::DatasetError;
use crate::store::objects;

/// First bytes of a checkpoint; its SHA-256 (32 bytes) and its content follow.
const MAGIC: &[u8; 8] = b"pfckpt1\n";
/// Bytes before the content.
const HEAD: usize = MAGIC.len() + 32;
/// Checkpoints that are kept.
const KEPT: usize = 2;
/// Folder of a model's checkpoints.
pub(super) const FOLDER: &str = "checkpoints";

/// A checkpoint as it is listed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Checkpoint {
    /// The training.
    pub training_key: String,
    /// Steps done.
    pub step: u64,
    /// Its size.
    pub bytes: u64,
    pub(super) object: ObjectMeta,
}

impl Models {
    /// Stores what a training is after `step` steps, create-only, and deletes all but the newest two up to it. A whole
    /// checkpoint of that step that is there already stands; a damaged one is replaced.
    ///
    /// # Errors
    /// [`DatasetError::Invalid`] for a name that cannot be used; [`DatasetError::Store`].
    pub async fn put_checkpoint(
        &self,
        name: &str,
        training_key: &str,
        step: u64,
        content: Bytes,
    ) -> Result<(), DatasetError> {
        check_name(name)?;
        let path = self.path(name, &key(training_key, step));
        let mut head = MAGIC.to_vec();
        head.extend_from_slice(&Sha256::digest(&content));
        let payload: PutPayload = [Bytes::from(head), content].into_iter().collect();
        let put = |mode| {
            let options = PutOptions::from(mode);
            self.store.put_opts(&path, payload.clone(), options)
        };
        match put(PutMode::Create).await {
            Ok(_) => {}
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => {
                let found = objects::get(&*self.store, &path).await?;
                if found.and_then(whole).is_none() {
                    let replaced = put(PutMode::Overwrite).await;
                    replaced.map_err(|e| self.failed("replace", &path, e))?;
                }
            }
            Err(e) => return Err(self.failed("write", &path, e)),
        }
        let mut there = self.checkpoints_of(name, training_key).await?;
        there.retain(|checkpoint| checkpoint.step <= step);
        for old in there.iter().rev().skip(KEPT) {
            self.delete(&old.object.location).await?;
        }
        Ok(())
    }

    /// The newest whole checkpoint of a training: its step and content. Damaged ones are passed over.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn newest_checkpoint(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<Option<(u64, Bytes)>, DatasetError> {
        for checkpoint in self.checkpoints_of(name, training_key).await?.iter().rev() {
            let path = &checkpoint.object.location;
            // Another worker may have written a newer one and deleted this one meanwhile.
            let Some(bytes) = objects::get(&*self.store, path).await? else {
                continue;
            };
            match whole(bytes) {
                Some(content) => return Ok(Some((checkpoint.step, content))),
                None => {
                    tracing::warn!(object = %path, "a checkpoint is damaged; the one before is used");
                }
            }
        }
        Ok(None)
    }

    /// Deletes all checkpoints of a training.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn delete_checkpoints(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<(), DatasetError> {
        for checkpoint in self.checkpoints_of(name, training_key).await? {
            self.delete(&checkpoint.object.location).await?;
        }
        Ok(())
    }

    /// The checkpoints of all trainings under a name, by training and step, ascending.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn checkpoints(&self, name: &str) -> Result<Vec<Checkpoint>, DatasetError> {
        self.checkpoints_in(&self.path(name, FOLDER)).await
    }

    async fn checkpoints_of(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<Vec<Checkpoint>, DatasetError> {
        let folder = self.path(name, &format!("{FOLDER}/{training_key}"));
        self.checkpoints_in(&folder).await
    }

    async fn checkpoints_in(&self, folder: &Path) -> Result<Vec<Checkpoint>, DatasetError> {
        let listed = self.list(folder).await?.into_iter();
        let mut found: Vec<Checkpoint> = listed.filter_map(checkpoint).collect();
        found.sort_by(|a, b| (&a.training_key, a.step).cmp(&(&b.training_key, b.step)));
        Ok(found)
    }
}

fn key(training_key: &str, step: u64) -> String {
    format!("{FOLDER}/{training_key}/{step:012}.ckpt")
}

/// The checkpoint in an object, if it is named like one.
fn checkpoint(object: ObjectMeta) -> Option<Checkpoint> {
    let parts: Vec<_> = object.location.parts().collect();
    let [.., folder, training_key, file] = &parts[..] else {
        return None;
    };
    let digits = file.as_ref().strip_suffix(".ckpt")?;
    if folder.as_ref() != FOLDER || digits.len() < 12 {
        return None;
    }
    Some(Checkpoint {
        training_key: training_key.as_ref().to_owned(),
        step: digits.parse().ok()?,
        bytes: object.size,
        object: object.clone(),
    })
}

/// The content of a checkpoint that has its checksum.
pub(super) fn whole(bytes: Bytes) -> Option<Bytes> {
    if bytes.len() < HEAD || bytes[..MAGIC.len()] != *MAGIC {
        return None;
    }
    let content = bytes.slice(HEAD..);
    let stated = &bytes[MAGIC.len()..HEAD];
    (Sha256::digest(&content)[..] == *stated).then_some(content)
}
