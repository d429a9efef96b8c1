//! Demand follows the rules of leases: there is demand exactly if a new worker of the shape could
//! get a task.

use picofarm_proto::messages::{Abilities, FailureKind};
use proptest::prelude::*;

use super::{
    block_on,
    starving::{WAYS, job, ops},
    world::{Op, World},
};
use crate::core::{Demand, Shape};

/// The worker that connects after the history.
const NEW: u8 = 2;

/// Returns whether an operation concerns the new worker.
fn concerns_new(op: &Op) -> bool {
    match op {
        Op::Credit(w)
        | Op::Finish(w, ..)
        | Op::Fail(w, ..)
        | Op::Release(w, _)
        | Op::Beat(w)
        | Op::Drop(w, _)
        | Op::Connect(w, _)
        | Op::Ends(w, _) => *w == NEW,
        _ => false,
    }
}

impl World {
    /// Returns the abilities of a connected worker.
    fn abilities(&self, w: u8) -> Abilities {
        let mut workers = self.instances[0].core.workers.values();
        let worker = workers.find(|worker| worker.name == format!("w{w}"));
        worker.expect("it is connected").abilities.clone()
    }

    fn demand(&self, abilities: Abilities, lasts_ms: Option<u64>) -> Demand {
        let shape = Shape {
            pool: "w".into(),
            abilities,
            lasts_ms,
        };
        self.instances[0].core.demand(&shape, self.now)
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, max_shrink_iters: 200, ..ProptestConfig::default() })]

    #[test]
    fn there_is_demand_exactly_if_a_new_worker_could_get_a_task(
        jobs in prop::collection::vec((0..WAYS.len(), 0..2i32), 1..5),
        history in prop::collection::vec(ops(), 0..50),
    ) {
        block_on(async {
            let folder = tempfile::tempdir().unwrap();
            let mut world = World::on_sqlite(folder.path()).await;
            for (n, (way, priority)) in jobs.iter().enumerate() {
                let spec = job(&format!("j{n}"), *priority, WAYS[*way]);
                world.submit_as(0, "ada", spec).await;
            }
            for w in 0..=NEW {
                world.connect(w, 0).await;
            }
            let abilities = world.abilities(NEW);
            world.act(&Op::Drop(NEW, true)).await;
            for op in history.iter().filter(|op| !concerns_new(op)) {
                world.act(op).await;
            }
            // After news, the waiting tasks of every stage are known.
            world.act(&Op::InstanceBeats(0)).await;
            let demand = world.demand(abilities.clone(), None);
            assert!(!demand.unknown, "{demand:?}");
            let able = |s: &&crate::core::demand::StageDemand| s.refused.is_none() && s.room != Some(0);
            let demanded = demand.stages.iter().any(|s| able(&s));

            world.connect(NEW, 0).await;
            let core = &world.instances[0].core;
            let new = core.workers.iter().find(|(_, w)| w.name == format!("w{NEW}"));
            let new = *new.expect("it is connected").0;
            let stages: Vec<_> = core.stages.keys().copied().collect();
            let gets = stages.into_iter().any(|id| core.ready_for(id, new, world.now).known() > 0);
            assert_eq!(demanded, gets, "{demand:?}");
            world.close().await;
        });
    }
}

#[test]
fn idle_workers_count_once_and_tasks_that_do_not_fit_are_refused_with_the_reason() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.connect(0, 0).await;
        let abilities = world.abilities(0);
        world.act(&Op::InstanceBeats(0)).await;
        let before = world.demand(abilities.clone(), None);
        let [first] = &before.stages[..] else {
            panic!("one stage is open: {before:?}");
        };
        assert_eq!((&*first.stage, first.tasks), ("render", super::TASKS));
        assert_eq!((first.idle, &first.refused), (0, &None));
        assert_eq!(before.workers, [], "a worker named w0 is not of the pool w");

        // The worker takes a first task, whose duration is then known.
        world.act(&Op::Credit(0)).await;
        let lease = world.workers[0].leases[0].clone();
        let session = world.workers[0].session.unwrap().1;
        world.finish(0, session, &lease, lease.lo).await;
        world.act(&Op::InstanceBeats(0)).await;
        let after = world.demand(abilities.clone(), None);
        let seconds = after.stages[0].task_seconds.expect("one was measured");
        assert!(
            after.stages[0].tasks < super::TASKS && seconds > 0.0,
            "{after:?}"
        );

        let short = world.demand(abilities.clone(), Some((seconds * 1000.0) as u64));
        let why = short.stages[0].refused.as_deref().unwrap_or_default();
        assert!(why.contains("a task is taken to need"), "{short:?}");
        assert!(why.contains("`parts`"), "{short:?}");
        let long = world.demand(abilities.clone(), Some((seconds * 2000.0) as u64));
        assert_eq!(long.stages[0].refused, None, "{long:?}");

        let other = world.demand(Abilities::default(), None);
        let why = other.stages[0].refused.as_deref().unwrap_or_default();
        assert!(why.contains("the worker runs no render tasks"), "{other:?}");
        world.close().await;
    });
}

#[test]
fn tasks_that_were_interrupted_after_long_wait_for_workers_that_run_longer() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.connect(0, 0).await;
        let abilities = world.abilities(0);
        world.act(&Op::Credit(0)).await;
        let lease = world.workers[0].leases[0].clone();
        world.act(&Op::Beat(0)).await;
        world.act(&Op::Pass(500)).await;
        let cut = FailureKind::Interrupted;
        world.fail(&lease, lease.lo, cut).await;
        // The pause before the next attempt.
        world.act(&Op::Pass(200)).await;
        world.act(&Op::InstanceBeats(0)).await;
        let refused = |lasts_ms| {
            let demand = world.demand(abilities.clone(), Some(lasts_ms));
            let stage = demand.stages.first().expect("tasks wait").clone();
            stage.refused.is_some()
        };
        assert_eq!(
            (refused(400), refused(600), refused(700)),
            (true, true, false)
        );
        world.close().await;
    });
}
