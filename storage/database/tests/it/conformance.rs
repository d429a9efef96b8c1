//! Tests of the guarantees of every catalog, on SQLite and Postgres, and of Postgres' guarantees
//! for several instances.

use std::sync::Arc;

use picofarm_catalog::{
    Catalog, CatalogError, Changes, EventQuery, Exception, Free, Job, JobQuery, LeaseState, Mark,
    NewEvent, Output, Range, RangeState, Recorded, ResultSet, Run, Settled, Sight, Want, Worker,
};
use picofarm_database::{PostgresCatalog, SqliteCatalog, testing};
use picofarm_proto::{
    ids::{Epoch, Incarnation, JobId, RangeId, StageRef, WorkerId},
    messages::{EventKind, JobState},
    spec::JobSpec,
};
use uuid::Uuid;

fn spec(json: &str) -> JobSpec {
    serde_json::from_str(json).unwrap()
}

pub(crate) fn job() -> Job {
    Job {
        id: JobId::from_uuid(Uuid::from_u128(1)),
        spec_hash: "h".into(),
        spec: Arc::new(spec(
            r#"{"name": "n", "scenes": {"kind": "furnished", "assets": "parametric-1", "count": 9, "fov_deg": 60.1},
                "render": {"error": 0.1, "renderer": "r"}, "output": {"store": "s", "dataset": "d"}}"#,
        )),
        state: JobState::Active,
        submitted_ms: 5,
        ended_ms: None,
        paused: false,
        user: "ada".into(),
    }
}

pub(crate) fn set() -> ResultSet {
    ResultSet::of_stage(&job().spec.stages[0])
}

fn stage() -> StageRef {
    StageRef {
        job: job().id,
        stage: 0,
    }
}

fn range(id: u128, lo: u64, hi: u64, state: RangeState) -> Range {
    Range {
        id: RangeId::from_uuid(Uuid::from_u128(id)),
        stage: stage(),
        lo,
        hi,
        epoch: Epoch(3),
        crashes: 0,
        state,
    }
}

pub(crate) fn pending(id: u128, lo: u64, hi: u64) -> Range {
    range(id, lo, hi, RangeState::Pending { not_before_ms: 0 })
}

fn leased(mut range: Range, marks: &[Mark]) -> Range {
    range.epoch.0 += 1;
    range.state = RangeState::Leased(LeaseState {
        worker: worker().id,
        incarnation: worker().incarnation,
        until_ms: 77,
        marks: marks.to_vec(),
    });
    range
}

fn worker() -> Worker {
    Worker {
        id: WorkerId::from_uuid(Uuid::from_u128(8)),
        incarnation: Incarnation::from_uuid(Uuid::from_u128(9)),
        name: "w".into(),
        last_seen_ms: 4,
    }
}

pub(crate) fn output(task: u64) -> Output {
    Output {
        stage: stage(),
        task,
        manifest: [task as u8; 32],
        bytes: 7,
        seconds: 1.5,
        epoch: Epoch(1),
        adopted: false,
        checked: false,
    }
}

fn want(tasks: u64) -> Want {
    Want {
        stage: stage(),
        tasks,
        now_ms: 100,
        force: false,
        suspects: true,
    }
}

pub(crate) async fn submitted(catalog: &dyn Catalog, ranges: &[Range]) {
    catalog.load().await.unwrap();
    assert!(catalog.submit(&job(), ranges, &[]).await.unwrap());
}

/// Claims everything available.
async fn claim_all(catalog: &dyn Catalog) -> Vec<Range> {
    catalog
        .claim(&[want(99)])
        .await
        .unwrap()
        .remove(0)
        .owned
        .ranges
}

