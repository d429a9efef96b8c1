//! Tasks that cannot run now do not keep a worker from tasks that can.

use picofarm_catalog::RangeState;
use picofarm_proto::{
    ids::StageRef,
    messages::{FailureKind, StageState},
    spec::JobSpec,
};
use proptest::prelude::*;

use super::{
    super::{Bound, UserQuotas},
    block_on,
    world::{Op, World},
};

/// A job of one stage with settings that delay it.
pub(super) fn job(name: &str, priority: i32, settings: &str) -> JobSpec {
    let text = format!(
        r#"{{"name": "{name}", "priority": {priority}, "scenes": {{"kind": "primitive", "count": 8}},
            "render": {{"renderer": "r"}}, "output": {{"store": "{name}", "dataset": "d"}}, {settings}}}"#
    );
    serde_json::from_str(&text).unwrap()
}

/// Settings that may delay a stage.
pub(super) const WAYS: [&str; 6] = [
    r#""limits": {"max_failures": 50}"#,
    r#""limits": {"max_failures": 50, "max_crashes": 50}"#,
    r#""limits": {"max_workers": 1, "max_failures": 50}"#,
    r#""resources": {"labels": ["x"]}"#,
    r#""resources": {"labels": ["nobody has"]}"#,
    r#""resources": {"cores": 100}"#,
];

impl World {
    /// The law: if a worker asks for work and a pending task could run on it, the task has been
    /// leased.
    async fn check_nobody_starves(&self) {
        let instance = &self.instances[0];
        let core = &instance.core;
        let hungry: Vec<_> = core.workers.asking().collect();
        for job in self.jobs.iter().filter(|_| !hungry.is_empty()) {
            let record = instance.catalog.job(*job).await.unwrap().unwrap();
            for (ordinal, stage) in (0..).zip(&record.stages) {
                let id = StageRef {
                    job: *job,
                    stage: ordinal,
                };
                if record.job.paused || stage.state != StageState::Open {
                    continue;
                }
                let able = hungry
                    .iter()
                    .filter(|(w, _)| core.may_run(id, **w, self.now).is_ok());
                let able: Vec<_> = able.collect();
                for task in (0..stage.counts.total).filter(|_| !able.is_empty()) {
                    let range = instance
                        .catalog
                        .task(id, task)
                        .await
                        .unwrap()
                        .range
                        .unwrap();
                    let due = matches!(
                        range.state,
                        RangeState::Pending { not_before_ms } if not_before_ms <= self.now
                    );
                    let could = able.iter().find(|(worker, entry)| {
                        let long = core.excluded_tasks(id, **worker, self.now);
                        let long = long.iter().any(|run| (run.lo..run.hi).contains(&task));
                        !long && (range.crashes == 0 || entry.leases.is_empty())
                    });
                    assert!(
                        !due || could.is_none(),
                        "{} asks, and task {task} of stage {ordinal} of job {} waits at {}",
                        could.map_or("", |(_, entry)| &entry.name),
                        record.job.spec.name,
                        self.now
                    );
                }
            }
        }
    }
}

pub(super) fn ops() -> impl Strategy<Value = Op> {
    let w = 0..3u8;
    let kind = prop_oneof![
        4 => Just(FailureKind::User),
        2 => Just(FailureKind::Store),
        1 => Just(FailureKind::Crash),
        1 => Just(FailureKind::Interrupted),
    ];
    prop_oneof![
        6 => w.clone().prop_map(Op::Credit),
        3 => (w.clone(), 0..4u8, any::<u8>()).prop_map(|(w, l, t)| Op::Finish(w, l, t)),
        8 => (w.clone(), 0..4u8, any::<u8>(), kind).prop_map(|(w, l, t, k)| Op::Fail(w, l, t, k)),
        1 => (w.clone(), 0..4u8).prop_map(|(w, l)| Op::Release(w, l)),
        1 => w.clone().prop_map(Op::Beat),
        1 => (w.clone(), any::<bool>()).prop_map(|(w, d)| Op::Drop(w, d)),
        2 => w.clone().prop_map(|w| Op::Connect(w, 0)),
        1 => (w, 1..3_000u16).prop_map(|(w, ms)| Op::Ends(w, ms)),
        3 => (1..60u16).prop_map(Op::Pass),
        1 => (500..1_500u16).prop_map(Op::Pass),
        1 => Just(Op::InstanceBeats(0)),
        1 => any::<bool>().prop_map(Op::Pause),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, max_shrink_iters: 200, ..ProptestConfig::default() })]

    #[test]
    fn a_task_that_can_run_is_leased_whenever_a_worker_asks(
        jobs in prop::collection::vec((0..WAYS.len(), 0..2i32, any::<bool>()), 1..6),
        quota in prop::option::of(1..4u32),
        ops in prop::collection::vec(ops(), 10..60),
    ) {
        block_on(async {
            let folder = tempfile::tempdir().unwrap();
            let mut world = World::on_sqlite(folder.path()).await;
            world.instances[0].core.set_quotas(UserQuotas {
                cores: Bound {
                    every: quota,
                    ..Bound::default()
                },
                ..UserQuotas::default()
            });
            for (n, (way, priority, other)) in jobs.iter().enumerate() {
                let user = if *other { "eve" } else { "ada" };
                let spec = job(&format!("j{n}"), *priority, WAYS[*way]);
                world.submit_as(0, user, spec).await;
            }
            for w in 0..3 {
                world.connect(w, 0).await;
                world.act(&Op::Credit(w)).await;
            }
            for op in &ops {
                world.act(op).await;
                world.check_nobody_starves().await;
            }
            world.close().await;
        });
    }
}

/// The case as it was observed: eight tasks that cannot be parsed, fifty tries each, one worker.
#[test]
fn a_job_of_failing_tasks_leaves_the_worker_to_the_job_of_another() {
    for priority in [0, 5] {
        block_on(async {
            let folder = tempfile::tempdir().unwrap();
            let mut world = World::on_sqlite(folder.path()).await;
            world
                .submit_as(0, "eve", job("bad", priority, WAYS[0]))
                .await;
            let good = world.jobs[0];
            world.connect(0, 0).await;
            let mut done = 0;
            for _ in 0..300 {
                world.act(&Op::Credit(0)).await;
                for lease in world.workers[0].leases.clone() {
                    let session = world.workers[0].session.unwrap().1;
                    for index in lease.lo..lease.hi {
                        if lease.job == good {
                            world.finish(0, session, &lease, index).await;
                            done += 1;
                        } else {
                            world.fail(&lease, index, FailureKind::User).await;
                        }
                    }
                }
                world.workers[0].leases.clear();
                world.act(&Op::Beat(0)).await;
                // Shorter than the rest after a failure.
                world.act(&Op::Pass(4)).await;
            }
            // Both stages of the job are done.
            assert_eq!(done, 2 * super::TASKS, "priority {priority}");
            world.close().await;
        });
    }
}
