//! Explains tasks that wait for other jobs, for a user's quota or for a worker with more time.

use picofarm_catalog::FormerJob;
use picofarm_proto::messages::{JobState, Reason};

use super::{
    facts::JobFacts,
    reason::{n, reason},
};
use crate::core::{Candidate, NotEligible, span};

/// Explains that other jobs must be done first. A job that failed or was cancelled keeps the others
/// waiting, because a retry may still finish it.
pub(super) fn waits_for_jobs(facts: &JobFacts, after: &[FormerJob]) -> Reason {
    let former = after.iter().map(|former| {
        let FormerJob { job, number, state } = former;
        match state {
            JobState::Active | JobState::Done => format!("job {number} ({job}), which is active"),
            JobState::Failed => format!(
                "job {number} ({job}), which failed: `picofarm job retry {number}` runs its dead tasks again"
            ),
            JobState::Cancelled => format!(
                "job {number} ({job}), which was cancelled and will not be done: cancel this job, and submit it with another \
                 `after`"
            ),
        }
    });
    let former: Vec<String> = former.collect();
    let words = format!(
        "{} not begun until other jobs are done (`after`): {}",
        n(facts.counts.pending, "task"),
        former.join("; ")
    );
    reason("after", facts.counts.pending, words)
}

/// Explains the case in which other workers would get tasks if the user might use more cores.
pub(super) fn over_quota(facts: &JobFacts, ready: u64, able: &[&Candidate]) -> Option<Reason> {
    if able.iter().any(|c| c.idle && c.gets && !c.quarantined) {
        return None;
    }
    let mut refused = facts.candidates.iter();
    let why = refused.find_map(|c| match &c.may_run {
        Err(NotEligible::Quota(why)) => Some(why),
        _ => None,
    })?;
    let words = format!(
        "{} wait for the quota of their user: {why}",
        n(ready, "task")
    );
    Some(reason("quota", ready, words))
}

/// Explains tasks of a user whose jobs have published as many bytes as they may.
pub(super) fn over_bytes(ready: u64, why: &str) -> Reason {
    let words = format!(
        "{} wait for the quota of their user: {why}",
        n(ready, "task")
    );
    reason("quota_bytes", ready, words)
}

/// Explains the case in which every able worker ends too early.
pub(super) fn short_of_time(facts: &JobFacts, ready: u64, able: &[&Candidate]) -> Option<Reason> {
    if able.iter().any(|c| c.lacks_time.is_none()) {
        return None;
    }
    let needs = facts.candidates.iter().filter_map(|c| c.lacks_time).min()?;
    let words = format!(
        "no connected worker has {} left for {}: a task is taken to need that long, by those that are done and the attempts that \
         were interrupted; start a worker that may run longer, or divide the scenes (`parts` of a render stage)",
        span(needs),
        n(ready, "task")
    );
    Some(reason("time", ready, words))
}
