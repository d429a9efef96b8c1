//! The SQLite catalog: what is committed stays, what conflicts leaves no trace, and who may open it.

use std::{collections::BTreeMap, sync::Arc};

use picofarm_catalog::{
    Catalog, CatalogError, Changes, EventQuery, Exception, Job, LeaseState, Mark, NewEvent, Output,
    Range, RangeState, ResultSet, Run, SqliteCatalog,
};
use picofarm_proto::{
    ids::{Epoch, Incarnation, JobId, RangeId, WorkerId},
    model::{EventKind, JobSpec, JobState},
};
use sqlx::Connection;
use uuid::Uuid;

fn spec(json: &str) -> JobSpec {
    serde_json::from_str(json).unwrap()
}

fn job() -> Job {
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
    }
}

fn range(id: u128, lo: u64, hi: u64, epoch: u64, state: RangeState) -> Range {
    Range {
        id: RangeId::from_uuid(Uuid::from_u128(id)),
        job: job().id,
        lo,
        hi,
        epoch: Epoch(epoch),
        crashes: 0,
        state,
    }
}

fn output(task: u64) -> Output {
    Output {
        job: job().id,
        task,
        manifest: [task as u8; 32],
        bytes: 7,
        seconds: 1.5,
        epoch: Epoch(1),
        adopted: false,
    }
}

fn submitted() -> Changes {
    Changes {
        jobs: vec![job()],
        ..Changes::default()
    }
}

async fn open(folder: &tempfile::TempDir) -> SqliteCatalog {
    SqliteCatalog::open(&folder.path().join("a/b/c.db"), "the test")
        .await
        .unwrap()
}

#[tokio::test]
async fn everything_is_there_after_reopening() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = open(&folder).await;
    let mut changes = submitted();
    let lease = LeaseState {
        worker: WorkerId::from_uuid(Uuid::from_u128(8)),
        incarnation: Incarnation::from_uuid(Uuid::from_u128(9)),
        until_ms: 77,
        marks: vec![Mark::Done, Mark::Reused, Mark::Left, Mark::Todo],
    };
    let ranges = [
        range(1, 0, 4, 3, RangeState::Leased(lease)),
        range(2, 4, 5, 0, RangeState::Pending { not_before_ms: 42 }),
        range(3, 5, 7, 1, RangeState::Done { reused: false }),
        range(4, 7, 8, 1, RangeState::Done { reused: true }),
        range(5, 8, 9, 1, RangeState::Dead),
    ];
    for range in &ranges {
        changes.put(range.clone());
    }
    let exception = Exception {
        job: job().id,
        task: 8,
        failures: 3,
        crashes: 1,
        dead: true,
        last_error: "no mesh".into(),
    };
    changes.exceptions.insert((job().id, 8), exception.clone());
    changes.outputs = vec![output(0), output(5), output(6)];
    catalog.commit(changes).await.unwrap();
    catalog.close().await;
    drop(catalog);
    let catalog = open(&folder).await;
    let snapshot = catalog.load().await.unwrap();
    assert_eq!(snapshot.jobs, [job()]);
    assert_eq!(snapshot.ranges, ranges);
    assert_eq!(snapshot.exceptions, [exception]);
    let set = ResultSet::of(&job().spec);
    let runs = catalog.output_runs(&set, 9).await.unwrap();
    assert_eq!(runs, [Run { lo: 0, hi: 1 }, Run { lo: 5, hi: 7 }]);
    let runs = catalog.output_runs(&set, 6).await.unwrap();
    assert_eq!(runs, [Run { lo: 0, hi: 1 }, Run { lo: 5, hi: 6 }]);
    assert_eq!(catalog.timing(&set).await.unwrap().mean(), Some(1.5));
    let found = catalog.manifests(&[(job().id, 5), (job().id, 4)]).await;
    assert_eq!(found.unwrap(), [Some([5; 32]), None]);
}

#[tokio::test]
async fn a_conflict_leaves_no_trace_and_harms_nobody_else() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = open(&folder).await;
    let mut changes = submitted();
    changes.put(range(1, 0, 9, 5, RangeState::Pending { not_before_ms: 0 }));
    changes.outputs = vec![output(0)];
    catalog.commit(changes).await.unwrap();
    let before = catalog.load().await.unwrap();
    let one = |changes: Changes| catalog.commit(changes);
    let mut twice = Changes {
        outputs: vec![output(1), output(0)],
        ..Changes::default()
    };
    twice.put(range(2, 0, 9, 5, RangeState::Dead));
    let mut stale = Changes::default();
    stale.put(range(1, 0, 9, 4, RangeState::Dead));
    let fine = Changes {
        outputs: vec![output(2)],
        ..Changes::default()
    };
    let (twice, stale, fine) = tokio::join!(one(twice), one(stale), one(fine));
    assert!(matches!(twice, Err(CatalogError::Conflict(_))), "{twice:?}");
    assert!(matches!(stale, Err(CatalogError::Conflict(_))), "{stale:?}");
    fine.unwrap();
    assert_eq!(catalog.load().await.unwrap().ranges, before.ranges);
    let runs = catalog.output_runs(&ResultSet::of(&job().spec), 9).await;
    assert_eq!(runs.unwrap(), [Run { lo: 0, hi: 1 }, Run { lo: 2, hi: 3 }]);
}

