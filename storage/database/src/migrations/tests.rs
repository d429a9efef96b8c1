//! Tests that committed steps never change, and that catalogs of every earlier level are upgraded.

use std::path::{Path, PathBuf};

use picofarm_catalog::{Catalog, JobRecord, ResultSet};
use picofarm_proto::{ids::JobId, messages::JobState, spec::JobSpec};
use sha2::{Digest, Sha256};
use sqlx::{Connection, SqliteConnection};
use uuid::Uuid;

use super::*;
use crate::SqliteCatalog;

const SPEC: &str = r#"{"name": "n",
    "scenes": {"kind": "furnished", "assets": "parametric-1", "count": 9, "fov_deg": 60.1},
    "render": {"error": 0.1, "renderer": "r"}, "output": {"store": "s", "dataset": "d"}}"#;

fn folder() -> PathBuf {
    let crate_folder = std::env::var("CARGO_MANIFEST_DIR").unwrap();
    Path::new(&crate_folder).join("migrations")
}

fn files(engine: &str) -> Vec<String> {
    let mut files: Vec<String> = std::fs::read_dir(folder().join(engine))
        .unwrap()
        .map(|f| f.unwrap().file_name().into_string().unwrap())
        .collect();
    files.sort();
    files
}

fn former(engine: &str) -> &'static str {
    let file = folder().join(format!("former/{engine}_0001_init.sql"));
    std::fs::read_to_string(file).unwrap().leak()
}

#[test]
fn every_step_in_the_folders_is_listed() {
    let listed = [
        ("sqlite", SQLITE_STEPS),
        #[cfg(feature = "postgres")]
        ("postgres", POSTGRES_STEPS),
    ];
    for (engine, steps) in listed {
        let names: Vec<String> = steps
            .iter()
            .map(|(version, name, _)| {
                assert!(name.starts_with(&format!("{version:04}_")), "{name}");
                format!("{name}.sql")
            })
            .collect();
        assert_eq!(files(engine), names);
    }
}

#[test]
fn committed_steps_are_never_edited() {
    let sums = std::fs::read_to_string(folder().join("SHA256SUMS")).unwrap();
    let pinned: Vec<(&str, &str)> = sums.lines().filter_map(|l| l.split_once("  ")).collect();
    let mut missing = String::new();
    for engine in ["former", "postgres", "sqlite"] {
        for file in files(engine) {
            let name = format!("{engine}/{file}");
            let sum = hex::encode(Sha256::digest(std::fs::read(folder().join(&name)).unwrap()));
            match pinned.iter().find(|(_, pinned)| *pinned == name) {
                None => missing += &format!("\n{sum}  {name}"),
                Some((committed, _)) => assert_eq!(
                    *committed, sum,
                    "migrations/{name} was edited. Catalogs that have run this step are refused after an edit. Restore \
                     the file (git checkout), and put the change into a new step with the next number, for both databases"
                ),
            }
        }
    }
    assert!(
        missing.is_empty(),
        "new steps are not pinned. Append these lines to migrations/SHA256SUMS:{missing}"
    );
    for (_, name) in pinned {
        assert!(
            folder().join(name).exists(),
            "migrations/{name} was removed; catalogs that have run it are refused without it"
        );
    }
}

fn spec() -> JobSpec {
    serde_json::from_str(SPEC).unwrap()
}

/// Returns statements that add a job with nine tasks, four of them done and one with an output, in
/// the first schema. `blob` formats bytes, given in hexadecimal, as a literal of the database.
fn rows(blob: fn(&str) -> String, id: fn(u128) -> String, no: &str) -> String {
    let spec = SPEC.replace('\'', "''");
    let set = ResultSet::of_stage(&self::spec().stages[0]);
    let key = blob(&hex::encode(set.stage_key.0));
    let manifest = blob(&"07".repeat(32));
    let (job, done, pending) = (id(1), id(2), id(3));
    format!(
        "INSERT INTO job (id, spec_hash, spec, state, submitted_ms) VALUES ({job}, 'h', '{spec}', 0, 5);
         INSERT INTO result_set (store, dataset, stage_key) VALUES ('{}', '{}', {key});
         INSERT INTO stage (job, ordinal, result_set, tasks) VALUES (1, 0, 1, 9);
         INSERT INTO task_range (id, stage, lo, hi, epoch, crashes, state, not_before_ms)
             VALUES ({done}, 1, 0, 4, 1, 0, 2, NULL), ({pending}, 1, 4, 9, 0, 0, 0, 0);
         INSERT INTO output (result_set, task, manifest, bytes, seconds, epoch, adopted)
             VALUES (1, 0, {manifest}, 7, 1.5, 1, {no});
         INSERT INTO event (at_ms, job, kind, worker, seconds, message) VALUES (5, 1, 0, '', 0, 'submitted');",
        set.store, set.dataset
    )
}

