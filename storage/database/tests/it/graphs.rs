//! Tests of multi-stage jobs, paused jobs and deleted jobs, on SQLite and Postgres.

use std::sync::Arc;

use picofarm_catalog::{
    Catalog, Changes, EventQuery, Job, Output, Range, RangeState, Recorded, ResultSet, Sight, Want,
};
use picofarm_database::{PostgresCatalog, SqliteCatalog, testing};
use picofarm_proto::{
    ids::{Epoch, JobId, RangeId, StageRef},
    messages::{EventKind, JobState, StageState},
};
use uuid::Uuid;

/// render (3 tasks) → noise (3 tasks) → split (1 task), and another rendering (2 tasks) that no
/// stage depends on.
fn job() -> Job {
    let text = r#"{"name": "n", "stage": [
        {"scenes": {"kind": "primitive", "count": 3}, "output": {"store": "s", "dataset": "a"}},
        {"name": "noise", "kind": "reprocess", "source": "render", "output": {"store": "s", "dataset": "b"}},
        {"name": "other", "scenes": {"kind": "primitive", "count": 2}, "output": {"store": "s", "dataset": "c"}},
        {"kind": "split", "source": "noise", "needs": ["noise"], "tolerate_dead": true,
         "split": {"fractions": [0.5, 0.25, 0.25]}}]}"#;
    Job {
        id: JobId::from_uuid(Uuid::from_u128(1)),
        spec_hash: "h".into(),
        spec: Arc::new(serde_json::from_str(text).unwrap()),
        state: JobState::Active,
        submitted_ms: 5,
        ended_ms: None,
        paused: false,
        user: "ada".into(),
    }
}

fn at(stage: u32) -> StageRef {
    StageRef {
        job: job().id,
        stage,
    }
}

fn pending(stage: u32) -> Range {
    Range {
        id: RangeId::from_uuid(Uuid::from_u128(100 + u128::from(stage))),
        stage: at(stage),
        lo: 0,
        hi: job().stages()[stage as usize].tasks,
        epoch: Epoch(0),
        crashes: 0,
        state: RangeState::Pending { not_before_ms: 0 },
    }
}

async fn submitted(catalog: &dyn Catalog) {
    catalog.load().await.unwrap();
    let ranges: Vec<Range> = (0..4).map(pending).collect();
    assert!(catalog.submit(&job(), &ranges, &[]).await.unwrap());
}

async fn states(catalog: &dyn Catalog) -> Vec<StageState> {
    let record = catalog.job(job().id).await.unwrap().unwrap();
    record.stages.iter().map(|s| s.state).collect()
}

async fn claim(catalog: &dyn Catalog, stage: u32) -> Vec<Range> {
    let want = Want {
        stage: at(stage),
        tasks: 99,
        now_ms: 100,
        force: false,
        suspects: true,
    };
    let claim = catalog.claim(&[want]).await.unwrap().remove(0);
    claim.owned.ranges
}

/// Finishes every task of a stage. Returns the stages that opened and the jobs that ended.
async fn done(catalog: &dyn Catalog, stage: u32, state: RangeState) -> (Vec<u32>, Vec<JobState>) {
    let mut changes = Changes::default();
    for range in claim(catalog, stage).await {
        changes.give(Range {
            state: state.clone(),
            ..range
        });
    }
    changes.perhaps_over.insert(at(stage), 50);
    let settled = catalog.commit(&changes).await.unwrap();
    (
        settled.opened.iter().map(|s| s.stage).collect(),
        settled.ends.iter().map(|e| e.state).collect(),
    )
}

const DONE: RangeState = RangeState::Done { reused: false };

async fn a_stage_waits_for_those_that_it_needs(catalog: &dyn Catalog) {
    use StageState::{Blocked, Done, Open};
    submitted(catalog).await;
    assert_eq!(states(catalog).await, [Open, Blocked, Open, Blocked]);
    assert!(claim(catalog, 1).await.is_empty());
    let free = catalog.beat(0, 100).await.unwrap().free;
    assert_eq!(
        free.into_iter()
            .map(|(stage, free)| (stage, free.ready))
            .collect::<Vec<_>>(),
        [(at(0), 3), (at(2), 2)]
    );
    assert_eq!(done(catalog, 0, DONE).await, (vec![1], vec![]));
    assert_eq!(states(catalog).await, [Done, Open, Open, Blocked]);
    let free = catalog.beat(0, 100).await.unwrap().free;
    assert_eq!(free[&at(1)].ready, 3);
    assert_eq!(done(catalog, 1, DONE).await, (vec![3], vec![]));
    assert_eq!(done(catalog, 3, DONE).await, (vec![], vec![]));
    assert_eq!(done(catalog, 2, DONE).await, (vec![], vec![JobState::Done]));
    assert_eq!(states(catalog).await, [Done, Done, Done, Done]);
    let query = EventQuery {
        job: Some(job().id),
        after: 0,
        limit: 99,
        task: None,
        stage: Some(1),
        newest: false,
        logs: false,
        sight: Sight::All,
    };
    let events = catalog.events(&query).await.unwrap();
    let lines: Vec<_> = events.iter().map(|e| (e.kind, e.stage)).collect();
    assert_eq!(lines, [(EventKind::Opened, Some(1))]);
}

