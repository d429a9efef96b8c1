//! Restores missing or changed objects of a published result from regenerated ones.

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;

use super::{Manifest, Published};
use crate::error::StorageError;
use crate::objects;
use crate::sealed::sha256_hex;

impl<M: Manifest> Published<M> {
    /// Publishes a regenerated result, or restores the missing or changed objects of a published
    /// one. The existing manifest proves that the regenerated objects equal the originals. If the
    /// manifest itself is broken, the remaining objects are the proof, and each must be equal.
    /// Returns the objects overwritten, and the manifest, if it was.
    ///
    /// # Errors
    /// [`Manifest::taken`] if the result belongs to another task. [`StorageError::Diverged`] if the
    /// regenerated result differs from the manifest, and [`StorageError::Damaged`] if nothing
    /// proves the original content; in both cases nothing was written. [`StorageError::Store`].
    pub async fn restore(
        &self,
        id: &M::Id,
        ours: &M,
        bytes: &[Bytes],
    ) -> Result<Vec<String>, StorageError> {
        let path = self.manifest_path(id);
        let Some(stored) = objects::get(&*self.store, &path).await? else {
            self.publish(id, ours, bytes).await?;
            return Ok(Vec::new());
        };
        let theirs = M::parse(&stored, id, &self.shown(&path)).ok();
        let our_bytes = ours.to_bytes();
        if let Some(theirs) = &theirs {
            self.check_owner(id, theirs, ours.task_key())?;
            if stored != our_bytes {
                return Err(StorageError::Diverged {
                    object: self.shown(&path),
                    expected: sha256_hex(&stored),
                    ours: sha256_hex(&our_bytes),
                });
            }
        }
        let objects = self.with_paths(id, ours, bytes);
        let manifest = (path, Bytes::from(our_bytes));
        overwrite_broken(&*self.store, manifest, theirs.is_some(), &objects).await
    }
}

/// Restores the missing or changed ones of `objects`, which were regenerated, and the manifest if
/// it is not `readable`. A readable manifest has already proved that they equal the originals.
/// Without one, the remaining objects are the proof, and each must be equal. Returns the keys
/// written.
///
/// # Errors
/// [`StorageError::Damaged`] if nothing proves the original content (then nothing was written), or
/// if the store returns other bytes than those written; [`StorageError::Store`].
async fn overwrite_broken(
    store: &dyn ObjectStore,
    (manifest_path, manifest): (Path, Bytes),
    readable: bool,
    objects: &[(Path, Bytes)],
) -> Result<Vec<String>, StorageError> {
    let (mut broken, mut equal) = (Vec::new(), 0);
    for (path, bytes) in objects {
        match objects::get(store, path).await? {
            Some(there) if there == *bytes => equal += 1,
            there => broken.push((path.clone(), bytes.clone(), there.is_some())),
        }
    }
    if !readable && (equal == 0 || broken.iter().any(|(_, _, there)| *there)) {
        return Err(StorageError::Damaged {
            object: objects::shown(store, &manifest_path),
            what: "it cannot be read, and the objects that are left are not all equal to what is made now, so that nothing \
                   proves what was there; nothing was written. Delete its manifest and objects to have it made anew"
                .into(),
        });
    }
    broken.extend((!readable).then_some((manifest_path, manifest, true)));
    let mut written = Vec::new();
    for (path, bytes, _) in broken {
        objects::replace(store, &path, bytes).await?;
        written.push(objects::shown(store, &path));
    }
    Ok(written)
}