async fn what_is_written_is_read_again_by_the_next_life(catalog: &dyn Catalog) {
    let (a, b) = (pending(1, 0, 4), pending(2, 4, 9));
    submitted(catalog, &[a.clone(), b.clone()]).await;
    assert_eq!(claim_all(catalog).await, [a.clone(), b.clone()]);
    let exception = Exception {
        stage: stage(),
        task: 2,
        failures: 3,
        crashes: 1,
        interruptions: 2,
        longest_ms: 60_000,
        dead: false,
        last_error: "no mesh".into(),
    };
    let lease = leased(a, &[Mark::Done, Mark::Reused, Mark::Left, Mark::Todo]);
    let mut changes = Changes {
        outputs: vec![output(0), output(5), output(6)],
        ..Changes::default()
    };
    changes.put(lease.clone());
    changes.exceptions.insert((stage(), 2), exception.clone());
    changes.workers.insert(worker().id, worker());
    assert_eq!(catalog.commit(&changes).await.unwrap(), Settled::default());
    let snapshot = catalog.load().await.unwrap();
    assert_eq!(snapshot.jobs, [job()]);
    assert_eq!(snapshot.owned.ranges.len(), 2);
    assert!(snapshot.owned.ranges.contains(&lease) && snapshot.owned.ranges.contains(&b));
    assert_eq!(snapshot.owned.exceptions, [exception]);
    assert_eq!(snapshot.workers, [worker()]);
    let runs = catalog.output_runs(&set(), 9).await.unwrap();
    assert_eq!(runs, [Run { lo: 0, hi: 1 }, Run { lo: 5, hi: 7 }]);
    let runs = catalog.output_runs(&set(), 6).await.unwrap();
    assert_eq!(runs, [Run { lo: 0, hi: 1 }, Run { lo: 5, hi: 6 }]);
    assert_eq!(catalog.timing(&set()).await.unwrap().mean(), Some(1.5));
    let found = catalog.manifests(&[(stage(), 5), (stage(), 4)]).await;
    assert_eq!(found.unwrap(), [Some([5; 32]), None]);
    let record = catalog.job(job().id).await.unwrap().unwrap();
    let c = record.counts();
    assert_eq!(
        (c.total, c.done, c.reused, c.leased, c.pending),
        (8, 2, 1, 1, 5)
    );
}

async fn a_claim_takes_what_it_names_from_the_front_and_says_what_is_left(catalog: &dyn Catalog) {
    let late = range(3, 8, 9, RangeState::Pending { not_before_ms: 200 });
    submitted(catalog, &[pending(1, 0, 2), pending(2, 2, 8), late]).await;
    let known = Changes {
        outputs: vec![output(1), output(3)],
        ..Changes::default()
    };
    catalog.commit(&known).await.unwrap();
    // An output that was not checked in its store is not listed.
    let seen = [1, 3].map(|task| Recorded {
        task,
        manifest: [task as u8; 32],
        checked: false,
    });
    catalog.mark_checked(&set(), &seen).await.unwrap();
    let claim = catalog.claim(&[want(5)]).await.unwrap().remove(0);
    let spans: Vec<_> = claim.owned.ranges.iter().map(|r| (r.lo, r.hi)).collect();
    assert_eq!(spans, [(0, 2), (2, 5)]);
    assert_eq!(claim.existing, [Run { lo: 1, hi: 2 }, Run { lo: 3, hi: 4 }]);
    let later = Free {
        later: 1,
        next_ms: Some(200),
        ..Free::default()
    };
    assert_eq!(claim.left, Free { ready: 3, ..later });
    let spans: Vec<_> = claim_all(catalog)
        .await
        .iter()
        .map(|r| (r.lo, r.hi))
        .collect();
    assert_eq!(spans, [(5, 8)], "what may not run yet is not given");
    assert_eq!(
        catalog.beat(0, 100).await.unwrap().free[&stage()],
        later,
        "what waits is not ready"
    );
    let due = Free {
        ready: 1,
        ..Free::default()
    };
    assert_eq!(catalog.beat(0, 200).await.unwrap().free[&stage()], due);
}

async fn ranges_under_suspicion_are_counted_and_claimed_by_themselves(catalog: &dyn Catalog) {
    let suspect = Range {
        crashes: 1,
        ..pending(2, 4, 9)
    };
    submitted(catalog, &[pending(1, 0, 4), suspect]).await;
    let plain = Want {
        suspects: false,
        ..want(99)
    };
    let claim = catalog.claim(&[plain]).await.unwrap().remove(0);
    let spans: Vec<_> = claim.owned.ranges.iter().map(|r| (r.lo, r.hi)).collect();
    assert_eq!(spans, [(0, 4)]);
    let left = Free {
        suspects: 5,
        ..Free::default()
    };
    assert_eq!(claim.left, left);
    let spans: Vec<_> = claim_all(catalog)
        .await
        .iter()
        .map(|r| (r.lo, r.hi))
        .collect();
    assert_eq!(spans, [(4, 9)]);
}

