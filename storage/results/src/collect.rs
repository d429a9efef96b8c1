//! Garbage collection of a data set and of the models next to it.

use std::time::Duration;

use picofarm_dataset::{Collection, Dataset};
use picofarm_store::StorageError;

use crate::models::Models;

/// Does what [`Dataset::collect`] does. Also finds, in the models of the same store, abandoned
/// checkpoints and objects that no manifest lists. Deletes them if `delete` is set.
///
/// # Errors
/// Those of [`Dataset::collect`].
pub async fn collect_garbage(
    dataset: &Dataset,
    grace: Duration,
    delete: bool,
) -> Result<Collection, StorageError> {
    let limit = dataset.age_limit(grace, delete).await?;
    let mut report = dataset.collect_before(limit, grace, delete).await?;
    if let Some(store) = dataset.parent() {
        let models = Models::new(dataset.store().clone(), &store);
        report
            .orphans
            .extend(models.collect(limit, grace, delete).await?);
    }
    report.orphans.sort_by(|a, b| a.object.cmp(&b.object));
    Ok(report)
}
