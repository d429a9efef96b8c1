//! Many jobs at a time: a page of the list of them, and what is forgotten.

use picofarm_proto::model::{JobState, JobSummary};

use crate::Sight;

/// Which jobs of the list.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct JobQuery {
    /// Whose.
    pub sight: Sight,
    /// Only those recorded before the last of another page ([`Page::next`]).
    pub before: Option<i64>,
    /// At most this many.
    pub limit: u32,
    /// Only those that stand so.
    pub state: Option<JobState>,
    /// Only this user's.
    pub user: Option<String>,
    /// Only those of this name, or whose id begins so.
    pub find: Option<String>,
}

/// Part of the list.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Page {
    /// The last recorded first.
    pub jobs: Vec<JobSummary>,
    /// Where the next page begins; `None` where this is the last.
    pub next: Option<i64>,
}

/// What one transaction of forgetting did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Forgotten {
    /// Jobs that are gone.
    pub jobs: u32,
    /// There may be more to forget.
    pub more: bool,
}
