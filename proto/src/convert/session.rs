//! The worker session on the wire.

use std::collections::{BTreeMap, HashMap};

use super::{ConvertError, at_most, checked, parse, required};
use crate::{
    ids::{Epoch, LeaseRef},
    key::{StageKey, TaskKey},
    messages::{
        Abilities, Failure, FailureKind, Finished, Lease, LogLevel, LogLine, TaskAt, TaskLog,
        TaskProgress, WorkerHello, log,
    },
    spec::{bounds, check_label},
    wire,
};

impl TryFrom<wire::LeaseRef> for LeaseRef {
    type Error = ConvertError;

    fn try_from(w: wire::LeaseRef) -> Result<Self, ConvertError> {
        Ok(LeaseRef {
            range: parse(&w.range_id, "lease.range_id")?,
            epoch: Epoch(w.epoch),
        })
    }
}

impl From<LeaseRef> for wire::LeaseRef {
    fn from(m: LeaseRef) -> Self {
        wire::LeaseRef {
            range_id: m.range.to_string(),
            epoch: m.epoch.0,
        }
    }
}

fn lease_ref(w: Option<wire::LeaseRef>) -> Result<LeaseRef, ConvertError> {
    required(w, "lease")?.try_into()
}

fn named(name: String, field: &'static str) -> Result<String, ConvertError> {
    checked(bounds::name(&name, bounds::NAME_BYTES), field)?;
    Ok(name)
}

/// Converts the kinds of tasks that a worker runs, with their versions.
fn kinds(all: HashMap<String, String>) -> Result<BTreeMap<String, String>, ConvertError> {
    let all = at_most(all.into_iter().collect(), bounds::LIST, "hello.kinds")?;
    let kind = |(kind, version)| Ok((named(kind, "hello.kinds")?, named(version, "hello.kinds")?));
    all.into_iter().map(kind).collect()
}

/// Returns the part of a worker's exit description that goes into the history of a task.
fn ended(text: &str) -> String {
    let plain = text.chars().filter(|c| !c.is_control());
    let mut kept = String::new();
    for c in plain {
        if kept.len() + c.len_utf8() > 256 {
            break;
        }
        kept.push(c);
    }
    kept
}

impl TryFrom<wire::Hello> for WorkerHello {
    type Error = ConvertError;

    fn try_from(w: wire::Hello) -> Result<Self, ConvertError> {
        Ok(WorkerHello {
            id: parse(&w.worker_id, "hello.worker_id")?,
            incarnation: parse(&w.incarnation, "hello.incarnation")?,
            name: named(w.name, "hello.name")?,
            version: named(w.version, "hello.version")?,
            protocol: w.protocol,
            held: at_most(w.held, bounds::LEASES, "hello.held")?
                .into_iter()
                .map(LeaseRef::try_from)
                .collect::<Result<_, _>>()?,
            ended: ended(&w.ended),
            ends_in_ms: (w.ends_in_ms > 0).then_some(w.ends_in_ms),
            abilities: Abilities {
                kinds: kinds(w.kinds)?,
                assets: at_most(w.assets, bounds::LIST, "hello.assets")?
                    .into_iter()
                    .map(|asset| named(asset, "hello.assets"))
                    .collect::<Result<_, _>>()?,
                cores: w.cores,
                memory_mib: w.memory_mib,
                gpus: at_most(w.gpus, bounds::LIST, "hello.gpus")?
                    .into_iter()
                    .map(|gpu| named(gpu, "hello.gpus"))
                    .collect::<Result<_, _>>()?,
                labels: at_most(w.labels, bounds::LIST, "hello.labels")?
                    .into_iter()
                    .map(|label| {
                        checked(check_label(&label), "hello.labels")?;
                        Ok(label)
                    })
                    .collect::<Result<_, ConvertError>>()?,
            },
        })
    }
}

impl From<WorkerHello> for wire::Hello {
    fn from(m: WorkerHello) -> Self {
        wire::Hello {
            worker_id: m.id.to_string(),
            incarnation: m.incarnation.to_string(),
            name: m.name,
            version: m.version,
            protocol: m.protocol,
            held: m.held.into_iter().map(Into::into).collect(),
            ended: m.ended,
            ends_in_ms: m.ends_in_ms.unwrap_or(0),
            kinds: m.abilities.kinds.into_iter().collect(),
            assets: m.abilities.assets,
            cores: m.abilities.cores,
            memory_mib: m.abilities.memory_mib,
            gpus: m.abilities.gpus,
            labels: m.abilities.labels,
        }
    }
}