async fn what_is_given_back_merges_with_its_neighbours(catalog: &dyn Catalog) {
    submitted(catalog, &[pending(1, 0, 9)]).await;
    for _ in 0..3 {
        catalog.claim(&[want(3)]).await.unwrap();
    }
    let owned = catalog.load().await.unwrap().owned.ranges;
    assert_eq!(owned.len(), 3);
    let mut changes = Changes::default();
    for range in [&owned[2], &owned[0], &owned[1]] {
        changes.give(range.clone());
    }
    catalog.commit(&changes).await.unwrap();
    let whole = claim_all(catalog).await;
    assert_eq!((whole.len(), whole[0].lo, whole[0].hi), (1, 0, 9));
    assert_eq!(whole[0].epoch, Epoch(3));
}

async fn a_conflict_leaves_no_trace(catalog: &dyn Catalog) {
    submitted(catalog, &[pending(1, 0, 9)]).await;
    let mine = claim_all(catalog).await.remove(0);
    let first = Changes {
        outputs: vec![output(0)],
        ..Changes::default()
    };
    catalog.commit(&first).await.unwrap();
    // Another manifest for a task that already has one.
    let mut other = Changes {
        outputs: vec![
            output(1),
            Output {
                manifest: [9; 32],
                ..output(0)
            },
        ],
        ..Changes::default()
    };
    other.put(leased(mine.clone(), &[Mark::Todo; 9]));
    let refused = catalog.commit(&other).await;
    assert!(
        matches!(refused, Err(CatalogError::Conflict(_))),
        "{refused:?}"
    );
    // A range that the catalog does not know as owned by this instance.
    let mut stale = Changes {
        outputs: vec![output(2)],
        ..Changes::default()
    };
    stale.give(range(77, 0, 9, RangeState::Dead));
    let refused = catalog.commit(&stale).await;
    assert!(
        matches!(refused, Err(CatalogError::Conflict(_))),
        "{refused:?}"
    );
    assert_eq!(catalog.load().await.unwrap().owned.ranges, [mine]);
    let runs = catalog.output_runs(&set(), 9).await;
    assert_eq!(runs.unwrap(), [Run { lo: 0, hi: 1 }]);
    // The same manifest again changes nothing.
    let again = Changes {
        outputs: vec![output(0)],
        ..Changes::default()
    };
    catalog.commit(&again).await.unwrap();
}

async fn a_job_ends_with_its_last_task(catalog: &dyn Catalog) {
    submitted(catalog, &[pending(1, 0, 9)]).await;
    let mine = claim_all(catalog).await.remove(0);
    let id = job().id;
    let mut changes = Changes::default();
    changes.perhaps_over.insert(stage(), 50);
    assert_eq!(
        catalog.commit(&changes).await.unwrap(),
        Settled::default(),
        "tasks are pending"
    );
    let dead = range(2, 8, 9, RangeState::Dead);
    changes.minted.insert(dead.id);
    changes.give(dead);
    changes.give(Range {
        hi: 8,
        state: RangeState::Done { reused: false },
        ..mine
    });
    let ended = catalog.commit(&changes).await.unwrap().ends;
    assert_eq!(
        (ended[0].job, ended[0].state, ended[0].at_ms),
        (id, JobState::Failed, 50)
    );
    assert!(catalog.beat(0, 100).await.unwrap().active.is_empty());
    let record = catalog.job(id).await.unwrap().unwrap();
    assert_eq!(
        (
            record.counts().total,
            record.counts().done,
            record.counts().dead
        ),
        (9, 8, 1)
    );
    assert_eq!(record.job.ended_ms, Some(50));
    // The same job may be submitted again; then the first one cannot be reactivated.
    let twin = Job {
        id: JobId::from_uuid(Uuid::from_u128(2)),
        ..job()
    };
    assert!(catalog.submit(&twin, &[], &[]).await.unwrap());
    let refused = catalog.retry(id, 60).await;
    assert!(
        matches!(refused, Err(CatalogError::Conflict(_))),
        "{refused:?}"
    );
}

