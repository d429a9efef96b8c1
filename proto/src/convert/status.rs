//! Reports on jobs, on the wire.

use super::{ConvertError, parse, required};
use crate::{
    messages::{
        Estimate, Event, EventKind, JobPlan, JobState, JobStatus, JobSummary, RunningTask,
        StagePlan, StageState, StageStatus, TaskCounts,
    },
    spec::bounds,
    wire,
};

/// Pairs of model and wire variants, converted both ways. The wire's zero is an error.
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
        Ended, Waiting, Alarm, Opened, Paused, Resumed, Log,
    ]
);

enum_pairs!(
    StageState,
    wire::StageState,
    "stage.state",
    [Blocked, Open, Done, Failed]
);

impl From<TaskCounts> for wire::TaskCounts {
    fn from(m: TaskCounts) -> Self {
        wire::TaskCounts {
            total: m.total,
            done: m.done,
            reused: m.reused,
            leased: m.leased,
            pending: m.pending,
            dead: m.dead,
        }
    }
}

impl From<wire::TaskCounts> for TaskCounts {
    fn from(w: wire::TaskCounts) -> Self {
        TaskCounts {
            total: w.total,
            done: w.done,
            reused: w.reused,
            leased: w.leased,
            pending: w.pending,
            dead: w.dead,
        }
    }
}

impl From<StageStatus> for wire::StageStatus {
    fn from(m: StageStatus) -> Self {
        wire::StageStatus {
            name: m.name,
            kind: m.kind,
            state: wire::StageState::from(m.state).into(),
            needs: m.needs,
            tasks: Some(m.tasks.into()),
        }
    }
}

impl TryFrom<wire::StageStatus> for StageStatus {
    type Error = ConvertError;

    fn try_from(w: wire::StageStatus) -> Result<Self, ConvertError> {
        Ok(StageStatus {
            state: w.state().try_into()?,
            name: w.name,
            kind: w.kind,
            needs: w.needs,
            tasks: required(w.tasks, "stage.tasks")?.into(),
        })
    }
}

/// Converts a running task, with its current step if `at`.
fn running(m: RunningTask, at: bool) -> wire::RunningTask {
    let brief = wire::RunningTask {
        stage: m.stage,
        index: m.index,
        worker: m.worker,
        fraction: m.fraction,
        seconds: m.seconds,
        ..wire::RunningTask::default()
    };
    match at {
        false => brief,
        true => wire::RunningTask {
            text: m.text,
            figures: m.figures.into_iter().collect(),
            ..brief
        },
    }
}

impl From<JobStatus> for wire::JobStatus {
    fn from(m: JobStatus) -> Self {
        wire::JobStatus {
            id: m.id.to_string(),
            name: m.name,
            state: wire::JobState::from(m.state).into(),
            tasks: Some(m.tasks.into()),
            paused: m.paused,
            user: m.user,
            stages: m.stages.into_iter().map(Into::into).collect(),
            submitted_at_ms: m.submitted_at_ms,
            ended_at_ms: m.ended_at_ms.unwrap_or(0),
            spec: Some(m.spec.into()),
            mean_task_seconds: m.mean_task_seconds.unwrap_or(0.0),
            running: m
                .running
                .into_iter()
                .enumerate()
                .map(|(n, r)| running(r, n < bounds::RUNNING))
                .collect(),
            workers: m.workers,
            unverified: m.unverified,
        }
    }
}

impl TryFrom<wire::JobStatus> for JobStatus {
    type Error = ConvertError;

    fn try_from(w: wire::JobStatus) -> Result<Self, ConvertError> {
        Ok(JobStatus {
            state: w.state().try_into()?,
            id: parse(&w.id, "job.id")?,
            name: w.name,
            tasks: required(w.tasks, "job.tasks")?.into(),
            paused: w.paused,
            user: w.user,
            stages: w
                .stages
                .into_iter()
                .map(TryInto::try_into)
                .collect::<Result<_, _>>()?,
            submitted_at_ms: w.submitted_at_ms,
            ended_at_ms: (w.ended_at_ms != 0).then_some(w.ended_at_ms),
            spec: required(w.spec, "job.spec")?.try_into()?,
            mean_task_seconds: (w.mean_task_seconds > 0.0).then_some(w.mean_task_seconds),
            running: w
                .running
                .into_iter()
                .map(|r| RunningTask {
                    stage: r.stage,
                    index: r.index,
                    worker: r.worker,
                    fraction: r.fraction,
                    seconds: r.seconds,
                    text: r.text,
                    figures: r.figures.into_iter().collect(),
                })
                .collect(),
            workers: w.workers,
            unverified: w.unverified,
        })
    }
}