impl TryFrom<wire::Lease> for Lease {
    type Error = ConvertError;

    fn try_from(w: wire::Lease) -> Result<Self, ConvertError> {
        if w.lo >= w.hi {
            return Err(ConvertError::Invalid {
                field: "lease.hi",
                what: format!("{}..{} holds no task", w.lo, w.hi),
            });
        }
        let mut stage = super::job::stage(w.stage)?;
        if !w.stores.is_empty() {
            stage.stores = w.stores.into_iter().collect();
        }
        Ok(Lease {
            lease: lease_ref(w.lease)?,
            job: parse(&w.job_id, "lease.job_id")?,
            lo: w.lo,
            hi: w.hi,
            skip: w.skip,
            ttl_ms: w.ttl_ms,
            stage,
            ordinal: w.ordinal,
            key: StageKey::parse(&w.stage_key).ok_or(ConvertError::Invalid {
                field: "lease.stage_key",
                what: "expected 64 hexadecimal digits".into(),
            })?,
            traceparent: w.traceparent,
        })
    }
}

impl From<Lease> for wire::Lease {
    fn from(mut m: Lease) -> Self {
        wire::Lease {
            stores: std::mem::take(&mut m.stage.stores).into_iter().collect(),
            lease: Some(m.lease.into()),
            job_id: m.job.to_string(),
            lo: m.lo,
            hi: m.hi,
            skip: m.skip,
            ttl_ms: m.ttl_ms,
            stage: Some(m.stage.into()),
            ordinal: m.ordinal,
            stage_key: m.key.to_string(),
            traceparent: m.traceparent,
        }
    }
}

fn digest(text: String) -> Result<String, String> {
    let hex = text.len() == 64 && text.bytes().all(|b| b.is_ascii_hexdigit());
    match hex {
        true => Ok(text),
        false => Err("expected 64 hexadecimal digits".into()),
    }
}

fn bytes(count: u64) -> Result<u64, String> {
    match count > bounds::BYTES {
        true => Err(format!(
            "{count} bytes; at most {} are allowed",
            bounds::BYTES
        )),
        false => Ok(count),
    }
}

impl TryFrom<wire::TaskDone> for Finished {
    type Error = ConvertError;

    fn try_from(w: wire::TaskDone) -> Result<Self, ConvertError> {
        Ok(Finished {
            lease: lease_ref(w.lease)?,
            index: w.index,
            key: TaskKey::parse(&w.task_key).ok_or(ConvertError::Invalid {
                field: "done.task_key",
                what: "expected 64 hexadecimal digits".into(),
            })?,
            manifest_sha256: checked(digest(w.manifest_sha256), "done.manifest_sha256")?,
            bytes: checked(bytes(w.bytes), "done.bytes")?,
            seconds: checked(bounds::seconds(w.seconds), "done.seconds")?,
            adopted: w.adopted,
            // A result is equally valid without a trace.
            traceparent: match bounds::name(&w.traceparent, bounds::NAME_BYTES) {
                Ok(()) => w.traceparent,
                Err(_) => String::new(),
            },
            shared: w.shared,
        })
    }
}

impl From<Finished> for wire::TaskDone {
    fn from(m: Finished) -> Self {
        wire::TaskDone {
            lease: Some(m.lease.into()),
            index: m.index,
            task_key: m.key.to_string(),
            manifest_sha256: m.manifest_sha256,
            bytes: m.bytes,
            seconds: m.seconds,
            adopted: m.adopted,
            traceparent: m.traceparent,
            shared: m.shared,
        }
    }
}

impl TryFrom<wire::TaskFailed> for Failure {
    type Error = ConvertError;

