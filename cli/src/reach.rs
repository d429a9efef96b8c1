//! Whether the stores of a job can be written to, asked before it is sent. Only workers need reach them, so what is found
//! is a warning.

use std::{collections::BTreeSet, time::Duration};

use picofarm_dataset::check_writable;
use picofarm_proto::model::JobSpec;

use crate::output::Output;

/// Longest that a store is waited for.
const WITHIN: Duration = Duration::from_secs(8);

/// Says of each store that the job writes to and that cannot be written to from here, why not.
pub async fn warn_of_stores(spec: &JobSpec, output: Output) {
    let results = spec.stages.iter().map(|stage| stage.task.results());
    let stores: BTreeSet<String> = results.map(|results| results.store.to_owned()).collect();
    let asked = stores.iter().map(async |store| {
        let why = check_writable(store, WITHIN).await.err()?;
        Some(format!(
            "warning: store {store} cannot be written to from this machine: {why}\n  tasks wait until a worker can write \
             to it; nothing is wrong if only workers reach it"
        ))
    });
    for warning in futures::future::join_all(asked).await.into_iter().flatten() {
        output.warn(warning);
    }
}
