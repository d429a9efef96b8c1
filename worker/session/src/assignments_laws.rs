//! Property tests of the [`Assignments`] under any order of grants, renewals, losses, disconnects
//! and results.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use picofarm_proto::{
    ids::{Epoch, JobId, LeaseRef, RangeId},
    key::StageKey,
    messages::{Lease, TaskAt},
    spec::{
        OutputSettings, RenderSettings, RenderTask, SceneKind, SceneSource, StageSpec, TaskSpec,
    },
};
use picofarm_settings::{PrimitiveRooms, Spots};
use proptest::prelude::*;
use uuid::Uuid;

use crate::executor::{Output, Task, TaskError};
use crate::{
    assignments::Assignments,
    message::{Outgoing, Report},
};

const TTL: Duration = Duration::from_millis(900);
/// Number of tasks that may run at the same time.
const LANES: usize = 2;

#[derive(Debug, Clone)]
enum Step {
    Grant {
        tasks: u64,
        skip: Vec<u64>,
    },
    Begin,
    End(u8),
    Wait(u64),
    /// The machine is suspended: the monotonic clock stands still.
    Suspend(u64),
    Heartbeat,
    /// Answer the oldest heartbeat; the bits select the leases that are renewed.
    Renew(u8),
    Revoke(usize),
    Send,
    Acknowledge,
    Disconnect,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        (1u64..5, prop::collection::vec(0u64..5, 0..3))
            .prop_map(|(tasks, skip)| Step::Grant { tasks, skip }),
        Just(Step::Begin),
        Just(Step::Begin),
        (0u8..5).prop_map(Step::End),
        (0u64..400).prop_map(Step::Wait),
        (0u64..1_500).prop_map(Step::Suspend),
        Just(Step::Heartbeat),
        any::<u8>().prop_map(Step::Renew),
        (0usize..4).prop_map(Step::Revoke),
        Just(Step::Send),
        Just(Step::Acknowledge),
        Just(Step::Disconnect),
    ]
}

fn lease(epoch: u64, tasks: u64, skip: Vec<u64>) -> Lease {
    Lease {
        lease: LeaseRef {
            range: RangeId::from_uuid(Uuid::from_u128(1)),
            epoch: Epoch(epoch),
        },
        job: JobId::from_uuid(Uuid::from_u128(2)),
        lo: 0,
        hi: tasks,
        skip,
        ttl_ms: TTL.as_millis() as u32,
        ordinal: 0,
        key: StageKey([0; 32]),
        traceparent: String::new(),
        stage: StageSpec::new(TaskSpec::Render(RenderTask {
            parts: 1,
            scenes: SceneSource {
                kind: SceneKind::Primitive {
                    rooms: PrimitiveRooms::LIVING,
                },
                count: 5,
                seed: 0,
                fov_deg: Some(90.0),
                spots: Spots::Grid(1),
                laser_m: [0.0; 3],
            },
            render: RenderSettings::default(),
            output: OutputSettings {
                store: "/s".into(),
                dataset: "d".into(),
                profile: "lossless".into(),
            },
        })),
    }
}

fn result(kind: u8) -> Result<Output, TaskError> {
    match kind {
        0 => Err(TaskError::User("u".into())),
        1 => Err(TaskError::Stopped),
        _ => Ok(Output {
            manifest_sha256: String::new(),
            bytes: 1,
            adopted: false,
        }),
    }
}

/// Returns whether the worker asks for another lease now.
fn asks(assignments: &mut Assignments, now: Instant) -> bool {
    let sent = assignments.outgoing(now);
    sent.iter().any(|m| matches!(m, Outgoing::Credit(1)))
}

/// Begins and ends the next task.
fn run_one(assignments: &mut Assignments, now: Instant) {
    let task = assignments.begin(now, |_| 1).expect("a task is there");
    let lease = assignments.running()[0].lease;
    assignments.ended(now, (lease, task.index), &result(2));
}

