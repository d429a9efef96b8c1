//! A set of changes that becomes durable as a whole.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::{
    ids::{JobId, RangeId, WorkerId},
    model::JobState,
};

use crate::record::{Exception, Job, NewEvent, Output, Range, Worker};

/// What one commit writes. For each range, exception and worker only the last word counts.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Changes {
    /// New jobs.
    pub jobs: Vec<Job>,
    /// Jobs whose state changed, with the Unix time of the end in milliseconds.
    pub job_states: BTreeMap<JobId, (JobState, Option<i64>)>,
    /// Ranges as they are now.
    pub ranges: BTreeMap<RangeId, Range>,
    /// Ranges that are no more.
    pub gone: BTreeSet<RangeId>,
    /// New outputs.
    pub outputs: Vec<Output>,
    /// Failed tasks as they are now.
    pub exceptions: BTreeMap<(JobId, u64), Exception>,
    /// Workers as they are now.
    pub workers: BTreeMap<WorkerId, Worker>,
    /// History, in order.
    pub events: Vec<NewEvent>,
}

impl Changes {
    /// Whether there is nothing to write.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Notes a range as it is now.
    pub fn put(&mut self, range: Range) {
        self.gone.remove(&range.id);
        self.ranges.insert(range.id, range);
    }

    /// Notes that a range is no more.
    pub fn remove(&mut self, id: RangeId) {
        self.ranges.remove(&id);
        self.gone.insert(id);
    }

    /// Adds what happened after these changes.
    pub fn append(&mut self, later: Changes) {
        self.jobs.extend(later.jobs);
        self.job_states.extend(later.job_states);
        for id in later.gone {
            self.remove(id);
        }
        for range in later.ranges.into_values() {
            self.put(range);
        }
        self.outputs.extend(later.outputs);
        self.exceptions.extend(later.exceptions);
        self.workers.extend(later.workers);
        self.events.extend(later.events);
    }
}
