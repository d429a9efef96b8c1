//! Remembers whether this coordinator sees the stores that its workers write to.

use std::{
    collections::{BTreeSet, HashMap},
    sync::{Arc, Mutex},
};

use picofarm_catalog::Recorded;
use picofarm_proto::{
    ids::{StageRef, WorkerId},
    spec::JobSpec,
};

/// Most stores remembered.
const STORES: usize = 1_024;

/// Evidence of whether this coordinator sees the stores of its workers, by store.
#[derive(Debug, Default)]
pub(super) struct Evidence(Mutex<HashMap<String, StoreEvidence>>);

/// This coordinator's evidence about a store.
#[derive(Debug, Default)]
pub(super) struct StoreEvidence {
    /// A result that was found in the store.
    pub(super) witness: Option<(Arc<JobSpec>, StageRef, Recorded)>,
    /// Workers with missing results, before the first result was found.
    pub(super) doubted: BTreeSet<WorkerId>,
}

impl Evidence {
    /// Returns why the store's content is no evidence: none of the workers' results were found.
    pub(super) fn sees_another_disk(&self, store: &str) -> Option<String> {
        let blind = self.with(store, |seen| {
            seen.witness.is_none() && seen.doubted.len() >= 2
        });
        blind.then(|| {
            "the coordinator finds none of what workers report there, and may see another disk (mount the store there, or \
             start it with --check-stores none)"
                .to_owned()
        })
    }

    /// Reads or changes the evidence about one store.
    pub(super) fn with<T>(&self, store: &str, change: impl FnOnce(&mut StoreEvidence) -> T) -> T {
        let mut evidence = self.0.lock().expect("no panic while locked");
        if evidence.len() > STORES {
            evidence.clear();
        }
        change(evidence.entry(store.to_owned()).or_default())
    }
}