async fn what_needs_a_dead_task_is_not_begun_until_it_is_tried_again(catalog: &dyn Catalog) {
    use StageState::{Blocked, Done, Failed, Open};
    submitted(catalog).await;
    assert_eq!(done(catalog, 0, RangeState::Dead).await, (vec![], vec![]));
    // The independent rendering continues to its end, and then the job ends.
    let ended = done(catalog, 2, DONE).await;
    assert_eq!(ended, (vec![], vec![JobState::Failed]));
    assert_eq!(states(catalog).await, [Failed, Blocked, Done, Blocked]);
    let record = catalog.job(job().id).await.unwrap().unwrap();
    let counts = record.counts();
    assert_eq!(
        (counts.total, counts.done, counts.dead, counts.pending),
        (9, 2, 3, 4)
    );
    assert_eq!(catalog.retry(job().id, 60).await.unwrap(), 3);
    assert_eq!(states(catalog).await, [Open, Blocked, Done, Blocked]);
    assert_eq!(done(catalog, 0, DONE).await, (vec![1], vec![]));
    // A stage that tolerates dead tasks begins anyway.
    assert_eq!(done(catalog, 1, RangeState::Dead).await, (vec![3], vec![]));
    assert_eq!(
        done(catalog, 3, DONE).await,
        (vec![], vec![JobState::Failed])
    );
}

async fn a_held_job_gives_nothing_until_it_goes_on(catalog: &dyn Catalog) {
    submitted(catalog).await;
    let id = job().id;
    assert!(catalog.pause(id, true, "by ada", 60).await.unwrap());
    assert!(
        !catalog.pause(id, true, "by ada", 61).await.unwrap(),
        "once"
    );
    assert!(claim(catalog, 0).await.is_empty());
    assert!(catalog.beat(0, 100).await.unwrap().active[&id]);
    assert!(catalog.job(id).await.unwrap().unwrap().job.paused);
    assert!(catalog.pause(id, false, "by ada", 62).await.unwrap());
    assert_eq!(claim(catalog, 0).await.len(), 1);
    assert!(!catalog.beat(0, 100).await.unwrap().active[&id]);
    assert!(catalog.cancel(id, "enough", 63).await.unwrap());
    assert!(
        !catalog.pause(id, true, "", 64).await.unwrap(),
        "it has ended"
    );
    let query = EventQuery {
        job: Some(id),
        after: 0,
        limit: 99,
        task: None,
        stage: None,
        newest: false,
        logs: false,
        sight: Sight::All,
    };
    let events = catalog.events(&query).await.unwrap();
    let lines: Vec<_> = events.iter().map(|e| (e.kind, &*e.message)).collect();
    assert_eq!(
        lines,
        [
            (EventKind::Paused, "by ada"),
            (EventKind::Resumed, "by ada"),
            (EventKind::Cancelled, "enough")
        ]
    );
}

async fn forgotten_jobs_leave_their_outputs(catalog: &dyn Catalog) {
    submitted(catalog).await;
    assert_eq!(catalog.unfinished_jobs("ada").await.unwrap(), 1);
    assert_eq!(catalog.unfinished_jobs("eve").await.unwrap(), 0);
    let output = Output {
        stage: at(0),
        task: 1,
        manifest: [1; 32],
        bytes: 7,
        seconds: 1.5,
        epoch: Epoch(1),
        adopted: false,
        checked: false,
    };
    let changes = Changes {
        outputs: vec![output],
        ..Changes::default()
    };
    catalog.commit(&changes).await.unwrap();
    assert_eq!(catalog.forget(1000).await.unwrap().jobs, 0, "it is active");
    catalog.cancel(job().id, "", 70).await.unwrap();
    assert_eq!(catalog.unfinished_jobs("ada").await.unwrap(), 0);
    assert_eq!(catalog.forget(70).await.unwrap().jobs, 0, "it ended then");
    assert_eq!(catalog.forget(71).await.unwrap().jobs, 1);
    assert_eq!(catalog.job(job().id).await.unwrap(), None);
    let set = ResultSet::of_stage(&job().spec.stages[0]);
    assert_eq!(catalog.output_runs(&set, 9).await.unwrap().len(), 1);
    // When the same job's tasks are claimed again, it finds the outputs that were checked in the
    // store, unless it must ignore them.
    let seen = Recorded {
        task: 1,
        manifest: [1; 32],
        checked: false,
    };
    catalog.mark_checked(&set, &[seen]).await.unwrap();
    let id = JobId::from_uuid(Uuid::from_u128(2));
    let stage = StageRef { job: id, stage: 0 };
    let range = Range {
        stage,
        ..pending(0)
    };
    let twin = Job { id, ..job() };
    assert!(catalog.submit(&twin, &[range], &[]).await.unwrap());
    let mut want = Want {
        stage,
        tasks: 1,
        now_ms: 100,
        force: true,
        suspects: true,
    };
    let first = catalog.claim(&[want]).await.unwrap().remove(0);
    assert!(first.existing.is_empty() && first.owned.ranges.len() == 1);
    want.force = false;
    let second = catalog.claim(&[want]).await.unwrap().remove(0);
    assert_eq!((second.existing[0].lo, second.existing[0].hi), (1, 2));
}

/// Generates a test of each guarantee for each catalog.
macro_rules! promises {
    ($($name:ident)*) => {
        mod sqlite {
            use super::*;
            $(#[tokio::test]
            async fn $name() {
                let dir = tempfile::tempdir().unwrap();
                let catalog = SqliteCatalog::open(&dir.path().join("c.db"), "test").await.unwrap();
                super::$name(&catalog).await;
                catalog.close().await;
            })*
        }
        mod postgres {
            use super::*;
            $(#[tokio::test]
            async fn $name() {
                let Some(url) = testing::postgres().await else { return };
                let catalog = PostgresCatalog::open(&url, "test").await.unwrap();
                super::$name(&catalog).await;
                catalog.close().await;
            })*
        }
    };
}

promises! {
    a_stage_waits_for_those_that_it_needs
    what_needs_a_dead_task_is_not_begun_until_it_is_tried_again
    a_held_job_gives_nothing_until_it_goes_on
    forgotten_jobs_leave_their_outputs
}