    fn try_from(w: wire::TaskFailed) -> Result<Self, ConvertError> {
        let kind = match w.kind() {
            wire::FailureKind::User => FailureKind::User,
            wire::FailureKind::Crash => FailureKind::Crash,
            wire::FailureKind::Interrupted => FailureKind::Interrupted,
            wire::FailureKind::Store if w.damaged => FailureKind::Damaged,
            wire::FailureKind::Store => FailureKind::Store,
            wire::FailureKind::Unspecified => {
                return Err(ConvertError::Missing {
                    field: "failed.kind",
                });
            }
        };
        Ok(Failure {
            lease: lease_ref(w.lease)?,
            index: w.index,
            kind,
            message: bounds::message(&w.message),
            milliseconds: {
                let seconds = bounds::seconds(w.milliseconds as f64 / 1000.0);
                checked(seconds, "failed.milliseconds")?;
                w.milliseconds
            },
            shared: w.shared,
        })
    }
}

impl From<Failure> for wire::TaskFailed {
    fn from(m: Failure) -> Self {
        let kind = match m.kind {
            FailureKind::User => wire::FailureKind::User,
            FailureKind::Crash => wire::FailureKind::Crash,
            FailureKind::Interrupted => wire::FailureKind::Interrupted,
            FailureKind::Store | FailureKind::Damaged => wire::FailureKind::Store,
        };
        wire::TaskFailed {
            lease: Some(m.lease.into()),
            index: m.index,
            kind: kind.into(),
            // A longer text than allowed would end the session each time it is sent.
            message: bounds::message(&m.message),
            damaged: m.kind == FailureKind::Damaged,
            milliseconds: m.milliseconds,
            shared: m.shared,
        }
    }
}

impl TryFrom<wire::TaskLog> for TaskLog {
    type Error = ConvertError;

    fn try_from(w: wire::TaskLog) -> Result<Self, ConvertError> {
        let lines = w.lines.into_iter().take(log::LINES).map(TryInto::try_into);
        Ok(TaskLog {
            lease: lease_ref(w.lease)?,
            index: w.index,
            lines: lines.collect::<Result<_, _>>()?,
        })
    }
}

impl From<TaskLog> for wire::TaskLog {
    fn from(m: TaskLog) -> Self {
        wire::TaskLog {
            lease: Some(m.lease.into()),
            index: m.index,
            lines: m.lines.into_iter().map(Into::into).collect(),
        }
    }
}

impl TryFrom<wire::LogLine> for LogLine {
    type Error = ConvertError;

    fn try_from(w: wire::LogLine) -> Result<Self, ConvertError> {
        let level = match w.level() {
            wire::LogLevel::Error => LogLevel::Error,
            wire::LogLevel::Warn => LogLevel::Warn,
            wire::LogLevel::Info => LogLevel::Info,
            wire::LogLevel::Unspecified => {
                return Err(ConvertError::Missing {
                    field: "log.lines.level",
                });
            }
        };
        Ok(LogLine {
            ago_ms: w.ago_ms,
            level,
            text: bounds::cut(&w.text, log::LINE_BYTES),
        })
    }
}

impl From<LogLine> for wire::LogLine {
    fn from(m: LogLine) -> Self {
        let level = match m.level {
            LogLevel::Error => wire::LogLevel::Error,
            LogLevel::Warn => wire::LogLevel::Warn,
            LogLevel::Info => wire::LogLevel::Info,
        };
        wire::LogLine {
            ago_ms: m.ago_ms,
            level: level.into(),
            text: m.text,
        }
    }
}

impl TryFrom<wire::TaskProgress> for TaskProgress {
    type Error = ConvertError;

    fn try_from(w: wire::TaskProgress) -> Result<Self, ConvertError> {
        Ok(TaskProgress {
            lease: lease_ref(w.lease)?,
            index: w.index,
            // NaN means no progress.
            fraction: match w.fraction.is_nan() {
                true => 0.0,
                false => w.fraction.clamp(0.0, 1.0),
            },
            at: TaskAt {
                text: w.text,
                figures: w.figures.into_iter().collect(),
            }
            .limited(),
        })
    }
}

impl From<TaskProgress> for wire::TaskProgress {
    fn from(m: TaskProgress) -> Self {
        wire::TaskProgress {
            lease: Some(m.lease.into()),
            index: m.index,
            fraction: m.fraction,
            text: m.at.text,
            figures: m.at.figures.into_iter().collect(),
        }
    }
}
