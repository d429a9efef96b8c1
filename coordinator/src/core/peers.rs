//! The other instances over the same catalog, as of the last news.

use std::collections::BTreeMap;

use picofarm_catalog::Run;
use picofarm_proto::ids::StageRef;

/// What this instance knows of the others.
pub(super) struct Peers {
    instances: u32,
    workers: u32,
    tasks: BTreeMap<StageRef, Vec<Run>>,
}

impl Default for Peers {
    fn default() -> Self {
        Self {
            instances: 1,
            workers: 0,
            tasks: BTreeMap::new(),
        }
    }
}

impl Peers {
    /// Records the number of live instances and of the others' workers, and the tasks that those
    /// run.
    pub(super) fn record(
        &mut self,
        instances: u32,
        workers: u32,
        tasks: BTreeMap<StageRef, Vec<Run>>,
    ) {
        self.instances = instances.max(1);
        self.workers = workers;
        self.tasks = tasks;
    }

    /// Returns the number of live instances, including this one.
    pub(super) fn instances(&self) -> u32 {
        self.instances
    }

    /// Returns the number of workers connected to other instances.
    pub(super) fn workers(&self) -> u32 {
        self.workers
    }

    /// Returns the tasks of a stage that other instances' workers run, if it shares its outputs.
    pub(super) fn tasks(&self, stage: &StageRef) -> &[Run] {
        self.tasks.get(stage).map_or(&[], Vec::as_slice)
    }
}
