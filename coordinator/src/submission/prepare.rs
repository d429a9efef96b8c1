//! Divides a submitted job into the records of the catalog.

use picofarm_catalog::{Job, NewEvent, Range, Run, StageRecord};
use picofarm_proto::{
    ids::{JobId, RangeId},
    messages::{EventKind, JobState},
};
use uuid::Uuid;

use super::draft::Draft;
use crate::core::plan;

/// A job ready to be recorded.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Prepared {
    pub job: Job,
    pub stages: Vec<StageRecord>,
    /// Pending ranges that no instance has claimed.
    pub ranges: Vec<Range>,
    pub events: Vec<NewEvent>,
}

/// Returns whether the latest job with a spec, in this state, is reused for a new submission. It is
/// not if the job ended badly and the caller asks to run it again.
pub(crate) fn reuses_job(state: JobState, again: bool) -> bool {
    !(again && matches!(state, JobState::Failed | JobState::Cancelled))
}

/// Divides a job into ranges, given the existing outputs by stage. An equal job is looked up in
/// `circle`.
pub(crate) fn prepare(
    draft: &Draft,
    user: String,
    circle: &str,
    existing: &[Vec<Run>],
    make_id: &mut dyn FnMut() -> Uuid,
    now_ms: i64,
) -> Prepared {
    let id = JobId::from_uuid(make_id());
    let (job, stages) = draft.job(id, user, circle, now_ms);
    let mut ranges = Vec::new();
    let mut reused = Vec::new();
    let (mut total, mut there) = (0, 0);
    for (stage, existing) in stages.iter().zip(existing) {
        let existing: &[Run] = if stage.force { &[] } else { existing };
        let mut ids = || RangeId::from_uuid(make_id());
        ranges.extend(plan::expand(stage.id, stage.tasks, existing, &mut ids));
        total += stage.tasks;
        there += existing.iter().map(|r| r.hi - r.lo).sum::<u64>();
        reused.extend(existing.iter().map(|run| (stage.id.stage, *run)));
    }
    let message = format!("{total} tasks, {} to run", total - there);
    let mut events = vec![NewEvent::new(id, now_ms, EventKind::Submitted, message)];
    for (stage, run) in reused {
        let message = format!("outputs of tasks {}..{} exist already", run.lo, run.hi);
        let event = NewEvent::new(id, now_ms, EventKind::Reused, message);
        events.push(NewEvent {
            stage: Some(stage),
            tasks: Some(run),
            ..event
        });
    }
    Prepared {
        job,
        stages,
        ranges,
        events,
    }
}
