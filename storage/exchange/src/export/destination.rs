//! Checks the destination of an export before anything is written.

use object_store::ObjectStore;
use object_store::path::Path;

use super::{ExportFormat, card, packed};
use picofarm_dataset::{Dataset, METADATA, Quantity};
use picofarm_store::{StorageError, folder, objects};

/// Checks that the destination is empty, or has an export in this format, finished or interrupted.
/// Other files are accepted only next to a finished export.
///
/// # Errors
/// [`StorageError::Invalid`] names a file of another format or of other data;
/// [`StorageError::Store`].
pub(super) async fn check(
    format: ExportFormat,
    source: &Dataset,
    store: &dyn ObjectStore,
    prefix: &Path,
) -> Result<(), StorageError> {
    let names = folder::names(store, prefix).await?;
    let has = |wanted: &str| names.iter().any(|name| name == wanted);
    // Exports write the group's metadata after the array of source scenes, which data sets lack.
    if has(METADATA) && !has(packed::SOURCE_SCENE) {
        return Err(folder::foreign(store, prefix, "export.dest", METADATA));
    }
    let own = |name: &&String| writes(format, source, name);
    let mut strange = names.iter().filter(|name| !own(name));
    let of_another = strange
        .clone()
        .find_map(|name| Some((name, other_format(name)?)));
    if let Some((name, other)) = of_another {
        let what = format!(
            "{} has an export in the format {:?} in it ({name:?} is a part of it), and this one is in {:?}; choose \
             another folder, or export in that format",
            objects::shown(store, prefix),
            other.name(),
            format.name(),
        );
        return Err(StorageError::invalid("export.dest", what));
    }
    if has(card::CROISSANT) {
        return Ok(());
    }
    match strange.next() {
        None => Ok(()),
        Some(name) => Err(folder::foreign(store, prefix, "export.dest", name)),
    }
}

/// Returns whether an export in this format writes such a name directly below its folder.
fn writes(format: ExportFormat, source: &Dataset, name: &str) -> bool {
    match format {
        _ if name == card::TABLE => true,
        ExportFormat::Zarr => packed::writes(source, name),
        _ => is_of(format, name),
    }
}

/// Returns the format whose exports alone have such a name.
fn other_format(name: &str) -> Option<ExportFormat> {
    ExportFormat::ALL
        .into_iter()
        .find(|format| is_of(*format, name))
}

/// Returns whether an export of any data set in this format has such a name, and no export in
/// another format has it.
fn is_of(format: ExportFormat, name: &str) -> bool {
    let number = |text: &str| text.len() >= 6 && text.bytes().all(|b| b.is_ascii_digit());
    match format {
        ExportFormat::Zarr => {
            packed::METADATA_NAMES.contains(&name)
                || Quantity::ALL.iter().any(|quantity| quantity.name() == name)
        }
        ExportFormat::Sb3d => number(name),
        ExportFormat::Hdf5 => name.strip_suffix(".h5").is_some_and(number),
        ExportFormat::WebDataset => name
            .strip_prefix("scenes-")
            .and_then(|rest| rest.strip_suffix(".tar"))
            .is_some_and(number),
    }
}
