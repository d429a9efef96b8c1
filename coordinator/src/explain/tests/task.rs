//! The state of one task, and its history.

use picofarm_catalog::{LeaseState, Mark, Output, Range, RangeState, TaskRecord};
use picofarm_proto::{
    ids::{Epoch, Incarnation, RangeId, WorkerId},
    messages::{EventKind, TaskState},
    spec::Limits,
};
use uuid::Uuid;

use super::{NOW, event, failed, id, stage};
use crate::{
    core::RunningOn,
    explain::{facts::TaskFacts, task},
};

fn range(state: RangeState) -> Range {
    Range {
        id: RangeId::from_uuid(Uuid::from_u128(1)),
        stage: stage(),
        lo: 4,
        hi: 5,
        epoch: Epoch(1),
        crashes: 0,
        state,
    }
}

fn task_facts(state: RangeState) -> TaskFacts {
    TaskFacts {
        index: 4,
        job: id(7),
        record: TaskRecord {
            range: Some(range(state)),
            ..TaskRecord::default()
        },
        events: vec![],
        limits: Limits::default(),
        elsewhere: None,
        running: None,
        now_ms: NOW,
    }
}

fn leased_state() -> RangeState {
    RangeState::Leased(LeaseState {
        worker: WorkerId::from_uuid(Uuid::from_u128(1)),
        incarnation: Incarnation::from_uuid(Uuid::from_u128(1)),
        until_ms: NOW,
        marks: vec![Mark::Todo],
    })
}

#[test]
fn each_run_of_a_task_but_the_first_has_its_cause() {
    let mut facts = task_facts(leased_state());
    facts.record.exception = Some(failed(4, false));
    facts.events = vec![
        event(EventKind::Leased, "a", "tasks 4..5"),
        event(EventKind::Expired, "a", "the lease ran out"),
        event(EventKind::Failed, "a", "the lease ran out"),
        event(EventKind::Leased, "b", "tasks 4..5"),
        event(EventKind::Released, "b", "the worker is stopping"),
        event(EventKind::Leased, "c", "tasks 4..5"),
        event(EventKind::Dead, "c", "no light"),
        event(EventKind::Leased, "d", "tasks 4..5"),
    ];
    let explained = task(facts.clone());
    assert_eq!(explained.state, TaskState::Leased);
    assert!(
        explained.words.contains("leased to d for 5 s"),
        "{}",
        explained.words
    );
    assert_eq!(
        explained.reruns,
        [
            "the lease ran out",
            "b gave it back: the worker is stopping",
            "it was given up on c: no light, and then tried again",
        ]
    );
    assert_eq!((explained.failures, explained.crashes), (2, 1));
    facts.running = Some(RunningOn {
        worker: "d".into(),
        fraction: 0.4,
        text: "epoch 3/200".into(),
        since_ms: NOW - 3_000,
    });
    assert_eq!(
        task(facts).words,
        "runs on d for 3 s: 40 % done (epoch 3/200)"
    );
}

#[test]
fn a_finished_task_says_who_made_it() {
    let output = Output {
        stage: stage(),
        task: 4,
        manifest: [1; 32],
        bytes: 100,
        seconds: 2.5,
        epoch: Epoch(1),
        adopted: false,
        checked: false,
    };
    let mut facts = task_facts(RangeState::Done { reused: true });
    facts.record.output = Some(output);
    let unknown = task(facts.clone());
    assert_eq!(unknown.state, TaskState::Done);
    assert!(unknown.words.contains("does not tell"), "{}", unknown.words);
    facts.elsewhere = Some((id(3), "first".into(), event(EventKind::Committed, "a", "")));
    let reused = task(facts.clone());
    assert!(
        reused.words.contains("under job") && reused.words.contains("(first)"),
        "{}",
        reused.words
    );
    facts.events = vec![event(EventKind::Committed, "b", "")];
    let own = task(facts);
    assert_eq!(own.words, "done: computed by b under this job");
    assert_eq!(own.output.unwrap().manifest_sha256, "01".repeat(32));
}

#[test]
fn a_task_that_waits_or_was_given_up_says_why() {
    let mut facts = task_facts(RangeState::Pending {
        not_before_ms: NOW + 8_000,
    });
    facts.record.exception = Some(failed(4, false));
    let explained = task(facts.clone());
    assert_eq!(explained.state, TaskState::Pending);
    assert!(
        explained.words.contains("another 8 s") && explained.words.contains("no light"),
        "{}",
        explained.words
    );
    facts.record.range = Some(range(RangeState::Dead));
    let explained = task(facts.clone());
    assert_eq!(explained.state, TaskState::Dead);
    assert!(
        explained.words.contains("2 of 3 failures") && explained.words.contains("job retry"),
        "{}",
        explained.words
    );
    facts.record.range = None;
    assert_eq!(task(facts).state, TaskState::Gone);
}
