//! Each answer follows from the facts that require it.

mod job;
mod task;
mod waits;

use picofarm_catalog::{Exception, Holdups};
use picofarm_proto::{
    ids::{JobId, StageRef},
    messages::{Event, EventKind, JobState, TaskCounts},
};
use uuid::Uuid;

use super::facts::JobFacts;
use crate::core::Candidate;

const NOW: i64 = 1_000_000;

fn id(n: u128) -> JobId {
    JobId::from_uuid(Uuid::from_u128(n))
}

fn facts() -> JobFacts {
    JobFacts {
        job: id(7),
        state: JobState::Active,
        paused: false,
        stages: vec![],
        counts: TaskCounts {
            total: 10,
            pending: 10,
            ..TaskCounts::default()
        },
        holdups: Holdups {
            ready: 10,
            ..Holdups::default()
        },
        candidates: vec![able("a")],
        shared: 0,
        suspects: 0,
        deadline: None,
        ahead: vec![],
        unseen: 0,
        elsewhere: 0,
        pools: vec![],
        over_bytes: None,
        running: vec![],
        setback: None,
        now_ms: NOW,
    }
}

fn able(name: &str) -> Candidate {
    Candidate {
        name: name.into(),
        may_run: Ok(()),
        lacks_memory: None,
        idle: false,
        gets: true,
        lacks_time: None,
        quarantined: false,
        silent_ms: None,
    }
}

fn failed(task: u64, dead: bool) -> Exception {
    Exception {
        stage: stage(),
        task,
        failures: 2,
        crashes: 1,
        interruptions: 0,
        longest_ms: 0,
        dead,
        last_error: "no light in the scene".into(),
    }
}

fn stage() -> StageRef {
    StageRef {
        job: id(7),
        stage: 0,
    }
}

fn event(kind: EventKind, worker: &str, message: &str) -> Event {
    Event {
        stage: Some(0),
        sequence: 1,
        at_ms: NOW - 5_000,
        job: id(7),
        kind,
        task: Some(4),
        lo: Some(4),
        hi: Some(5),
        worker: worker.into(),
        message: message.into(),
        seconds: 0.0,
    }
}
