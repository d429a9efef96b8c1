//! The stages of active jobs, and the sets of outputs that they write to.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    ops::Index,
};

use picofarm_catalog::{Job, ResultSet, StageRecord, Timing};
use picofarm_proto::{
    ids::{JobId, StageRef},
    key::StageKey,
};

use super::stage_entry::{SetId, StageEntry};

/// A set of outputs shared by stages of one or several jobs.
struct SetEntry {
    key: StageKey,
    timing: Timing,
    /// Stages of active jobs that write to this set.
    stages: BTreeSet<StageRef>,
}

/// The stages of active jobs. Job ids grow with time, so their order is that of submission.
#[derive(Default)]
pub(super) struct Stages {
    entries: BTreeMap<StageRef, StageEntry>,
    sets: Vec<SetEntry>,
    set_ids: HashMap<ResultSet, SetId>,
}

impl Stages {
    /// Adds the stages of a job. `timings` contains the known timing of each of its result sets.
    pub(super) fn add_job(
        &mut self,
        job: &Job,
        stages: Vec<StageRecord>,
        timings: &HashMap<ResultSet, Timing>,
    ) {
        for record in stages {
            let next = SetId(self.sets.len());
            let set = *self.set_ids.entry(record.set.clone()).or_insert(next);
            if set == next {
                self.sets.push(SetEntry {
                    key: record.set.stage_key,
                    timing: timings.get(&record.set).copied().unwrap_or_default(),
                    stages: BTreeSet::new(),
                });
            }
            self.sets[set.0].stages.insert(record.id);
            let entry = StageEntry::new(job, &record, set);
            self.entries.insert(record.id, entry);
        }
    }

    /// Removes a stage.
    pub(super) fn remove(&mut self, id: StageRef) -> Option<StageEntry> {
        let entry = self.entries.remove(&id)?;
        self.sets[entry.set().0].stages.remove(&id);
        Some(entry)
    }

    /// Removes the stages of a job.
    pub(super) fn remove_job(&mut self, job: JobId) {
        for id in self.ids_of(job) {
            self.remove(id);
        }
    }

    /// Returns whether a job is active.
    pub(super) fn contains_job(&self, job: JobId) -> bool {
        self.entries.contains_key(&StageRef { job, stage: 0 })
    }

    /// Returns the stages of a job.
    pub(super) fn ids_of(&self, job: JobId) -> Vec<StageRef> {
        let ids = self.entries.keys().copied();
        ids.filter(|id| id.job == job).collect()
    }

    pub(super) fn get(&self, id: &StageRef) -> Option<&StageEntry> {
        self.entries.get(id)
    }

    pub(super) fn get_mut(&mut self, id: &StageRef) -> Option<&mut StageEntry> {
        self.entries.get_mut(id)
    }

    pub(super) fn keys(&self) -> impl Iterator<Item = &StageRef> {
        self.entries.keys()
    }

    pub(super) fn values(&self) -> impl Iterator<Item = &StageEntry> {
        self.entries.values()
    }

    pub(super) fn values_mut(&mut self) -> impl Iterator<Item = &mut StageEntry> {
        self.entries.values_mut()
    }

    pub(super) fn iter(&self) -> impl DoubleEndedIterator<Item = (&StageRef, &StageEntry)> {
        self.entries.iter()
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = (&StageRef, &mut StageEntry)> {
        self.entries.iter_mut()
    }

    /// Returns the key of the stage's outputs.
    pub(super) fn key_of(&self, entry: &StageEntry) -> &StageKey {
        &self.sets[entry.set().0].key
    }

    /// Returns the mean duration of the stage's tasks, seconds, if any was measured.
    pub(super) fn mean_seconds(&self, entry: &StageEntry) -> Option<f64> {
        self.sets[entry.set().0].timing.mean()
    }

    /// Adds a computed task to the timing of its set.
    pub(super) fn add_time(&mut self, set: SetId, seconds: f64, bytes: u64) {
        let timing = &mut self.sets[set.0].timing;
        timing.tasks += 1;
        timing.seconds += seconds;
        timing.bytes += bytes as f64;
    }

    /// Returns the stages of active jobs that write to the same set, with this one.
    pub(super) fn sharing(&self, entry: &StageEntry) -> &BTreeSet<StageRef> {
        &self.sets[entry.set().0].stages
    }

    /// Returns the stages that share each set.
    #[cfg(test)]
    pub(super) fn sets(&self) -> impl Iterator<Item = &BTreeSet<StageRef>> {
        self.sets.iter().map(|set| &set.stages)
    }
}

impl Index<&StageRef> for Stages {
    type Output = StageEntry;

    fn index(&self, id: &StageRef) -> &StageEntry {
        &self.entries[id]
    }
}
