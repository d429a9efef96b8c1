//! Restores missing or changed objects from a regenerated copy. Only this code overwrites them.

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::StorageError;
use crate::objects;

/// Restores the missing or changed ones of `objects`, which were regenerated, and the manifest if
/// it is not `readable`. A readable manifest has already proved that they equal the originals.
/// Without one, the remaining objects are the proof, and each must be equal. Returns the keys
/// written.
///
/// # Errors
/// [`StorageError::Damaged`] if nothing proves the original content (then nothing was written), or
/// if the store returns other bytes than those written; [`StorageError::Store`].
pub async fn put_back(
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
                   proves what was there; nothing was written. Delete the scene's manifest and objects to have it made anew"
                .into(),
        });
    }
    broken.extend((!readable).then_some((manifest_path, manifest, true)));
    let mut written = Vec::new();
    for (path, bytes, _) in broken {
        objects::overwrite(store, &path, bytes.clone()).await?;
        if objects::get(store, &path).await?.as_ref() != Some(&bytes) {
            return Err(StorageError::Damaged {
                object: objects::shown(store, &path),
                what: "it was written again, but does not read back as written; check the store"
                    .into(),
            });
        }
        written.push(objects::shown(store, &path));
    }
    Ok(written)
}
