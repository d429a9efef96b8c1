//! Checkpoints of tasks that run for long: `checkpoints/<key>/<step>.ckpt`, each with its own checksum. Whoever runs such a
//! task finds the newest one that is whole. The newest two are kept, so that one which is damaged costs no more than the
//! time between them; all are deleted when the result is published.

use std::sync::Arc;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::path::Path;
use object_store::{
    Error, ObjectMeta, ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload,
};
use sha2::{Digest, Sha256};

use crate::error::DatasetError;
use crate::store::objects;

/// First bytes of a checkpoint; its SHA-256 (32 bytes) and its content follow.
const MAGIC: &[u8; 8] = b"pfckpt1\n";
/// Bytes before the content.
const HEAD: usize = MAGIC.len() + 32;
/// Checkpoints that are kept.
const KEPT: usize = 2;
/// Folder of checkpoints, beside what is published.
pub(crate) const FOLDER: &str = "checkpoints";

/// A checkpoint as it is listed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Checkpoint {
    /// The task: of a model, its training.
    pub training_key: String,
    /// Steps done.
    pub step: u64,
    /// Its size.
    pub bytes: u64,
    pub(crate) object: ObjectMeta,
}

/// The checkpoints of one task. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Checkpoints {
    store: Arc<dyn ObjectStore>,
    folder: Path,
}

impl Checkpoints {
    /// Those of the task with this key, beside what is published at `prefix`.
    pub(crate) fn new(store: Arc<dyn ObjectStore>, prefix: &Path, key: &str) -> Self {
        let folder = objects::path_of(prefix, &format!("{FOLDER}/{key}"));
        Self { store, folder }
    }

    /// Stores what the task is after `step` steps, create-only, and deletes all but the newest two up to it. A whole
    /// checkpoint of that step that is there already stands; a damaged one is replaced.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn put(&self, step: u64, content: Bytes) -> Result<(), DatasetError> {
        let path = objects::path_of(&self.folder, &format!("{step:012}.ckpt"));
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
        let mut there = self.all().await?;
        there.retain(|checkpoint| checkpoint.step <= step);
        for old in there.iter().rev().skip(KEPT) {
            self.remove(&old.object.location).await?;
        }
        Ok(())
    }

    /// The newest whole checkpoint: its step and content. Damaged ones are passed over.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn newest(&self) -> Result<Option<(u64, Bytes)>, DatasetError> {
        for checkpoint in self.all().await?.iter().rev() {
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

    /// Deletes all.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn delete(&self) -> Result<(), DatasetError> {
        for checkpoint in self.all().await? {
            self.remove(&checkpoint.object.location).await?;
        }
        Ok(())
    }

    async fn all(&self) -> Result<Vec<Checkpoint>, DatasetError> {
        let listed = self.store.list(Some(&self.folder)).try_collect().await;
        Ok(found(
            listed.map_err(|e| self.failed("list", &self.folder, e))?,
        ))
    }

    async fn remove(&self, path: &Path) -> Result<(), DatasetError> {
        match self.store.delete(path).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(self.failed("delete", path, e)),
        }
    }

    fn failed(&self, action: &'static str, path: &Path, error: Error) -> DatasetError {
        DatasetError::store(action, objects::shown(&*self.store, path), error)
    }
}

/// The checkpoints among objects, by task and step, ascending.
pub(crate) fn found(objects: Vec<ObjectMeta>) -> Vec<Checkpoint> {
    let mut found: Vec<Checkpoint> = objects.into_iter().filter_map(checkpoint).collect();
    found.sort_by(|a, b| (&a.training_key, a.step).cmp(&(&b.training_key, b.step)));
    found
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
pub(crate) fn whole(bytes: Bytes) -> Option<Bytes> {
    if bytes.len() < HEAD || bytes[..MAGIC.len()] != *MAGIC {
        return None;
    }
    let content = bytes.slice(HEAD..);
    let stated = &bytes[MAGIC.len()..HEAD];
    (Sha256::digest(&content)[..] == *stated).then_some(content)
}
