//! Compares cores over a real catalog with a simple model. After any sequence of events every task
//! is committed exactly once, the counts are consistent, and the catalog agrees with the cores.
//! There is one instance on SQLite, or two on Postgres, which lose workers to each other, lose
//! their time, and lose their memory.

mod demanding;
mod starving;
mod troubled;
mod world;

use picofarm_catalog::{EventQuery, Sight};
use picofarm_proto::messages::{Failure, FailureKind, Lease};
use proptest::prelude::*;

use world::{Op, SETTINGS, TASKS, World, op};

fn block_on(work: impl Future<Output = ()>) {
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap()
        .block_on(work);
}

#[test]
fn histories_that_begin_greedily_have_leases_trimmed_and_tasks_doubled() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.greedy().await;
        assert!(
            world.trims > 0 && world.doubles > 0,
            "{} {}",
            world.trims,
            world.doubles
        );
    });
}

#[test]
fn jobs_that_want_the_same_outputs_share_the_work() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.act(&Op::Grow).await;
        let (first, second) = (world.jobs[0], world.jobs[1]);
        for w in 0..2 {
            world.connect(w, 0).await;
            world.act(&Op::Credit(w)).await;
        }
        let lease = |w: usize| world.workers[w].leases[0].clone();
        let (a, b) = (lease(0), lease(1));
        assert_eq!((a.job, b.job), (first, second), "either job has a worker");
        assert_eq!((a.lo, b.lo), (0, a.hi), "the second begins after the first");
        let look = |job| {
            world.instances[0]
                .core
                .job_snapshot(job, None, None, world.now)
        };
        assert_eq!(look(first).shared, b.hi - b.lo);
        assert_eq!(look(second).shared, a.hi - a.lo);
        world.check_shared();
        // Results of the second job count for the first, and the reverse.
        world.end().await;
    });
}

#[test]
fn what_a_worker_of_another_instance_has_in_hand_is_not_begun_for_another_job() {
    block_on(async {
        let Some(mut world) = World::on_postgres().await else {
            return;
        };
        world.act(&Op::Grow).await;
        world.connect(0, 0).await;
        world.act(&Op::Credit(0)).await;
        let there = world.workers[0].leases[0].clone();
        assert_eq!((there.job, there.lo), (world.jobs[0], 0));
        world.beat(1).await;
        world.connect(1, 1).await;
        let second = loop {
            world.act(&Op::Credit(1)).await;
            let mut leases = world.workers[1].leases.iter();
            if let Some(lease) = leases.find(|lease| lease.job == world.jobs[1]) {
                break lease.clone();
            }
        };
        assert_eq!(second.lo, there.hi, "the second job's first task but those");
        world.end().await;
    });
}

#[test]
fn a_stage_that_has_just_begun_is_the_one_that_a_job_waits_for() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.connect(0, 0).await;
        let able = |world: &mut World, able: bool| {
            let mut workers = world.instances[0].core.workers.iter_mut();
            let kinds = &mut workers.next().unwrap().1.abilities.kinds;
            match able {
                true => kinds.insert("reprocess".into(), "r".into()),
                false => kinds.remove("reprocess"),
            };
        };
        able(&mut world, false);
        for _ in 0..TASKS {
            world.act(&Op::Credit(0)).await;
            let lease = world.workers[0].leases[0].clone();
            let session = world.workers[0].session.unwrap().1;
            for index in lease.lo..lease.hi {
                world.finish(0, session, &lease, index).await;
            }
        }
        let core = &world.instances[0].core;
        let why = core.job_snapshot(world.jobs[0], None, None, world.now);
        let why = why.candidates[0]
            .may_run
            .clone()
            .unwrap_err()
            .words()
            .to_owned();
        assert!(why.contains("reprocess"), "{why}");
        able(&mut world, true);
        world.end().await;
    });
}

/// While a coordinator is busy, a worker's heartbeat waits in the queue. The worker's leases, which
/// would run out, are extended. Those of a silent worker are not, and the history records its
/// silence.
#[test]
fn only_leases_of_workers_that_were_heard_outlive_a_busy_coordinator() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        for w in 0..2 {
            world.connect(w, 0).await;
            world.act(&Op::Credit(w)).await;
        }
        let lease = |w: usize| world.workers[w].leases[0].clone();
        let (heard, silent) = (lease(0), lease(1));
        let session = world.workers[0].session.unwrap().1;
        world.now += i64::from(SETTINGS.lease_ms) + 1;
        let core = &mut world.instances[0].core;
        core.spare(session, world.now);
        core.expire(world.now);
        let lives = |lease: &Lease| core.range(lease.lease.range).is_some();
        assert_eq!((lives(&heard), lives(&silent)), (true, false));
        world.flush(0).await;
        let query = EventQuery {
            job: Some(world.jobs[0]),
            after: 0,
            limit: 100,
            task: None,
            stage: None,
            newest: false,
            logs: false,
            sight: Sight::All,
        };
        let events = world.instances[0].catalog.events(&query).await;
        let said = events.unwrap().into_iter().map(|e| e.message);
        let said: Vec<String> = said.filter(|m| m.contains("w1")).collect();
        let what = format!("worker w1 fell silent while it ran task {}", silent.lo);
        assert!(said.iter().any(|m| m.starts_with(&what)), "{said:?}");
        // The extension works only once: the next heartbeat must come in time.
        world.now += i64::from(SETTINGS.lease_ms) + 1;
        let core = &mut world.instances[0].core;
        core.expire(world.now);
        assert!(core.range(heard.lease.range).is_none());
    });
}

