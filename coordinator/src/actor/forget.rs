//! Forgets jobs that ended long ago. It uses short transactions with rests between them, so that
//! other writers wait for at most one of them.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use picofarm_catalog::Catalog;
use tokio_util::sync::CancellationToken;

use crate::core::Clock;

/// Interval between searches for jobs to forget.
const AGAIN: Duration = Duration::from_secs(600);
/// Interval if the catalog could not be read, for example before its first life has begun.
const SOON: Duration = Duration::from_secs(2);
/// Shortest rest between two transactions.
const REST: Duration = Duration::from_millis(2);

/// Forgets jobs that ended longer ago than `age`, until `stop`.
pub(crate) async fn run(
    catalog: Arc<dyn Catalog>,
    clock: Clock,
    age: Duration,
    stop: CancellationToken,
) {
    loop {
        let wait = match all(catalog.as_ref(), &clock, age, &stop).await {
            Ok(()) => AGAIN,
            Err(error) => {
                tracing::debug!(%error, "jobs to forget cannot be looked for now");
                SOON
            }
        };
        tokio::select! {
            () = tokio::time::sleep(wait) => {}
            () = stop.cancelled() => return,
        }
    }
}

async fn all(
    catalog: &dyn Catalog,
    clock: &Clock,
    age: Duration,
    stop: &CancellationToken,
) -> Result<(), picofarm_catalog::CatalogError> {
    let before_ms = clock.now_ms() - i64::try_from(age.as_millis()).unwrap_or(i64::MAX);
    let mut jobs = 0u64;
    while !stop.is_cancelled() {
        let began = Instant::now();
        let forgotten = catalog.forget(before_ms).await?;
        jobs += u64::from(forgotten.jobs);
        if !forgotten.more {
            break;
        }
        // The rest is as long as the transaction, so that others have at least half of the time.
        tokio::time::sleep(began.elapsed().max(REST)).await;
    }
    if jobs > 0 {
        tracing::info!(
            jobs,
            "jobs that ended long ago are forgotten; what they made stays in its store"
        );
    }
    Ok(())
}
