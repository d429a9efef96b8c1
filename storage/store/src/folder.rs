//! Checks whether the output folder of a task is empty or contains only the task's own files.

use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::StorageError;
use crate::objects::shown;

/// Returns the names directly below `prefix`, without hidden ones.
pub async fn names(store: &dyn ObjectStore, prefix: &Path) -> Result<Vec<String>, StorageError> {
    let listed = store.list_with_delimiter(Some(prefix)).await;
    let listed = listed.map_err(|e| StorageError::store("list", shown(store, prefix), e))?;
    let objects = listed.objects.iter().map(|object| &object.location);
    let names = objects.chain(&listed.common_prefixes);
    let names = names.filter_map(|path| path.filename().map(str::to_owned));
    Ok(names.filter(|name| !name.starts_with('.')).collect())
}

/// Checks that everything directly below `prefix` has a name that the task itself uses, so that it
/// does not write into other data. Hidden names are ignored.
///
/// # Errors
/// [`StorageError::Invalid`] at `field` that names a foreign entry; [`StorageError::Store`].
pub async fn check_own_folder(
    store: &dyn ObjectStore,
    prefix: &Path,
    field: &str,
    is_own: impl Fn(&str) -> bool,
) -> Result<(), StorageError> {
    match names(store, prefix)
        .await?
        .iter()
        .find(|name| !is_own(name))
    {
        None => Ok(()),
        Some(name) => Err(foreign(store, prefix, field, name)),
    }
}

/// Returns the error for a folder with an entry that the task does not write.
pub fn foreign(store: &dyn ObjectStore, prefix: &Path, field: &str, name: &str) -> StorageError {
    StorageError::invalid(
        field,
        format!(
            "{} has {name:?} in it, which is not of this kind; expected a new or empty folder, or one that the same kind of \
             job has begun; choose another folder",
            shown(store, prefix)
        ),
    )
}
