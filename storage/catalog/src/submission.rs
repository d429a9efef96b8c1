//! A job as it is recorded, and recorded outputs as a store is asked about them.

use crate::{Job, NewEvent, OwnedPlace, Range, RangeState, ResultSet, Run, StageRecord};
use picofarm_proto::ids::JobId;

/// What becomes durable when a job is submitted.
#[derive(Debug, Clone, Copy)]
pub struct Submission<'a> {
    /// The job.
    pub job: &'a Job,
    /// Its stages, as [`Job::stages`] gives them: hashing a large spec takes seconds, and must not happen in a transaction.
    pub stages: &'a [StageRecord],
    /// How it is laid out: ranges that are nobody's. Each output of a range that is done must be recorded as checked.
    pub ranges: &'a [Range],
    /// The first lines of its history.
    pub events: &'a [NewEvent],
    /// Outputs that are recorded and that the store does not hold: the records go.
    pub gone: &'a [Gone],
    /// A job with the same spec that is done and whose results are gone: this one takes its place.
    pub instead_of: Option<JobId>,
    /// The places that the job writes into and that become its submitter's.
    pub places: &'a [OwnedPlace],
    /// Normal forms of others' places near those, which the submitter may write into.
    pub permitted: &'a [String],
}

impl<'a> Submission<'a> {
    /// A job that replaces nothing.
    pub fn new(
        job: &'a Job,
        stages: &'a [StageRecord],
        ranges: &'a [Range],
        events: &'a [NewEvent],
    ) -> Self {
        Self {
            job,
            stages,
            ranges,
            events,
            gone: &[],
            instead_of: None,
            places: &[],
            permitted: &[],
        }
    }

    /// The tasks that are laid out as done, by result set.
    pub fn done(&self) -> Vec<(&'a ResultSet, Run)> {
        let done = self
            .ranges
            .iter()
            .filter(|range| matches!(range.state, RangeState::Done { .. }));
        done.filter_map(|range| {
            let stage = self.stages.iter().find(|s| s.id == range.stage)?;
            let run = Run {
                lo: range.lo,
                hi: range.hi,
            };
            Some((&stage.set, run))
        })
        .collect()
    }
}

/// What came of a submission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The job is recorded.
    New,
    /// A job with the same spec is active or done; nothing is recorded.
    Exists,
    /// An output that the layout counts on is no longer recorded as checked, or a place has become another's; nothing is
    /// recorded. Plan again.
    Changed,
}

/// An output that is recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Recorded {
    /// Task index.
    pub task: u64,
    /// SHA-256 of the manifest, as a worker reported it.
    pub manifest: [u8; 32],
    /// The store was found to hold this manifest.
    pub checked: bool,
}

/// A recorded output that is not in the store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gone {
    /// Whose result it is.
    pub set: ResultSet,
    /// Task index.
    pub task: u64,
    /// The manifest that was looked for: a record of another one stays.
    pub manifest: [u8; 32],
}