async fn is_readable(catalog: &dyn Catalog, level: &str) {
    let snapshot = catalog.load().await.unwrap();
    assert_eq!(snapshot.jobs.len(), 1, "{level}");
    let id = JobId::from_uuid(Uuid::from_u128(1));
    let JobRecord { job, stages, .. } = catalog.job(id).await.unwrap().unwrap();
    assert_eq!(
        (job.state, &*job.spec),
        (JobState::Active, &spec()),
        "{level}"
    );
    assert_eq!(
        (stages[0].counts.done, stages[0].counts.pending),
        (4, 5),
        "{level}"
    );
    let set = ResultSet::of_stage(&job.spec.stages[0]);
    let recorded = catalog.recorded(&set, 9).await.unwrap();
    assert_eq!(
        (recorded[0].manifest, recorded[0].checked),
        ([7; 32], false),
        "{level}"
    );
    assert!(catalog.cancel(id, "enough", 6).await.unwrap(), "{level}");
}

/// Returns every level that was ever committed: the current steps up to each one, and the former
/// first step, alone and followed by the second.
fn levels(engine: &str, steps: &[Step]) -> Vec<(String, Vec<Step>)> {
    let of_today = (1..=steps.len()).map(|k| (format!("{engine}, level {k}"), steps[..k].to_vec()));
    let first = (1, "0001_init", former(engine));
    let of_before = [
        (format!("{engine}, former level 1"), vec![first]),
        (format!("{engine}, former level 2"), vec![first, steps[1]]),
    ];
    of_today.chain(of_before).collect()
}

#[tokio::test]
async fn a_sqlite_catalog_of_every_level_is_opened_and_read() {
    for (level, steps) in levels("sqlite", SQLITE_STEPS) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalog.db");
        let url = format!("sqlite://{}?mode=rwc", path.display());
        let mut c = SqliteConnection::connect(&url).await.unwrap();
        migrator(&steps)
            .run_direct(None, &mut c, false)
            .await
            .unwrap();
        let rows = rows(|hex| format!("x'{hex}'"), |id| format!("x'{id:032x}'"), "0");
        sqlx::raw_sql(sqlx::AssertSqlSafe(rows))
            .execute(&mut c)
            .await
            .unwrap();
        c.close().await.unwrap();
        for time in ["first", "second"] {
            let catalog = SqliteCatalog::open(&path, "the test").await.unwrap();
            if time == "second" {
                is_readable(&catalog, &level).await;
            }
            catalog.close().await;
        }
    }
}

#[cfg(feature = "postgres")]
#[tokio::test]
async fn a_postgres_catalog_of_every_level_is_opened_and_read() {
    for (level, steps) in levels("postgres", POSTGRES_STEPS) {
        let Some(url) = crate::testing::postgres().await else {
            return;
        };
        let mut c = sqlx::PgConnection::connect(&url).await.unwrap();
        migrator(&steps)
            .run_direct(None, &mut c, false)
            .await
            .unwrap();
        let uuid = |id| format!("'{}'::uuid", Uuid::from_u128(id));
        let rows = rows(|hex| format!(r"'\x{hex}'::bytea"), uuid, "FALSE");
        sqlx::raw_sql(sqlx::AssertSqlSafe(rows))
            .execute(&mut c)
            .await
            .unwrap();
        c.close().await.unwrap();
        let catalog = crate::PostgresCatalog::open(&url, "the test")
            .await
            .unwrap();
        is_readable(&catalog, &level).await;
        catalog.close().await;
    }
}

#[tokio::test]
async fn a_catalog_whose_step_was_edited_is_refused_with_the_way_out() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("catalog.db");
    let catalog = SqliteCatalog::open(&path, "the test").await.unwrap();
    catalog.close().await;
    let mut c = SqliteConnection::connect(&format!("sqlite://{}", path.display()))
        .await
        .unwrap();
    sqlx::query("UPDATE _sqlx_migrations SET checksum = x'00' WHERE version = 2")
        .execute(&mut c)
        .await
        .unwrap();
    c.close().await.unwrap();
    let error = SqliteCatalog::open(&path, "the test").await.err().unwrap();
    assert!(
        matches!(error, CatalogError::OtherSchema { step: 2, .. }),
        "{error}"
    );
    for part in [
        "schema step 2",
        "open it with that build",
        "start with another catalog",
    ] {
        assert!(error.to_string().contains(part), "{error}");
    }
}
