//! Workers on which every task fails, and workers that end before their tasks do.

use picofarm_proto::messages::FailureKind;

use super::{
    block_on,
    world::{Op, SETTINGS, World},
};

impl World {
    /// Returns the entry of this worker in the output of `explain`.
    fn candidate(&self, w: usize) -> crate::core::Candidate {
        let core = &self.instances[0].core;
        let look = core.job_snapshot(self.jobs[0], None, None, self.now);
        let name = format!("w{w}");
        let mut candidates = look.candidates.into_iter();
        candidates.find(|c| c.name == name).unwrap()
    }

    async fn exception(&self, job: usize, task: u64) -> picofarm_catalog::Exception {
        let stage = picofarm_proto::ids::StageRef {
            job: self.jobs[job],
            stage: 0,
        };
        let record = self.instances[0].catalog.task(stage, task).await.unwrap();
        record.exception.unwrap()
    }

    /// Fails all tasks of a worker at once. Returns their number.
    async fn fail_all(&mut self, w: usize, kind: FailureKind) -> u64 {
        let mut failed = 0;
        for lease in std::mem::take(&mut self.workers[w].leases) {
            for index in lease.lo..lease.hi {
                failed += 1;
                self.fail_on(w, &lease, index, kind).await;
            }
        }
        failed
    }
}

#[test]
fn tasks_that_fail_on_one_worker_alone_are_not_charged_with_it() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.connect(0, 0).await;
        world.connect(1, 0).await;
        let mut failed = 0;
        for _ in 0..100 {
            world.act(&Op::Credit(0)).await;
            failed += world.fail_all(0, FailureKind::User).await;
            world.act(&Op::Beat(0)).await;
            world.act(&Op::Pass(5)).await;
        }
        assert!((3..=20).contains(&failed), "{failed} failures");
        let why = world.candidate(0).may_run.unwrap_err().words().to_owned();
        assert!(why.contains("failed on it one after another"), "{why}");
        let core = &world.instances[0].core;
        let entry = core.stages.values().next().unwrap();
        let charged = entry.exceptions().filter(|e| e.failures > 0);
        assert_eq!(charged.count(), 0, "another could run them");
        // The tasks fail there too, so they are charged now.
        for _ in 0..10 {
            world.act(&Op::Credit(1)).await;
            world.fail_all(1, FailureKind::User).await;
            world.act(&Op::Pass(50)).await;
        }
        let core = &world.instances[0].core;
        let entry = core.stages.values().next().unwrap();
        assert!(entry.exceptions().any(|e| e.failures > 0));
        world.close().await;
    });
}

#[test]
fn a_worker_that_gives_every_lease_back_gets_ever_fewer() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.connect(0, 0).await;
        let mut leases = 0;
        for _ in 0..1_500 {
            world.act(&Op::Credit(0)).await;
            leases += world.workers[0].leases.len();
            world.fail_all(0, FailureKind::Interrupted).await;
            world.now += 1;
        }
        // The longest rest of this world is a tenth of a second.
        assert!((5..=30).contains(&leases), "{leases}");
        let why = world.candidate(0).may_run.unwrap_err().words().to_owned();
        assert!(why.contains("gave back"), "{why}");
        world.close().await;
    });
}

#[test]
fn a_task_that_took_longer_than_a_worker_has_left_waits_for_one_that_has_more() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.workers[0].ends_in_ms = Some(3_000);
        world.connect(0, 0).await;
        world.act(&Op::Credit(0)).await;
        for _ in 0..6 {
            world.act(&Op::Beat(0)).await;
            world.act(&Op::Pass(400)).await;
        }
        world.act(&Op::Release(0, 0)).await;
        let exception = world.exception(0, 0).await;
        assert_eq!((exception.interruptions, exception.longest_ms), (1, 2_400));
        world.act(&Op::Drop(0, true)).await;
        // The next allocation is as long, except for its startup time.
        world.workers[1].ends_in_ms = Some(2_900);
        world.connect(1, 0).await;
        world.act(&Op::Credit(1)).await;
        assert!(world.workers[1].leases.is_empty(), "it would not end");
        let candidate = world.candidate(1);
        assert_eq!(candidate.lacks_time, Some(3_000));
        let why = candidate.may_run.unwrap_err().words().to_owned();
        assert!(why.contains("is taken to need 3 s"), "{why}");
        world.workers[2].ends_in_ms = Some(60_000);
        world.connect(2, 0).await;
        world.act(&Op::Credit(2)).await;
        assert_eq!(world.workers[2].leases.len(), 1);
        world.close().await;
    });
}

#[test]
fn a_task_that_is_interrupted_again_and_again_is_given_up() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.act(&Op::Pause(true)).await;
        let one = r#"{"name": "one", "scenes": {"kind": "primitive", "count": 1}, "render": {"renderer": "r"},
                      "output": {"store": "s", "dataset": "one"}}"#;
        world
            .submit_as(0, "ada", serde_json::from_str(one).unwrap())
            .await;
        let mut attempts = 0;
        for w in (0..3).cycle().take(60) {
            // Longer than the longest delay of a task.
            world.act(&Op::Pass(200)).await;
            world.connect(w, 0).await;
            world.act(&Op::Credit(w)).await;
            attempts += u32::from(!world.workers[usize::from(w)].leases.is_empty());
            world.act(&Op::Beat(w)).await;
            world.act(&Op::Pass(SETTINGS.lease_ms as u16 / 2)).await;
            world.act(&Op::Release(w, 0)).await;
            world.workers[usize::from(w)].leases.clear();
            world.act(&Op::Drop(w, true)).await;
        }
        assert_eq!(attempts, 20);
        let exception = world.exception(1, 0).await;
        assert!(exception.dead, "{exception:?}");
        assert_eq!((exception.interruptions, exception.failures), (20, 0));
        let said = exception.last_error;
        assert!(said.starts_with("interrupted 20 times"), "{said}");
        world.close().await;
    });
}

#[test]
fn a_frozen_worker_is_silent_after_its_lease_too() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let mut world = World::on_sqlite(folder.path()).await;
        world.connect(0, 0).await;
        world.act(&Op::Credit(0)).await;
        world.act(&Op::Pass(SETTINGS.lease_ms as u16 * 3)).await;
        let core = &world.instances[0].core;
        assert_eq!(core.leases.iter().count(), 0, "its lease has run out");
        let silent = Some(i64::from(SETTINGS.lease_ms) * 3);
        assert_eq!(world.candidate(0).silent_ms, silent);
        let note = &core.farm_snapshot(world.now).workers[0].note;
        assert!(note.starts_with("not heard of for 3 s"), "{note}");
        world.close().await;
    });
}
