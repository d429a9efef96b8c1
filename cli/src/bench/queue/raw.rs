//! What the database itself can do: a queue with a row a task, and rows of the size of an output, in transactions that
//! are durable.

use std::time::Duration;

use picofarm_coordinator::CatalogPlace;
use serde::Serialize;

use crate::error::{CliError, Code, Result};

/// One raw limit.
#[derive(Debug, Serialize)]
pub struct Raw {
    /// Rows in a transaction.
    pub batch: usize,
    /// Claimed and completed, where each task is a row.
    pub tasks_per_second: f64,
    /// Only appended.
    pub rows_per_second: f64,
}

/// Measures with these batch sizes, about two seconds each.
///
/// # Errors
/// A database that cannot be written.
pub async fn measure(place: &CatalogPlace, batches: &[usize]) -> Result<Vec<Raw>> {
    let mut found = Vec::new();
    for batch in batches.iter().copied() {
        let (time, failed) = (Duration::from_secs(1), |e| CliError::new(Code::Resource, e));
        let tasks_per_second = place.queue_limit(batch, time).await.map_err(failed)?;
        let rows_per_second = place.raw_limit(batch, time).await.map_err(failed)?;
        found.push(Raw {
            batch,
            tasks_per_second,
            rows_per_second,
        });
    }
    Ok(found)
}
