//! What the database itself can do: rows of the size of an output, in transactions that are durable.

use std::time::Duration;

use picofarm_coordinator::CatalogPlace;
use serde::Serialize;

use crate::error::{CliError, Code, Result};

/// One raw limit.
#[derive(Debug, Serialize)]
pub struct Raw {
    /// Rows in a transaction.
    pub batch: usize,
    pub rows_per_second: f64,
}

/// Measures with these batch sizes, about a second each.
///
/// # Errors
/// A database that cannot be written.
pub async fn measure(place: &CatalogPlace, batches: &[usize]) -> Result<Vec<Raw>> {
    let mut found = Vec::new();
    for batch in batches.iter().copied() {
        let rows_per_second = place
            .raw_limit(batch, Duration::from_secs(1))
            .await
            .map_err(|e| CliError::new(Code::Resource, e))?;
        found.push(Raw {
            batch,
            rows_per_second,
        });
    }
    Ok(found)
}
