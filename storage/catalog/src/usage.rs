//! The usage of a farm by users and projects. A commit adds it to sums of their own, so that it is
//! counted once, for the job that did the work, and outlives deleted jobs.

use std::collections::BTreeMap;

use picofarm_proto::{
    ids::JobId,
    messages::{Usage, UsageBy},
};

use crate::{Catalog, CatalogError, Sight};

/// New usage by day (since 1970-01-01, UTC) and job.
pub type NewUsage = BTreeMap<(i64, JobId), Usage>;

/// Milliseconds of a day.
const DAY_MS: i64 = 86_400_000;

/// Returns the day of a Unix time in milliseconds, counted from 1970-01-01 in UTC.
pub fn day_of(at_ms: i64) -> i64 {
    at_ms.div_euclid(DAY_MS)
}

/// A query of the usage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsageQuery {
    /// What it is summed by.
    pub by: UsageBy,
    /// The first day.
    pub since_day: i64,
    /// The day after the last one.
    pub until_day: i64,
    /// Only usage of jobs that this reader may see.
    pub sight: Sight,
}

/// Returns the bytes that each user's jobs have published, of the jobs that the reader may see.
///
/// # Errors
/// Returns a [`CatalogError`] if the catalog fails.
pub async fn published(
    catalog: &dyn Catalog,
    sight: Sight,
) -> Result<BTreeMap<String, u64>, CatalogError> {
    let query = UsageQuery {
        by: UsageBy::User,
        since_day: i64::MIN,
        until_day: i64::MAX,
        sight,
    };
    let rows = catalog.usage(&query).await?.into_iter();
    Ok(rows.map(|row| (row.name, row.usage.bytes)).collect())
}