async fn given_up_tasks_can_be_tried_again(catalog: &dyn Catalog) {
    submitted(catalog, &[pending(1, 0, 2), pending(2, 2, 9)]).await;
    let owned = claim_all(catalog).await;
    let mut changes = Changes::default();
    let ends = [RangeState::Dead, RangeState::Done { reused: true }];
    for (range, state) in owned.into_iter().zip(ends) {
        changes.give(Range { state, ..range });
    }
    changes.perhaps_over.insert(stage(), 50);
    catalog.commit(&changes).await.unwrap();
    let id = job().id;
    let state = async || catalog.job(id).await.unwrap().unwrap().job.state;
    assert_eq!(state().await, JobState::Failed, "nothing is to be run");
    assert_eq!(catalog.retry(id, 60).await.unwrap(), 2);
    assert_eq!(state().await, JobState::Active);
    let spans: Vec<_> = claim_all(catalog)
        .await
        .iter()
        .map(|r| (r.lo, r.hi))
        .collect();
    assert_eq!(spans, [(0, 2)]);
    assert!(catalog.cancel(id, "", 70).await.unwrap());
    assert!(!catalog.cancel(id, "", 71).await.unwrap(), "once");
    assert_eq!(state().await, JobState::Cancelled);
    assert!(
        claim_all(catalog).await.is_empty(),
        "nothing of a cancelled job is given"
    );
}

async fn the_same_spec_is_recorded_once(catalog: &dyn Catalog) {
    submitted(catalog, &[pending(1, 0, 9)]).await;
    let twin = Job {
        id: JobId::from_uuid(Uuid::from_u128(2)),
        ..job()
    };
    assert!(
        !catalog
            .submit(&twin, &[pending(2, 0, 9)], &[])
            .await
            .unwrap()
    );
    let all = JobQuery {
        limit: 9,
        ..JobQuery::default()
    };
    assert_eq!(catalog.page(&all).await.unwrap().jobs.len(), 1);
    assert_eq!(catalog.job_with("h").await.unwrap(), Some(job()));
    assert_eq!(catalog.job_with("x").await.unwrap(), None);
    assert_eq!(catalog.jobs_at("s", "d").await.unwrap(), [job()]);
    assert_eq!(catalog.jobs_at("s", "x").await.unwrap(), []);
}

async fn history_is_read_in_pages_and_by_task(catalog: &dyn Catalog) {
    let event = |kind, tasks| NewEvent {
        tasks,
        ..NewEvent::new(job().id, 1, kind, "in words".into())
    };
    catalog.load().await.unwrap();
    let submitted = [event(EventKind::Submitted, None)];
    catalog
        .submit(&job(), &[pending(1, 0, 9)], &submitted)
        .await
        .unwrap();
    let changes = Changes {
        events: vec![
            event(EventKind::Leased, Some(Run { lo: 0, hi: 3 })),
            event(EventKind::Committed, Some(Run { lo: 2, hi: 3 })),
            event(EventKind::Committed, Some(Run { lo: 1, hi: 2 })),
        ],
        ..Changes::default()
    };
    catalog.commit(&changes).await.unwrap();
    let mut query = EventQuery {
        job: Some(job().id),
        after: 0,
        limit: 3,
        task: None,
        stage: None,
        newest: false,
        logs: false,
        sight: Sight::All,
    };
    let page = catalog.events(&query).await.unwrap();
    assert_eq!(page.len(), 3);
    query.after = page[2].sequence;
    let rest = catalog.events(&query).await.unwrap();
    assert_eq!((rest.len(), rest[0].task), (1, Some(1)));
    query.after = 0;
    query.task = Some(2);
    let events = catalog.events(&query).await.unwrap();
    let kinds: Vec<_> = events
        .iter()
        .map(|e| (e.kind, e.task, e.lo, e.hi))
        .collect();
    assert_eq!(
        kinds,
        [
            (EventKind::Leased, None, Some(0), Some(3)),
            (EventKind::Committed, Some(2), Some(2), Some(3))
        ]
    );
    // The last events of all jobs, still in order.
    query = EventQuery {
        job: None,
        limit: 2,
        task: None,
        stage: None,
        newest: true,
        ..query
    };
    let last = catalog.events(&query).await.unwrap();
    let tasks: Vec<_> = last.iter().map(|e| (e.job, e.task)).collect();
    assert_eq!(tasks, [(job().id, Some(2)), (job().id, Some(1))]);
    assert!(last[0].sequence < last[1].sequence);
    // Log messages of tasks are only returned on request.
    let changes = Changes {
        events: vec![event(EventKind::Log, Some(Run { lo: 1, hi: 2 }))],
        ..Changes::default()
    };
    catalog.commit(&changes).await.unwrap();
    assert_eq!(catalog.events(&query).await.unwrap(), last);
    query.logs = true;
    let with_log = catalog.events(&query).await.unwrap();
    assert_eq!(with_log[0], last[1]);
    assert_eq!(
        (with_log[1].kind, with_log[1].task),
        (EventKind::Log, Some(1))
    );
}

