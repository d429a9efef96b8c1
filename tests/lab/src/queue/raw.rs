//! Measures limits of the database itself: a queue with a row per task, and rows of the size of an
//! output, in durable transactions.

use std::time::Duration;

use picofarm_database::CatalogPlace;
use serde::Serialize;

use picofarm_cli::error::{CliError, Code, Result};

use super::limits;

/// One raw limit.
#[derive(Debug, Serialize)]
pub struct Raw {
    /// Rows in a transaction.
    pub batch: usize,
    /// Rate of claimed and completed tasks, with a row per task.
    pub tasks_per_second: f64,
    /// Rate of appended rows.
    pub rows_per_second: f64,
}

/// Measures with these batch sizes, about two seconds each.
///
/// # Errors
/// Fails if the database cannot be written.
pub async fn measure(place: &CatalogPlace, batches: &[usize]) -> Result<Vec<Raw>> {
    let mut found = Vec::new();
    for batch in batches.iter().copied() {
        let time = Duration::from_secs(1);
        let failed =
            |e: sqlx::Error| CliError::new(Code::Resource, format!("catalog {place}: {e}"));
        let tasks_per_second = limits::queue_limit(place, batch, time)
            .await
            .map_err(failed)?;
        let rows_per_second = limits::raw_limit(place, batch, time)
            .await
            .map_err(failed)?;
        found.push(Raw {
            batch,
            tasks_per_second,
            rows_per_second,
        });
    }
    Ok(found)
}
