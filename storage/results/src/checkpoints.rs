//! Checkpoints of long-running tasks: `checkpoints/<key>/<step>.ckpt`, each with its own checksum.
//! A worker that takes over such a task resumes from the newest intact checkpoint. The newest two
//! are retained, so that a damaged one costs no more than the time between them. All are deleted
//! when the result is published.
//!
//! A large checkpoint is split into pieces, which are written and read concurrently while the task
//! continues. All pieces but the first are stored as `<step>.<piece>.part`. The first piece is
//! stored last, as `<step>.ckpt`, with the checksums of all pieces. Therefore a checkpoint with a
//! `.ckpt` object was written completely, and pieces of two writers are never mixed.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use futures::stream::{FuturesUnordered, StreamExt};
use futures::{TryStreamExt, stream};
use object_store::path::Path;
use object_store::{
    Error, ObjectMeta, ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload,
};
use sha2::{Digest, Sha256};

use picofarm_store::StorageError;
use picofarm_store::objects;

/// First bytes of a checkpoint. They are followed by the SHA-256 (32 bytes) of the remaining bytes,
/// the number of further pieces (4 bytes, little endian), the SHA-256 of each, and the first piece.
const MAGIC: &[u8; 8] = b"pfckpt2\n";
/// Number of bytes before the checksummed part.
const HEAD: usize = MAGIC.len() + SHA;
/// Size of a SHA-256 in bytes.
const SHA: usize = 32;
/// Number of checkpoints to retain.
const KEPT: usize = 2;
/// Maximum number of pieces transferred concurrently; each is in memory meanwhile.
const AT_ONCE: usize = 4;
/// Folder of the checkpoints, next to the published objects.
pub(crate) const FOLDER: &str = "checkpoints";

/// The pieces of a checkpoint. Each is generated while earlier pieces are being transferred.
pub type Pieces = Box<dyn Iterator<Item = Bytes> + Send>;

/// A listed checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Checkpoint {
    /// Key of the task; for a model, of its training.
    pub training_key: String,
    /// Number of completed steps.
    pub step: u64,
    /// Size in bytes.
    pub bytes: u64,
    /// Whether it was written completely. Otherwise it is a leftover or still being written.
    pub finished: bool,
    pub(crate) objects: Vec<ObjectMeta>,
}

/// The checkpoints of one task. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Checkpoints {
    store: Arc<dyn ObjectStore>,
    folder: Path,
}

impl Checkpoints {
    /// Returns the checkpoints of the task with this key, next to the objects published at
    /// `prefix`.
    pub(crate) fn new(store: Arc<dyn ObjectStore>, prefix: &Path, key: &str) -> Self {
        let folder = objects::path_of(prefix, &format!("{FOLDER}/{key}"));
        Self { store, folder }
    }

    /// Stores the task's state after `step` steps, create-only, and deletes all older checkpoints
    /// but the newest two up to this step. An intact checkpoint of the same step is left unchanged;
    /// a damaged one is replaced.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    ///
    /// # Panics
    /// If `content` has no piece.
    pub async fn put(&self, step: u64, content: Pieces) -> Result<(), StorageError> {
        if self.read(step).await?.is_none() {
            self.write(step, content).await?;
        }
        let mut there = self.all().await?;
        there.retain(|checkpoint| checkpoint.step <= step);
        let finished = there.iter().rev().filter(|c| c.finished);
        let oldest = finished.take(KEPT).last().map_or(step, |c| c.step);
        for old in there.iter().filter(|c| c.step < oldest) {
            // The head is deleted first, so that an interrupted deletion leaves no seemingly
            // complete checkpoint.
            for object in &old.objects {
                self.remove(&object.location).await?;
            }
        }
        Ok(())
    }

    async fn write(&self, step: u64, mut content: Pieces) -> Result<(), StorageError> {
        let mut first = None;
        let mut sums: Vec<[u8; SHA]> = Vec::new();
        let mut under_way = FuturesUnordered::new();
        loop {
            while under_way.len() >= AT_ONCE {
                under_way.next().await.expect("some are under way")?;
            }
            let made = tokio::task::spawn_blocking(move || {
                let piece = content.next();
                let sum = piece.as_deref().map(sha);
                (piece.zip(sum), content)
            });
            let broken = |e| StorageError::codec("cannot make a checkpoint", e);
            let (piece, rest) = made.await.map_err(broken)?;
            content = rest;
            let Some((piece, sum)) = piece else { break };
            if first.is_none() {
                first = Some(piece);
                continue;
            }
            sums.push(sum);
            let path = self.part(step, sums.len());
            // Existing pieces are damaged or left by an interrupted write.
            under_way.push(async move {
                let put = self.store.put(&path, piece.into()).await;
                put.map_err(|e| self.failed("write", &path, e))
            });
        }
        while under_way.try_next().await?.is_some() {}
        let first = first.expect("a checkpoint has a piece");
        let mut facts = (sums.len() as u32).to_le_bytes().to_vec();
        facts.extend(sums.concat());
        let mut sum = Sha256::new();
        sum.update(&facts);
        sum.update(&first);
        let head = [&MAGIC[..], &sum.finalize(), &facts].concat();
        let payload: PutPayload = [Bytes::from(head), first].into_iter().collect();
        let path = self.head(step);
        let put = |mode| {
            let options = PutOptions::from(mode);
            self.store.put_opts(&path, payload.clone(), options)
        };
        match put(PutMode::Create).await {
            Ok(_) => Ok(()),
            // The object is damaged, or another worker has reached the same step. Either way, one
            // intact checkpoint remains.
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => {
                if self.read(step).await?.is_none() {
                    let replaced = put(PutMode::Overwrite).await;
                    replaced.map_err(|e| self.failed("replace", &path, e))?;
                }
                Ok(())
            }
            Err(e) => Err(self.failed("write", &path, e)),
        }
    }