#[test]
fn tasks_run_together_as_far_as_they_allow_and_never_with_those_of_another_stage() {
    let (mut assignments, start) = (Assignments::new(), Instant::now());
    let of = |epoch, tasks, stage| Lease {
        key: StageKey([stage; 32]),
        ..lease(epoch, tasks, Vec::new())
    };
    assert!(assignments.granted(start, of(1, 3, 0)));
    assert!(assignments.granted(start, of(2, 1, 1)));
    let together = |task: &Task| match task.stage.0[0] {
        0 => 2,
        _ => 9,
    };
    let mut begun = || assignments.begin(start, together).map(|task| task.index);
    assert_eq!([begun(), begun(), begun()], [Some(0), Some(1), None]);
    let first = assignments.running()[0].lease;
    // They end in any order.
    assignments.ended(start, (first, 1), &result(2));
    let third = assignments.begin(start, together).expect("one is left");
    assert_eq!(third.index, 2);
    assignments.ended(start, (first, 0), &result(2));
    assert!(
        assignments.begin(start, together).is_none(),
        "a task of another stage waits for the last of these"
    );
    assignments.ended(start, (first, 2), &result(2));
    let other = assignments.begin(start, together).expect("nothing runs");
    assert_eq!(other.stage.0[0], 1);
}

