//! Operations on many jobs: pages of the job list, and deletion of old jobs.

use picofarm_proto::messages::{JobState, JobSummary};

use crate::Sight;

/// A query of the job list.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct JobQuery {
    /// The jobs that the reader may see.
    pub sight: Sight,
    /// Only jobs recorded before this position, which is [`Page::next`] of another page.
    pub before: Option<i64>,
    /// The maximum number of jobs.
    pub limit: u32,
    /// Only jobs in this state.
    pub state: Option<JobState>,
    /// Only jobs of this user.
    pub user: Option<String>,
    /// Only jobs with this name or number, or with an id that begins with this text. A text of at
    /// most nine digits is a number, and neither a name nor the beginning of an id.
    pub find: Option<String>,
}

/// A page of the job list.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Page {
    /// The jobs, newest first.
    pub jobs: Vec<JobSummary>,
    /// The position of the next page; `None` on the last page.
    pub next: Option<i64>,
}

/// The result of one transaction that deletes old records.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Forgotten {
    /// Number of deleted jobs.
    pub jobs: u32,
    /// Whether there may be more to delete.
    pub more: bool,
}