async fn what_holds_tasks_up_and_what_became_of_one_can_be_asked(catalog: &dyn Catalog) {
    catalog.load().await.unwrap();
    let later = range(3, 8, 9, RangeState::Pending { not_before_ms: 700 });
    let lease = leased(
        range(1, 0, 3, RangeState::Dead),
        &[Mark::Todo, Mark::Left, Mark::Done],
    );
    let ranges = [pending(1, 0, 3), pending(2, 3, 8), pending(3, 8, 9)];
    catalog.submit(&job(), &ranges, &[]).await.unwrap();
    let want = Want {
        stage: stage(),
        tasks: 9,
        now_ms: 0,
        force: false,
        suspects: true,
    };
    catalog.claim(&[want]).await.unwrap();
    let mut changes = Changes::default();
    changes.put(lease.clone());
    changes.put(later.clone());
    changes.give(pending(2, 3, 8));
    changes.put(pending(9, 1, 2));
    changes
        .minted
        .insert(RangeId::from_uuid(Uuid::from_u128(9)));
    for (task, crashes) in [(1, 1), (8, 2)] {
        let exception = Exception {
            stage: stage(),
            task,
            failures: 1,
            crashes,
            interruptions: 0,
            longest_ms: 0,
            dead: false,
            last_error: "no light".into(),
        };
        changes.exceptions.insert((stage(), task), exception);
    }
    let output = Output {
        stage: stage(),
        task: 2,
        manifest: [7; 32],
        bytes: 10,
        seconds: 1.5,
        epoch: Epoch(4),
        adopted: false,
        checked: false,
    };
    changes.outputs.push(output.clone());
    catalog.commit(&changes).await.unwrap();

    let holdups = catalog.holdups(job().id, 600).await.unwrap();
    assert_eq!(
        (holdups.ready, holdups.waiting, holdups.next_ms),
        (6, 1, Some(700))
    );
    let failed: Vec<_> = holdups.failed.iter().map(|e| e.task).collect();
    assert_eq!(failed, [8, 1]);
    let holdups = catalog.holdups(job().id, 700).await.unwrap();
    assert_eq!(
        (holdups.ready, holdups.waiting, holdups.next_ms),
        (7, 0, None)
    );

    let task = async |task| catalog.task(stage(), task).await.unwrap();
    let left = task(1).await;
    assert_eq!(
        left.range,
        Some(pending(9, 1, 2)),
        "what left a lease is found where it is"
    );
    assert_eq!(left.exception.map(|e| e.crashes), Some(1));
    let done = task(2).await;
    assert_eq!((done.range, done.output), (Some(lease), Some(output)));
    assert_eq!(task(8).await.range, Some(later));
    assert_eq!(task(99).await, picofarm_catalog::TaskRecord::default());
}

