//! Checks the stores of a job before submission: whether they are writable, their identities, and
//! which results they already have. Only workers need access to the stores, so failures are only
//! remarks.

use std::{collections::BTreeSet, time::Duration};

use picofarm_dataset::Dataset;
use picofarm_proto::{
    messages::JobPlan,
    show,
    spec::{JobSpec, StageSpec, kinds::Manifest},
};
use picofarm_store::{StorageError, check_writable, identify_store, open_store, store_identity};

use crate::output::Output;

/// Timeout of a check.
const WITHIN: Duration = Duration::from_secs(8);

/// Warns about each output store of the job that cannot be written from this machine, with the
/// reason.
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

/// Whether stores without an identity receive one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Identity {
    /// Create one in the job's output stores, because the job is submitted.
    Create,
    /// Create none, because the job is only planned.
    Read,
}

/// Records the identities of the stores that this machine reaches in the job, so that its workers
/// use no others.
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
        Ok::<_, StorageError>(identity.map(|identity| identity.to_string()))
    };
    found.await.map_err(|e| e.to_string())
}

/// Number of manifests of a data set that are read to check its settings.
const LOOKED_AT: usize = 8;

/// Counts in a plan the scenes that lie in their store although the coordinator knows nothing of
/// them: workers take over those of exactly these settings. Gives a line for each stage of which
/// only some of the scenes looked at are.
pub async fn there(spec: &JobSpec, plan: &mut JobPlan) -> Vec<String> {
    let stages = spec.stages.iter().zip(&mut plan.stages);
    let asked = stages
        .filter(|(stage, planned)| planned.run > 0 && !stage.force)
        .map(async |(stage, planned)| {
            let found = tokio::time::timeout(WITHIN, scenes_of(stage, planned.total)).await;
            // A store that cannot be read from this machine may be readable by workers.
            let (place, [there, looked, equal]) = found.ok()?.ok()??;
            if there <= planned.reuse || equal == 0 {
                return None;
            }
            let place = show::line(&place).into_owned();
            let total = planned.total;
            if equal < looked {
                let name = show::line(&stage.name);
                return Some(format!(
                    "{name}: {place} holds {there} of {total} scenes, and {equal} of {looked} looked at are of exactly these \
                     settings; the coordinator has no record of them, so workers look at each and take those that fit"
                ));
            }
            planned.taken = (there - planned.reuse).min(planned.run);
            planned.run -= planned.taken;
            if planned.run == 0 {
                // They told why tasks run.
                planned.reasons.clear();
            }
            planned.reasons.push(format!(
                "{place} holds {there} of {total} scenes, of exactly these settings by the {looked} looked at: workers look at \
                 each, and take it over"
            ));
            None
        });
    let found = futures::future::join_all(asked).await;
    plan.taken = plan.stages.iter().map(|stage| stage.taken).sum();
    plan.run = plan.stages.iter().map(|stage| stage.run).sum();
    found.into_iter().flatten().collect()
}

/// Returns the location of a stage's scenes, and three counts: existing scenes, examined scenes,
/// and examined scenes with the stage's settings. `None` if the stage's results are not scenes.
async fn scenes_of(
    stage: &StageSpec,
    total: u64,
) -> Result<Option<(String, [u64; 3])>, StorageError> {
    let results = stage.task.results();
    let Manifest::Scene { dataset } = results.manifest else {
        return Ok(None);
    };
    let (store, prefix) = open_store(results.store)?;
    let dataset = Dataset::open(store, prefix.join(dataset)).await?;
    let mut present = dataset.scenes_present().await?;
    present.retain(|scene| *scene < total);
    let step = present.len().div_ceil(LOOKED_AT).max(1);
    let (mut looked, mut equal) = (0, 0);
    for &scene in present.iter().step_by(step) {
        let manifest = dataset.manifest(scene).await?;
        looked += 1;
        let ours = stage.task.scene_key(scene).map(|key| key.to_string());
        equal += u64::from(ours.is_some_and(|key| key == manifest.provenance.task_key));
    }
    Ok(Some((
        dataset.place(),
        [present.len() as u64, looked, equal],
    )))
}
