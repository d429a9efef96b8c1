//! Submissions of jobs, and the comparison of recorded outputs with a store.

use crate::{Job, NewEvent, OwnedPlace, Range, RangeState, ResultSet, Run, StageRecord};
use picofarm_proto::ids::JobId;

/// The data that is committed when a job is submitted.
#[derive(Debug, Clone, Copy)]
pub struct Submission<'a> {
    /// The job.
    pub job: &'a Job,
    /// The job's stages, from [`Job::stages`]. They are computed before the transaction, because
    /// hashing a large spec takes seconds.
    pub stages: &'a [StageRecord],
    /// The job's initial ranges, all unowned. Each output of a done range must be recorded as
    /// checked.
    pub ranges: &'a [Range],
    /// The first events of the job's history.
    pub events: &'a [NewEvent],
    /// Recorded outputs that the store does not have; their records are deleted.
    pub gone: &'a [Gone],
    /// The jobs that must be done before this one begins.
    pub after: &'a [JobId],
    /// A done job with the same spec and lost results, which this job replaces.
    pub instead_of: Option<JobId>,
    /// The places that the job writes into and that its submitter will own.
    pub places: &'a [OwnedPlace],
    /// Normal forms of overlapping places of other owners, which the submitter may write into.
    pub permitted: &'a [String],
}

impl<'a> Submission<'a> {
    /// Returns a submission that replaces no job.
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
            after: &[],
            instead_of: None,
            places: &[],
            permitted: &[],
        }
    }

    /// Returns the tasks laid out as done, by result set.
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

/// The outcome of a submission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The job is recorded.
    New,
    /// A job with the same spec is active or done; nothing was recorded.
    Exists,
    /// An output of a done range is no longer recorded as checked, or another user now owns a
    /// place; nothing was recorded. The caller must plan again.
    Changed,
}

/// A recorded output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Recorded {
    /// Task index.
    pub task: u64,
    /// SHA-256 of the manifest, as reported by a worker.
    pub manifest: [u8; 32],
    /// Whether the store is known to have this manifest.
    pub checked: bool,
}

/// A recorded output that is not in the store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gone {
    /// The result set of the output.
    pub set: ResultSet,
    /// Task index.
    pub task: u64,
    /// The missing manifest; a record with another manifest is left unchanged.
    pub manifest: [u8; 32],
}