    /// Returns the step and the pieces of the newest intact checkpoint. Damaged ones are skipped.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn newest(&self) -> Result<Option<(u64, Vec<Bytes>)>, StorageError> {
        let all = self.all().await?;
        for checkpoint in all.iter().rev().filter(|c| c.finished) {
            match self.read(checkpoint.step).await? {
                Some(pieces) => return Ok(Some((checkpoint.step, pieces))),
                // Another worker may have written a newer checkpoint and deleted this one in the
                // meantime.
                None => {
                    let object = self.head(checkpoint.step);
                    tracing::warn!(%object, "a checkpoint is damaged or gone; the one before is used");
                }
            }
        }
        Ok(None)
    }

    /// Returns the pieces of a checkpoint, or `None` if one is damaged or missing.
    pub(crate) async fn read(&self, step: u64) -> Result<Option<Vec<Bytes>>, StorageError> {
        let bytes = objects::get(&*self.store, &self.head(step)).await?;
        let Some((first, sums)) = bytes.and_then(whole) else {
            return Ok(None);
        };
        let parts = sums.into_iter().enumerate().map(|(i, sum)| async move {
            let path = self.part(step, i + 1);
            let Some(bytes) = objects::get(&*self.store, &path).await? else {
                return Ok(None);
            };
            let checked =
                tokio::task::spawn_blocking(move || (sha(&bytes) == sum).then_some(bytes));
            let broken = |e| StorageError::codec("cannot check a checkpoint", e);
            checked.await.map_err(broken)
        });
        let mut parts = stream::iter(parts).buffered(AT_ONCE);
        let mut pieces = vec![first];
        while let Some(part) = parts.next().await {
            match part? {
                Some(part) => pieces.push(part),
                None => return Ok(None),
            }
        }
        Ok(Some(pieces))
    }

    /// Deletes all checkpoints of the task.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn delete(&self) -> Result<(), StorageError> {
        for checkpoint in self.all().await? {
            for object in &checkpoint.objects {
                self.remove(&object.location).await?;
            }
        }
        Ok(())
    }

    pub(crate) fn head(&self, step: u64) -> Path {
        objects::path_of(&self.folder, &format!("{step:012}.ckpt"))
    }

    fn part(&self, step: u64, piece: usize) -> Path {
        objects::path_of(&self.folder, &format!("{step:012}.{piece:04}.part"))
    }

    async fn all(&self) -> Result<Vec<Checkpoint>, StorageError> {
        let listed = self.store.list(Some(&self.folder)).try_collect().await;
        Ok(found(
            listed.map_err(|e| self.failed("list", &self.folder, e))?,
        ))
    }

    async fn remove(&self, path: &Path) -> Result<(), StorageError> {
        match self.store.delete(path).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(self.failed("delete", path, e)),
        }
    }

    fn failed(&self, action: &'static str, path: &Path, error: Error) -> StorageError {
        StorageError::store(action, objects::shown(&*self.store, path), error)
    }
}

/// Returns the checkpoints among the objects, ascending by task and step. The head of each is its
/// first object.
pub(crate) fn found(objects: Vec<ObjectMeta>) -> Vec<Checkpoint> {
    let mut found: BTreeMap<(String, u64), Vec<(bool, ObjectMeta)>> = BTreeMap::new();
    for object in objects {
        if let Some((key, step, head)) = place(&object) {
            found.entry((key, step)).or_default().push((head, object));
        }
    }
    let checkpoint =
        |((training_key, step), mut objects): ((String, u64), Vec<(bool, ObjectMeta)>)| {
            objects.sort_by(|a, b| (!a.0, &a.1.location).cmp(&(!b.0, &b.1.location)));
            Checkpoint {
                training_key,
                step,
                bytes: objects.iter().map(|(_, object)| object.size).sum(),
                finished: objects[0].0,
                objects: objects.into_iter().map(|(_, object)| object).collect(),
            }
        };
    found.into_iter().map(checkpoint).collect()
}

/// Returns the task and step of a checkpoint's object, and whether it is the head.
pub(crate) fn place(object: &ObjectMeta) -> Option<(String, u64, bool)> {
    let parts: Vec<_> = object.location.parts().collect();
    let [.., folder, training_key, file] = &parts[..] else {
        return None;
    };
    let file = file.as_ref();
    let (digits, head) = match file.strip_suffix(".ckpt") {
        Some(digits) => (digits, true),
        None => (file.strip_suffix(PART)?.split_once('.')?.0, false),
    };
    if folder.as_ref() != FOLDER || digits.len() < 12 {
        return None;
    }
    Some((training_key.as_ref().to_owned(), digits.parse().ok()?, head))
}

/// Suffix of the names of all pieces but the first.
pub(crate) const PART: &str = ".part";

fn sha(bytes: &[u8]) -> [u8; SHA] {
    Sha256::digest(bytes).into()
}

/// Returns the first piece of a checkpoint and the checksums of the other pieces, if the head
/// matches its checksum.
fn whole(bytes: Bytes) -> Option<(Bytes, Vec<[u8; SHA]>)> {
    if bytes.len() < HEAD + 4 || bytes[..MAGIC.len()] != *MAGIC {
        return None;
    }
    let stated = &bytes[MAGIC.len()..HEAD];
    if sha(&bytes[HEAD..]) != *stated {
        return None;
    }
    let count = u32::from_le_bytes(bytes[HEAD..HEAD + 4].try_into().ok()?) as usize;
    let first = HEAD + 4 + count.checked_mul(SHA)?;
    let sums = bytes.get(HEAD + 4..first)?.as_chunks::<SHA>().0.to_vec();
    Some((bytes.slice(first..), sums))
}