/// Found by a chaos test. A worker takes its lease to another instance and ends it there. Its
/// former instance, which does not know yet, commits its own last task afterwards.
#[test]
fn a_stage_is_over_although_its_last_instance_believed_to_hold_a_lease_that_ended_elsewhere() {
    block_on(async {
        let Some(mut world) = World::on_postgres().await else {
            return;
        };
        let job = world.jobs[0];
        let first = async |world: &World| {
            let catalog = &world.instances[0].catalog;
            catalog.job(job).await.unwrap().unwrap().stages[0]
        };
        world.connect(0, 0).await;
        world.connect(1, 0).await;
        world.act(&Op::Credit(1)).await;
        world.beat(0).await;
        world.flush(0).await;
        world.beat(1).await;
        // The other worker finishes all tasks except those of its last lease.
        loop {
            world.act(&Op::Credit(0)).await;
            world.flush(0).await;
            if first(&world).await.counts.pending == 0 {
                break;
            }
            let lease = world.workers[0].leases[0].clone();
            let session = world.workers[0].session.unwrap().1;
            for index in lease.lo..lease.hi {
                world.finish(0, session, &lease, index).await;
            }
        }
        for (worker, instance) in [(1, 1), (0, 0)] {
            if instance == 1 {
                world.connect(1, 1).await;
            }
            let lease = world.workers[worker].leases[0].clone();
            let session = world.workers[worker].session.unwrap().1;
            for index in lease.lo..lease.hi {
                world.finish(instance, session, &lease, index).await;
            }
        }
        let counts = first(&world).await.counts;
        assert_eq!((counts.done, counts.leased), (TASKS, 0), "{counts:?}");
        world.beat(0).await;
        world.flush(0).await;
        let state = first(&world).await.state;
        assert_eq!(state, picofarm_proto::messages::StageState::Done);
        for instance in &world.instances {
            instance.catalog.close().await;
        }
    });
}

/// A worker takes its lease to another instance and returns it there. Its former instance claims
/// the tasks before it has received that news.
#[test]
fn an_instance_forgets_a_lease_that_ended_elsewhere_when_its_tasks_come_back() {
    block_on(async {
        let Some(mut world) = World::on_postgres().await else {
            return;
        };
        world.connect(0, 0).await;
        world.act(&Op::Credit(0)).await;
        let lease = world.workers[0].leases[0].clone();
        world.connect(0, 1).await;
        // One task comes back in its own range, the rest in the lease's range.
        let session = world.workers[0].session.unwrap().1;
        let failure = Failure {
            lease: lease.lease,
            index: lease.lo,
            kind: FailureKind::Interrupted,
            message: "no".into(),
            milliseconds: 0,
            shared: 0,
        };
        world.instances[1].core.failed(session, &failure, world.now);
        world.act(&Op::Release(0, 0)).await;
        world.beat(1).await;
        world.connect(1, 0).await;
        while world.instances[0]
            .catalog
            .job(world.jobs[0])
            .await
            .unwrap()
            .unwrap()
            .stages[0]
            .counts
            .pending
            > 0
        {
            world.act(&Op::Credit(1)).await;
        }
        world.check().await;
        let held = world.instances[0].core.leases.iter().count();
        assert_eq!(
            held,
            world.workers[1].leases.len(),
            "only the second worker has leases"
        );
        world.act(&Op::Pass(1_400)).await;
        world.end().await;
    });
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, max_shrink_iters: 200, ..ProptestConfig::default() })]

    #[test]
    fn every_task_is_committed_exactly_once_whatever_happens(greedy: bool, ops in prop::collection::vec(op(), 1..60)) {
        block_on(async {
            let folder = tempfile::tempdir().unwrap();
            World::on_sqlite(folder.path()).await.live(greedy, &ops).await;
        });
    }

    #[test]
    fn two_instances_on_one_database_commit_every_task_exactly_once(greedy: bool, ops in prop::collection::vec(op(), 1..80)) {
        block_on(async {
            let Some(world) = World::on_postgres().await else { return };
            world.live(greedy, &ops).await;
        });
    }
}
