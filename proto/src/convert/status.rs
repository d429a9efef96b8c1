//! What people are told, on the wire.

use super::{ConvertError, parse, required};
use crate::{
    model::{Event, EventKind, JobPlan, JobState, JobStatus, RunningTask, TaskCounts},
    wire,
};

/// Pairs of model and wire variants, converted both ways; the wire's zero is an error.
macro_rules! enum_pairs {
    ($model:ident, $wire:path, $field:literal, [$($v:ident),* $(,)?]) => {
        impl From<$model> for $wire {
            fn from(m: $model) -> Self {
                match m { $($model::$v => <$wire>::$v),* }
            }
        }
        impl TryFrom<$wire> for $model {
            type Error = ConvertError;
            fn try_from(w: $wire) -> Result<Self, ConvertError> {
                match w {
                    $(<$wire>::$v => Ok($model::$v),)*
                    <$wire>::Unspecified => Err(ConvertError::Missing { field: $field }),
                }
            }
        }
    };
}

enum_pairs!(
    JobState,
    wire::JobState,
    "job.state",
    [Active, Done, Failed, Cancelled]
);
enum_pairs!(
    EventKind,
    wire::EventKind,
    "event.kind",
    [
        Submitted, Leased, Committed, Reused, Failed, Dead, Expired, Released, Cancelled, Retried,
        Ended, Waiting, Alarm,
    ]
);

impl From<JobStatus> for wire::JobStatus {
    fn from(m: JobStatus) -> Self {
        wire::JobStatus {
            id: m.id.to_string(),
            name: m.name,
            state: wire::JobState::from(m.state).into(),
            tasks: Some(wire::TaskCounts {
                total: m.tasks.total,
                done: m.tasks.done,
                reused: m.tasks.reused,
                leased: m.tasks.leased,
                pending: m.tasks.pending,
                dead: m.tasks.dead,
            }),
            submitted_at_ms: m.submitted_at_ms,
            ended_at_ms: m.ended_at_ms.unwrap_or(0),
            spec: Some(m.spec.into()),
            mean_task_seconds: m.mean_task_seconds.unwrap_or(0.0),
            running: m
                .running
                .into_iter()
                .map(|r| wire::RunningTask {
                    index: r.index,
                    worker: r.worker,
                    fraction: r.fraction,
                    seconds: r.seconds,
                })
                .collect(),
            workers: m.workers,
        }
    }
}

impl TryFrom<wire::JobStatus> for JobStatus {
    type Error = ConvertError;

    fn try_from(w: wire::JobStatus) -> Result<Self, ConvertError> {
        let tasks = required(w.tasks, "job.tasks")?;
        Ok(JobStatus {
            state: w.state().try_into()?,
            id: parse(&w.id, "job.id")?,
            name: w.name,
            tasks: TaskCounts {
                total: tasks.total,
                done: tasks.done,
                reused: tasks.reused,
                leased: tasks.leased,
                pending: tasks.pending,
                dead: tasks.dead,
            },
            submitted_at_ms: w.submitted_at_ms,
            ended_at_ms: (w.ended_at_ms != 0).then_some(w.ended_at_ms),
            spec: required(w.spec, "job.spec")?.try_into()?,
            mean_task_seconds: (w.mean_task_seconds > 0.0).then_some(w.mean_task_seconds),
            running: w
                .running
                .into_iter()
                .map(|r| RunningTask {
                    index: r.index,
                    worker: r.worker,
                    fraction: r.fraction,
                    seconds: r.seconds,
                })
                .collect(),
            workers: w.workers,
        })
    }
}

impl From<JobPlan> for wire::JobPlan {
    fn from(m: JobPlan) -> Self {
        wire::JobPlan {
            spec_hash: m.spec_hash,
            total: m.total,
            reuse: m.reuse,
            run: m.run,
            existing_job: m.existing_job.map(|j| j.to_string()).unwrap_or_default(),
            reasons: m.reasons,
        }
    }
}

impl TryFrom<wire::JobPlan> for JobPlan {
    type Error = ConvertError;

    fn try_from(w: wire::JobPlan) -> Result<Self, ConvertError> {
        Ok(JobPlan {
            spec_hash: w.spec_hash,
            total: w.total,
            reuse: w.reuse,
            run: w.run,
            existing_job: match w.existing_job.as_str() {
                "" => None,
                id => Some(parse(id, "plan.existing_job")?),
            },
            reasons: w.reasons,
        })
    }
}

impl From<Event> for wire::Event {
    fn from(m: Event) -> Self {
        wire::Event {
            sequence: m.sequence,
            at_ms: m.at_ms,
            job_id: m.job.to_string(),
            kind: wire::EventKind::from(m.kind).into(),
            task: m.task,
            lo: m.lo,
            hi: m.hi,
            worker: m.worker,
            message: m.message,
            seconds: m.seconds,
        }
    }
}

impl TryFrom<wire::Event> for Event {
    type Error = ConvertError;

    fn try_from(w: wire::Event) -> Result<Self, ConvertError> {
        Ok(Event {
            kind: w.kind().try_into()?,
            sequence: w.sequence,
            at_ms: w.at_ms,
            job: parse(&w.job_id, "event.job_id")?,
            task: w.task,
            lo: w.lo,
            hi: w.hi,
            worker: w.worker,
            message: w.message,
            seconds: w.seconds,
        })
    }
}
