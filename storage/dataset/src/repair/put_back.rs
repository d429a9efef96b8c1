//! Putting back objects that are missing or changed, from the same made again: the only path on which they are overwritten.

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::DatasetError;
use crate::store::objects;

/// Puts back what is missing or changed of `objects`, which were made again, and the manifest where it is not `readable`.
/// A readable manifest has proved already that they are what was there; where it is broken itself, the objects that are left
/// do, each of which must be equal. Gives what was written.
///
/// # Errors
/// [`DatasetError::Damaged`] where nothing proves what was there (nothing was written then), or where the store does not give
/// back what was written; [`DatasetError::Store`].
pub(crate) async fn put_back(
    store: &dyn ObjectStore,
    (manifest_path, manifest): (Path, Bytes),
    readable: bool,
    objects: &[(Path, Bytes)],
) -> Result<Vec<String>, DatasetError> {
    let (mut broken, mut equal) = (Vec::new(), 0);
    for (path, bytes) in objects {
        match objects::get(store, path).await? {
            Some(there) if there == *bytes => equal += 1,
            there => broken.push((path.clone(), bytes.clone(), there.is_some())),
        }
    }
    if !readable && (equal == 0 || broken.iter().any(|(_, _, there)| *there)) {
        return Err(DatasetError::Damaged {
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
            return Err(DatasetError::Damaged {
                object: objects::shown(store, &path),
                what: "it was written again, but does not read back as written; check the store"
                    .into(),
            });
        }
        written.push(objects::shown(store, &path));
    }
    Ok(written)
}