async fn every_kind_of_spec_is_read_back_as_written(catalog: &dyn Catalog) {
    catalog.load().await.unwrap();
    let scenes = [
        r#"{"kind": "primitive", "count": 2, "seed": 18446744073709551615}"#,
        r#"{"kind": "furnished", "assets": "x", "min_specular": 2, "count": 1}"#,
        r#"{"kind": "files", "files": [{"path": "/a.glb", "sha256": "00"}]}"#,
    ];
    for (i, scenes) in scenes.iter().enumerate() {
        let text = format!(
            r#"{{"name": "n", "scenes": {scenes}, "render": {{"samples": 4, "gate_start_m": 0.1}},
                "output": {{"store": "s", "dataset": "d"}}}}"#
        );
        let job = Job {
            id: JobId::from_uuid(Uuid::from_u128(i as u128)),
            spec_hash: i.to_string(),
            spec: Arc::new(spec(&text)),
            ..job()
        };
        let range = Range {
            stage: StageRef {
                job: job.id,
                stage: 0,
            },
            ..pending(i as u128, 0, 1)
        };
        assert!(catalog.submit(&job, &[range], &[]).await.unwrap());
        let record = catalog.job(job.id).await.unwrap().unwrap();
        assert_eq!(record.job, job);
    }
}