impl From<JobSummary> for wire::JobSummary {
    fn from(m: JobSummary) -> Self {
        wire::JobSummary {
            id: m.id.to_string(),
            name: m.name,
            user: m.user,
            project: m.project,
            state: wire::JobState::from(m.state).into(),
            paused: m.paused,
            tasks: Some(m.tasks.into()),
            submitted_at_ms: m.submitted_at_ms,
            ended_at_ms: m.ended_at_ms.unwrap_or(0),
            number: m.number,
            left_s: m.left_s.unwrap_or(0),
        }
    }
}

impl TryFrom<wire::JobSummary> for JobSummary {
    type Error = ConvertError;

    fn try_from(w: wire::JobSummary) -> Result<Self, ConvertError> {
        Ok(JobSummary {
            state: w.state().try_into()?,
            id: parse(&w.id, "job.id")?,
            number: w.number,
            name: w.name,
            user: w.user,
            project: w.project,
            paused: w.paused,
            tasks: required(w.tasks, "job.tasks")?.into(),
            submitted_at_ms: w.submitted_at_ms,
            ended_at_ms: (w.ended_at_ms != 0).then_some(w.ended_at_ms),
            left_s: (w.left_s != 0).then_some(w.left_s),
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
            stages: m
                .stages
                .into_iter()
                .map(|s| wire::StagePlan {
                    name: s.name,
                    kind: s.kind,
                    total: s.total,
                    reuse: s.reuse,
                    run: s.run,
                    memory_bytes: s.memory_bytes,
                    workers: s.workers,
                    task_seconds: s.task_seconds.map(Into::into),
                    task_bytes: s.task_bytes.map(Into::into),
                    measured: s.measured,
                    reasons: s.reasons,
                })
                .collect(),
            warnings: m.warnings,
        }
    }
}

impl From<Estimate> for wire::Estimate {
    fn from(Estimate { low, high }: Estimate) -> Self {
        wire::Estimate { low, high }
    }
}

impl From<wire::Estimate> for Estimate {
    fn from(wire::Estimate { low, high }: wire::Estimate) -> Self {
        Estimate { low, high }
    }
}

impl TryFrom<wire::JobPlan> for JobPlan {
    type Error = ConvertError;

    fn try_from(w: wire::JobPlan) -> Result<Self, ConvertError> {
        Ok(JobPlan {
            spec_hash: w.spec_hash,
            total: w.total,
            reuse: w.reuse,
            taken: 0,
            run: w.run,
            existing_job: match w.existing_job.as_str() {
                "" => None,
                id => Some(parse(id, "plan.existing_job")?),
            },
            stages: w
                .stages
                .into_iter()
                .map(|s| StagePlan {
                    name: s.name,
                    kind: s.kind,
                    total: s.total,
                    reuse: s.reuse,
                    taken: 0,
                    run: s.run,
                    memory_bytes: s.memory_bytes,
                    workers: s.workers,
                    task_seconds: s.task_seconds.map(Into::into),
                    task_bytes: s.task_bytes.map(Into::into),
                    measured: s.measured,
                    reasons: s.reasons,
                })
                .collect(),
            warnings: w.warnings,
        })
    }
}

impl From<Event> for wire::Event {
    fn from(m: Event) -> Self {
        wire::Event {
            sequence: m.sequence,
            at_ms: m.at_ms,
            job_id: m.job.to_string(),
            stage: m.stage,
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
            stage: w.stage,
            task: w.task,
            lo: w.lo,
            hi: w.hi,
            worker: w.worker,
            message: w.message,
            seconds: w.seconds,
        })
    }
}