#[tokio::test]
async fn history_is_read_in_pages_and_by_task() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = open(&folder).await;
    let mut changes = submitted();
    let event = |kind, tasks| NewEvent {
        at_ms: 1,
        job: job().id,
        kind,
        tasks,
        worker: String::new(),
        seconds: 0.0,
        message: String::new(),
    };
    changes.events = vec![
        event(EventKind::Submitted, None),
        event(EventKind::Leased, Some(Run { lo: 0, hi: 3 })),
        event(EventKind::Committed, Some(Run { lo: 2, hi: 3 })),
        event(EventKind::Committed, Some(Run { lo: 1, hi: 2 })),
    ];
    catalog.commit(changes).await.unwrap();
    let mut query = EventQuery {
        job: job().id,
        after: 0,
        limit: 3,
        task: None,
    };
    let page = catalog.events(&query).await.unwrap();
    assert_eq!(page.len(), 3);
    query.after = page[2].sequence;
    let rest = catalog.events(&query).await.unwrap();
    assert_eq!((rest.len(), rest[0].task), (1, Some(1)));
    query.after = 0;
    query.task = Some(2);
    let kinds: Vec<_> = catalog.events(&query).await.unwrap();
    let kinds: Vec<_> = kinds.iter().map(|e| (e.kind, e.task)).collect();
    assert_eq!(
        kinds,
        [(EventKind::Leased, None), (EventKind::Committed, Some(2))]
    );
}

#[tokio::test]
async fn only_one_may_hold_it() {
    let folder = tempfile::tempdir().unwrap();
    let first = open(&folder).await;
    let path = folder.path().join("a/b/c.db");
    let error = SqliteCatalog::open(&path, "the second")
        .await
        .err()
        .unwrap();
    assert!(matches!(error, CatalogError::Held { .. }));
    assert!(error.to_string().contains("the test"), "{error}");
    first.close().await;
    drop(first);
    SqliteCatalog::open(&path, "the second").await.unwrap();
}

#[tokio::test]
async fn a_newer_schema_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = open(&folder).await;
    catalog.close().await;
    drop(catalog);
    let path = folder.path().join("a/b/c.db");
    let url = format!("sqlite://{}", path.display());
    let mut raw = sqlx::SqliteConnection::connect(&url).await.unwrap();
    sqlx::query("INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) VALUES (999, 'future', 1, x'00', 0)")
        .execute(&mut raw)
        .await
        .unwrap();
    raw.close().await.unwrap();
    let error = SqliteCatalog::open(&path, "x").await.err().unwrap();
    assert!(
        matches!(error, CatalogError::Newer { found: 999, .. }),
        "{error}"
    );
}

#[tokio::test]
async fn a_file_that_is_no_database_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notes.txt");
    let text = "dear diary ".repeat(100);
    std::fs::write(&path, &text).unwrap();
    let error = SqliteCatalog::open(&path, "x").await.err().unwrap();
    assert!(matches!(error, CatalogError::Unusable { .. }), "{error}");
    assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
}

#[tokio::test]
async fn every_kind_of_spec_is_read_back_as_written() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = open(&folder).await;
    let scenes = [
        r#"{"kind": "primitive", "count": 2, "seed": 18446744073709551615}"#,
        r#"{"kind": "furnished", "assets": "x", "min_specular": 2, "count": 1}"#,
        r#"{"kind": "files", "files": [{"path": "/a.glb", "sha256": "00"}]}"#,
    ];
    let mut specs = BTreeMap::new();
    for (i, scenes) in scenes.iter().enumerate() {
        let text = format!(
            r#"{{"name": "n", "scenes": {scenes}, "render": {{"samples": 4, "gate_start_m": 0.1}},
                "output": {{"store": "s", "dataset": "d"}}}}"#
        );
        let job = Job {
            id: JobId::from_uuid(Uuid::from_u128(i as u128)),
            spec: Arc::new(spec(&text)),
            ..job()
        };
        specs.insert(job.id, Arc::clone(&job.spec));
        let changes = Changes {
            jobs: vec![job],
            ..Changes::default()
        };
        catalog.commit(changes).await.unwrap();
    }
    for job in catalog.load().await.unwrap().jobs {
        assert_eq!(job.spec, specs[&job.id]);
    }
}
