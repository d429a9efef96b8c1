//! Explanations on the wire.

use super::{ConvertError, parse, required};
use crate::{
    messages::{ConnectedWorker, Made, Reason, TaskExplanation, TaskOutput, TaskState},
    wire,
};

impl From<Reason> for wire::Reason {
    fn from(m: Reason) -> Self {
        wire::Reason {
            code: m.code,
            tasks: m.tasks,
            words: m.words,
            until_ms: m.until_ms.unwrap_or(0),
        }
    }
}

impl From<wire::Reason> for Reason {
    fn from(w: wire::Reason) -> Self {
        Reason {
            code: w.code,
            tasks: w.tasks,
            words: w.words,
            until_ms: (w.until_ms != 0).then_some(w.until_ms),
        }
    }
}

impl From<TaskExplanation> for wire::TaskExplanation {
    fn from(m: TaskExplanation) -> Self {
        wire::TaskExplanation {
            index: m.index,
            state: m.state.name().into(),
            words: m.words,
            failures: m.failures,
            max_failures: m.max_failures,
            crashes: m.crashes,
            max_crashes: m.max_crashes,
            interruptions: m.interruptions,
            max_interruptions: m.max_interruptions,
            last_error: m.last_error,
            reruns: m.reruns,
            output: m.output.map(Into::into),
            events: m.events.into_iter().map(Into::into).collect(),
        }
    }
}

impl TryFrom<wire::TaskExplanation> for TaskExplanation {
    type Error = ConvertError;

    fn try_from(w: wire::TaskExplanation) -> Result<Self, ConvertError> {
        let state = TaskState::ALL.into_iter().find(|s| s.name() == w.state);
        Ok(TaskExplanation {
            index: w.index,
            state: required(state, "task.state")?,
            words: w.words,
            failures: w.failures,
            max_failures: w.max_failures,
            crashes: w.crashes,
            max_crashes: w.max_crashes,
            interruptions: w.interruptions,
            max_interruptions: w.max_interruptions,
            last_error: w.last_error,
            reruns: w.reruns,
            output: w.output.map(TryInto::try_into).transpose()?,
            events: w
                .events
                .into_iter()
                .map(TryInto::try_into)
                .collect::<Result<_, _>>()?,
        })
    }
}

impl From<TaskOutput> for wire::TaskOutput {
    fn from(m: TaskOutput) -> Self {
        let output = wire::TaskOutput {
            manifest_sha256: m.manifest_sha256,
            bytes: m.bytes,
            seconds: m.seconds,
            adopted: m.adopted,
            ..Default::default()
        };
        match m.made {
            None => output,
            Some(made) => wire::TaskOutput {
                worker: made.worker,
                job_id: made.job.to_string(),
                job_name: made.job_name,
                at_ms: made.at_ms,
                ..output
            },
        }
    }
}

impl TryFrom<wire::TaskOutput> for TaskOutput {
    type Error = ConvertError;

    fn try_from(w: wire::TaskOutput) -> Result<Self, ConvertError> {
        let made = match w.job_id.as_str() {
            "" => None,
            id => Some(Made {
                worker: w.worker,
                job: parse(id, "output.job_id")?,
                job_name: w.job_name,
                at_ms: w.at_ms,
            }),
        };
        Ok(TaskOutput {
            manifest_sha256: w.manifest_sha256,
            bytes: w.bytes,
            seconds: w.seconds,
            adopted: w.adopted,
            made,
        })
    }
}

impl From<ConnectedWorker> for wire::ConnectedWorker {
    fn from(m: ConnectedWorker) -> Self {
        wire::ConnectedWorker {
            id: m.id,
            name: m.name,
            version: m.version,
            renderer: m.renderer,
            cores: m.cores,
            leases: m.leases,
            tasks: m.tasks,
            since_ms: m.since_ms,
            quarantined: m.quarantined,
            note: m.note,
        }
    }
}

impl From<wire::ConnectedWorker> for ConnectedWorker {
    fn from(w: wire::ConnectedWorker) -> Self {
        ConnectedWorker {
            id: w.id,
            name: w.name,
            version: w.version,
            renderer: w.renderer,
            cores: w.cores,
            leases: w.leases,
            tasks: w.tasks,
            since_ms: w.since_ms,
            quarantined: w.quarantined,
            note: w.note,
        }
    }
}
