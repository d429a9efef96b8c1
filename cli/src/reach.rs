//! What is asked of a job's stores before it is sent: whether they can be written to, and their identities. Only workers
//! need reach them, so what is found is a warning.

use std::{collections::BTreeSet, time::Duration};

use picofarm_dataset::{DatasetError, check_writable, identify_store, open_store, store_identity};
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

/// Whether stores without an identity are given one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Identity {
    /// Those that the job writes to are: it is submitted.
    Create,
    /// None is: the job is only planned.
    Read,
}

/// Records the identities of the stores that this machine reaches in the job, so that its workers use no others.
pub async fn identify(spec: &mut JobSpec, identity: Identity, output: Output) {
    let written = spec.stages.iter().map(|stage| stage.task.results().store);
    let written: BTreeSet<String> = written
        .map(|s| s.trim_end_matches('/').to_owned())
        .collect();
    let places = spec.stages.iter().flat_map(|stage| stage.places());
    let places: BTreeSet<String> = places.map(str::to_owned).collect();
    let asked = places.into_iter().map(async |place| {
        let create = identity == Identity::Create && written.contains(&place);
        let found = tokio::time::timeout(WITHIN, identity_of(&place, create)).await;
        let found = found
            .unwrap_or_else(|_| Err(format!("it did not answer within {} s", WITHIN.as_secs())));
        (place, found)
    });
    for (place, found) in futures::future::join_all(asked).await {
        match found {
            Ok(None) => {}
            Ok(Some(identity)) => {
                for stage in &mut spec.stages {
                    if stage.places().contains(&*place) {
                        let known = stage.stores.entry(place.clone());
                        known.or_insert_with(|| identity.clone());
                    }
                }
            }
            Err(why) => output.warn(format!(
                "warning: the identity of store {place} is not known: {why}\n  no worker is refused whose store is another \
                 one (a folder that is not mounted); submit from a machine that reaches it to have them checked"
            )),
        }
    }
}

async fn identity_of(place: &str, create: bool) -> Result<Option<String>, String> {
    let found = async {
        let (store, prefix) = open_store(place)?;
        let identity = match create {
            true => Some(identify_store(&*store, &prefix).await?),
            false => store_identity(&*store, &prefix).await?,
        };
        Ok::<_, DatasetError>(identity.map(|identity| identity.to_string()))
    };
    found.await.map_err(|e| e.to_string())
}
