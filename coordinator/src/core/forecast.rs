//! Forecasts when the open stages of a job will be done.

use std::collections::BTreeMap;

use picofarm_proto::ids::JobId;

use super::{stage_entry::StageEntry, state::Core};

impl Core {
    /// Returns the seconds until the open stages of each job are done, if its workers stay and its
    /// tasks take as long as before. A job has none if nobody works on it, or if no task of such a
    /// stage was ever measured. Tasks claimed by other instances are not counted.
    pub(crate) fn forecasts(&self) -> BTreeMap<JobId, u64> {
        let mut seconds: BTreeMap<JobId, Option<f64>> = BTreeMap::new();
        for (id, entry) in self.stages.iter() {
            let sum = seconds.entry(id.job).or_insert(Some(0.0));
            *sum = sum.zip(self.work_left(entry)).map(|(sum, more)| sum + more);
        }
        let known = seconds.into_iter().filter_map(|(job, work)| {
            let workers = self.load.workers_of_job(job);
            let left = work? / workers as f64;
            (workers > 0).then_some((job, left.ceil() as u64))
        });
        known.collect()
    }

    /// Returns the seconds that one worker needs for the unfinished tasks of a stage, if known.
    fn work_left(&self, entry: &StageEntry) -> Option<f64> {
        let free = entry.free()?;
        let held = entry.held.pending_tasks() + entry.held.leased_tasks();
        match held + free.ready + free.suspects + free.later {
            0 => Some(0.0),
            tasks => Some(tasks as f64 * self.stages.mean_seconds(entry)?),
        }
    }
}