#[test]
fn after_a_stage_of_short_tasks_one_task_of_another_is_enough() {
    let (mut assignments, start) = (Assignments::new(), Instant::now());
    let of = |epoch, stage| Lease {
        key: StageKey([stage; 32]),
        ..lease(epoch, 1, Vec::new())
    };
    assert!(asks(&mut assignments, start), "nothing to do");
    assert!(assignments.granted(start, of(1, 0)));
    run_one(&mut assignments, start);
    // The next task of the same stage will end soon, so another lease is requested; this one is of
    // a second stage.
    assert!(asks(&mut assignments, start), "nothing to do");
    assert!(assignments.granted(start, of(2, 0)));
    assert!(asks(&mut assignments, start), "it is soon over");
    assert!(assignments.granted(start, of(3, 1)));
    assert!(
        !asks(&mut assignments, start),
        "nobody knows how long the second stage's task takes"
    );
    run_one(&mut assignments, start);
    let task = assignments.begin(start, |_| 1).expect("a task is there");
    assert!(!asks(&mut assignments, start), "it is in hand");
    let lease = assignments.running()[0].lease;
    assignments.ended(start, (lease, task.index), &result(2));
    assert!(asks(&mut assignments, start), "nothing to do");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn no_task_starts_twice_skipped_fenced_or_lost_and_every_finished_one_is_told_until_acknowledged(
        steps in prop::collection::vec(step(), 1..60),
    ) {
        let mut assignments = Assignments::new();
        let mut now = Instant::now();
        // Duration of suspends, which `now` does not count.
        let mut slept = Duration::ZERO;
        let mut epoch = 0;
        let mut renewed: BTreeMap<LeaseRef, Instant> = BTreeMap::new();
        let mut skipped: BTreeSet<(LeaseRef, u64)> = BTreeSet::new();
        let mut started: BTreeSet<(LeaseRef, u64)> = BTreeSet::new();
        let mut finished: BTreeSet<(LeaseRef, u64)> = BTreeSet::new();
        let mut wire: Vec<Report> = Vec::new();
        let mut beats: Vec<(Instant, Vec<LeaseRef>)> = Vec::new();

        for step in steps {
            match step {
                Step::Grant { tasks, skip } => {
                    epoch += 1;
                    let lease = lease(epoch, tasks, skip);
                    skipped.extend(lease.skip.iter().map(|i| (lease.lease, *i)));
                    renewed.insert(lease.lease, now + slept);
                    prop_assert!(assignments.granted(now, lease.clone()));
                    if assignments.held().contains(&lease.lease) {
                        prop_assert!(!assignments.granted(now, lease), "a repeated grant is no news");
                    }
                }
                Step::Begin => {
                    let free = assignments.running().len() < LANES;
                    if let Some(task) = assignments.begin(now, |_| LANES) {
                        prop_assert!(free, "too many at a time");
                        let lease = assignments.running().last().unwrap().lease;
                        prop_assert!(started.insert((lease, task.index)), "twice");
                        prop_assert!(!skipped.contains(&(lease, task.index)), "skipped");
                        let life = renewed.get(&lease).expect("not lost");
                        prop_assert!(now + slept - *life < TTL * 2 / 3, "fenced");
                    }
                }
                Step::End(kind) => {
                    let running = assignments.running().iter();
                    let mut running: Vec<_> = running.map(|t| (t.lease, t.task.index)).collect();
                    if !running.is_empty() {
                        let task = running.swap_remove(usize::from(kind) % running.len());
                        let hand = assignments.ended(now, task, &result(kind));
                        if kind > 1 {
                            finished.insert((hand.lease, hand.task.index));
                        }
                    }
                }
                Step::Wait(ms) => now += Duration::from_millis(ms),
                Step::Suspend(ms) => {
                    let long = Duration::from_millis(ms);
                    slept += long;
                    assignments.suspended(long);
                }
                Step::Heartbeat => {
                    let Outgoing::Heartbeat { leases, progress, .. } = assignments.heartbeat(now, |_| (0.5, TaskAt::default())) else {
                        unreachable!()
                    };
                    prop_assert!(progress.iter().all(|p| leases.contains(&p.lease)));
                    beats.push((now + slept, leases));
                }
                Step::Renew(bits) => {
                    if beats.is_empty() {
                        continue;
                    }
                    let (sent, named) = beats.remove(0);
                    let (kept, gone): (Vec<_>, Vec<_>) =
                        named.into_iter().partition(|l| bits >> (l.epoch.0 % 8) & 1 == 1);
                    assignments.renewed(now, &kept, TTL);
                    for lease in kept {
                        // A lease that was lost earlier is not restored.
                        renewed.entry(lease).and_modify(|at| *at = (*at).max(sent));
                    }
                    for lease in gone {
                        renewed.remove(&lease);
                    }
                }
                Step::Revoke(k) => {
                    if let Some(lease) = assignments.held().get(k).copied() {
                        let life = renewed.remove(&lease).expect("held leases are not lost");
                        let mine = assignments.running().iter().any(|t| t.lease == lease);
                        prop_assert_eq!(assignments.revoked(now, lease), mine && now + slept - life < TTL);
                    }
                }
                Step::Send => {
                    for message in assignments.outgoing(now) {
                        match message {
                            Outgoing::Report(report) => wire.push(report),
                            Outgoing::Credit(n) => prop_assert_eq!(n, 1),
                            Outgoing::Heartbeat { .. } | Outgoing::Log(_) | Outgoing::Examined(_) => unreachable!(),
                        }
                    }
                }
                Step::Acknowledge => {
                    if wire.is_empty() {
                        continue;
                    }
                    let report = wire.remove(0);
                    let index = match &report {
                        Report::Done(d) => d.index,
                        Report::Failed(f) => f.index,
                        Report::Release { .. } => 0,
                    };
                    let answered = assignments.acknowledged(report.lease(), index);
                    prop_assert_eq!(answered.as_ref(), Some(&report));
                    if let Report::Done(done) = report {
                        prop_assert!(finished.remove(&(done.lease, done.index)));
                    }
                }
                Step::Disconnect => {
                    assignments.disconnected();
                    wire.clear();
                    beats.clear();
                }
            }
            prop_assert_eq!(assignments.unacknowledged_outputs(), finished.len());
        }
        // All unacknowledged reports are sent again after a reconnect.
        assignments.disconnected();
        let said: BTreeSet<_> = assignments
            .outgoing(now)
            .into_iter()
            .filter_map(|m| match m {
                Outgoing::Report(Report::Done(d)) => Some((d.lease, d.index)),
                _ => None,
            })
            .collect();
        prop_assert_eq!(said, finished);
    }
}