/// Generates a test of each guarantee for each catalog.
macro_rules! promises {
    ($($name:ident)*) => {
        mod sqlite {
            use picofarm_catalog::Catalog;
            use picofarm_database::SqliteCatalog;
            $(#[tokio::test]
            async fn $name() {
                let folder = tempfile::tempdir().unwrap();
                let catalog = SqliteCatalog::open(&folder.path().join("c.db"), "test").await.unwrap();
                super::$name(&catalog).await;
                catalog.close().await;
            })*
        }
        mod postgres {
            use picofarm_catalog::Catalog;
            use picofarm_database::{PostgresCatalog, testing};
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
    what_is_written_is_read_again_by_the_next_life
    a_claim_takes_what_it_names_from_the_front_and_says_what_is_left
    ranges_under_suspicion_are_counted_and_claimed_by_themselves
    what_is_given_back_merges_with_its_neighbours
    a_conflict_leaves_no_trace
    a_job_ends_with_its_last_task
    given_up_tasks_can_be_tried_again
    the_same_spec_is_recorded_once
    history_is_read_in_pages_and_by_task
    what_holds_tasks_up_and_what_became_of_one_can_be_asked
    every_kind_of_spec_is_read_back_as_written
}

#[tokio::test]
async fn a_catalog_survives_its_process() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.db");
    let catalog = SqliteCatalog::open(&path, "test").await.unwrap();
    submitted(&catalog, &[pending(1, 0, 9)]).await;
    let mine = claim_all(&catalog).await;
    catalog.close().await;
    drop(catalog);
    let catalog = SqliteCatalog::open(&path, "test").await.unwrap();
    assert_eq!(catalog.load().await.unwrap().owned.ranges, mine);
}

/// Returns two instances on one database, and its URL.
async fn two() -> Option<(PostgresCatalog, PostgresCatalog, String)> {
    let url = testing::postgres().await?;
    let (a, b) = tokio::join!(
        PostgresCatalog::open(&url, "a"),
        PostgresCatalog::open(&url, "b")
    );
    let (a, b) = (a.unwrap(), b.unwrap());
    submitted(&a, &[pending(1, 0, 4), pending(2, 5, 9)]).await;
    b.load().await.unwrap();
    Some((a, b, url))
}

#[tokio::test]
async fn two_instances_never_claim_the_same_task() {
    let Some((a, b, _)) = two().await else { return };
    let wants = [want(1)];
    let mut seen = vec![];
    for _ in 0..20 {
        let (x, y) = tokio::join!(a.claim(&wants), b.claim(&wants));
        for claim in [x.unwrap(), y.unwrap()].into_iter().flatten() {
            seen.extend(claim.owned.ranges.iter().flat_map(|r| r.lo..r.hi));
        }
    }
    seen.sort_unstable();
    assert_eq!(seen, [0, 1, 2, 3, 5, 6, 7, 8]);
    assert_eq!(a.beat(2, 100).await.unwrap().instances, 2);
    assert_eq!(b.beat(3, 100).await.unwrap().workers, 5);
}

#[tokio::test]
async fn a_lost_instance_is_fenced_and_its_ranges_belong_to_another() {
    let Some((a, b, url)) = two().await else {
        return;
    };
    let mine = claim_all(&a).await;
    let instance = a.load().await.unwrap().instance;
    testing::lose_instance(&url, instance).await;
    let mut late = Changes {
        outputs: vec![output(0)],
        ..Changes::default()
    };
    late.put(leased(
        mine[0].clone(),
        &[Mark::Done, Mark::Todo, Mark::Todo, Mark::Todo],
    ));
    assert_eq!(b.beat(0, 100).await.unwrap().taken.ranges.len(), 2);
    assert!(matches!(a.commit(&late).await, Err(CatalogError::Fenced)));
    assert!(matches!(a.beat(0, 100).await, Err(CatalogError::Fenced)));
    assert!(matches!(
        a.claim(&[want(1)]).await,
        Err(CatalogError::Fenced)
    ));
    // In its next life it owns nothing, and changes to its former ranges are refused.
    assert_eq!(a.load().await.unwrap().owned.ranges, []);
    assert!(matches!(
        a.commit(&late).await,
        Err(CatalogError::Conflict(_))
    ));
    assert!(b.output_runs(&set(), 9).await.unwrap().is_empty());
}

#[tokio::test]
async fn a_worker_takes_its_leases_along_and_the_former_instance_learns_of_it() {
    let Some((a, b, _)) = two().await else { return };
    let mine = claim_all(&a).await;
    let lease = leased(mine[0].clone(), &[Mark::Todo; 4]);
    let mut changes = Changes::default();
    changes.put(lease.clone());
    a.commit(&changes).await.unwrap();
    assert!(
        a.beat(1, 100)
            .await
            .unwrap()
            .leased
            .unwrap()
            .contains(&lease.id)
    );
    assert_eq!(
        b.adopt(worker().id).await.unwrap().ranges,
        std::slice::from_ref(&lease)
    );
    assert_eq!(
        b.adopt(worker().id).await.unwrap().ranges,
        [],
        "it is there already"
    );
    assert!(a.beat(1, 100).await.unwrap().leased.unwrap().is_empty());
    let mut late = Changes::default();
    late.put(leased(lease, &[Mark::Done; 4]));
    assert!(matches!(
        a.commit(&late).await,
        Err(CatalogError::Conflict(_))
    ));
}

#[tokio::test]
async fn an_instance_that_leaves_in_order_gives_back_what_nobody_runs() {
    let Some((a, b, _)) = two().await else { return };
    let mine = claim_all(&a).await;
    let mut changes = Changes::default();
    changes.put(leased(mine[0].clone(), &[Mark::Todo; 4]));
    a.commit(&changes).await.unwrap();
    a.close().await;
    assert_eq!(claim_all(&b).await.len(), 1, "the pending one");
    assert_eq!(
        b.beat(0, 100).await.unwrap().taken.ranges.len(),
        1,
        "the leased one"
    );
}

#[tokio::test]
async fn of_two_instances_that_finish_at_once_the_second_ends_the_job() {
    let Some((a, b, _)) = two().await else { return };
    let first = a
        .claim(&[want(4)])
        .await
        .unwrap()
        .remove(0)
        .owned
        .ranges
        .remove(0);
    let second = claim_all(&b).await.remove(0);
    let done = |range: Range| {
        let mut changes = Changes::default();
        changes.perhaps_over.insert(stage(), 50);
        changes.give(Range {
            state: RangeState::Done { reused: false },
            ..range
        });
        changes
    };
    let (first, second) = (done(first), done(second));
    let (x, y) = tokio::join!(a.commit(&first), b.commit(&second));
    assert_eq!(x.unwrap().ends.len() + y.unwrap().ends.len(), 1);
    assert_eq!(
        a.job(job().id).await.unwrap().unwrap().job.state,
        JobState::Done
    );
}
