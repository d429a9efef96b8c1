//! Tests of backups: taken during writes, complete or absent, and never over another file.

use std::{fs, os::unix::fs::PermissionsExt, path::PathBuf};

use picofarm_catalog::{Catalog, CatalogError, Changes};
use picofarm_database::{BackupError, SqliteCatalog, backup, restore};
use sqlx::Connection;

use crate::conformance::{job, output, pending, set, submitted};

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn at(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    async fn open(&self, name: &str) -> SqliteCatalog {
        SqliteCatalog::open(&self.at(name), "the test")
            .await
            .unwrap()
    }

    /// Returns the names in the folder that no catalog or lock has.
    fn leftovers(&self) -> Vec<String> {
        let names = fs::read_dir(self.0.path()).unwrap();
        let names = names.map(|e| e.unwrap().file_name().into_string().unwrap());
        names.filter(|name| name.contains("partial")).collect()
    }
}

async fn write(catalog: &SqliteCatalog, task: u64) {
    let changes = Changes {
        outputs: vec![output(task)],
        ..Changes::default()
    };
    catalog.commit(&changes).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_backup_during_writes_has_a_prefix_of_them_and_is_restored_elsewhere() {
    let place = Place::new();
    let catalog = place.open("catalog.db").await;
    submitted(&catalog, &[pending(1, 0, 9_000)]).await;
    write(&catalog, 0).await;
    let (from, to) = (place.at("catalog.db"), place.at("backup.db"));
    let copied = tokio::spawn(async move { backup(&from, &to, false).await });
    let mut written = 1;
    while !copied.is_finished() {
        write(&catalog, written).await;
        written += 1;
    }
    let made = copied.await.unwrap().unwrap();
    assert_eq!(made.jobs, 1);
    assert_eq!(
        made.bytes,
        fs::metadata(place.at("backup.db")).unwrap().len()
    );
    write(&catalog, written).await;

    let error = restore(&place.at("backup.db"), &place.at("catalog.db"), true, "me").await;
    let error = error.unwrap_err().to_string();
    assert!(
        error.contains("held by another coordinator (the test)"),
        "{error}"
    );

    let restored = restore(&place.at("backup.db"), &place.at("new/c.db"), false, "me").await;
    assert_eq!(restored.unwrap().jobs, 1);
    let second = place.open("new/c.db").await;
    let snapshot = second.load().await.unwrap();
    assert_eq!(snapshot.jobs, [job()]);
    let runs = second.output_runs(&set(), 9_000).await.unwrap();
    assert_eq!((runs.len(), runs[0].lo), (1, 0), "{runs:?}");
    assert!(runs[0].hi >= 1 && runs[0].hi <= written);
    write(&second, runs[0].hi).await;
    assert_eq!(place.leftovers(), [] as [String; 0]);
}

#[tokio::test]
async fn nothing_is_replaced_without_leave_and_then_as_a_whole() {
    let place = Place::new();
    let catalog = place.open("catalog.db").await;
    submitted(&catalog, &[pending(1, 0, 9)]).await;
    let (live, copy) = (place.at("catalog.db"), place.at("backup.db"));
    fs::write(&copy, "mine").unwrap();
    let error = backup(&live, &copy, false).await.unwrap_err();
    assert!(matches!(error, BackupError::Exists(_)), "{error}");
    assert_eq!(fs::read(&copy).unwrap(), b"mine");
    backup(&live, &copy, true).await.unwrap();
    let error = backup(&live, &live, true).await.unwrap_err();
    assert!(matches!(error, BackupError::InUse(..)), "{error}");

    // The catalog goes on, is killed, and is set back; its log must not meet the restored file.
    write(&catalog, 3).await;
    let other = place.open("other.db").await;
    submitted(&other, &[]).await;
    let error = backup(&live, &place.at("other.db"), true)
        .await
        .unwrap_err();
    assert!(matches!(error, BackupError::InUse(..)), "{error}");
    for file in ["catalog.db", "catalog.db-wal"] {
        fs::copy(place.at(file), place.at(&file.replace("catalog", "killed"))).unwrap();
    }
    let killed = place.at("killed.db");
    let error = restore(&copy, &killed, false, "me").await.unwrap_err();
    assert!(matches!(error, BackupError::Exists(_)), "{error}");
    let mode = fs::Permissions::from_mode(0o640);
    fs::set_permissions(&killed, mode.clone()).unwrap();
    restore(&copy, &killed, true, "me").await.unwrap();
    let now = fs::metadata(&killed).unwrap().permissions();
    assert_eq!(now.mode() & 0o777, mode.mode());
    assert!(!place.at("killed.db-wal").exists());
    let restored = place.open("killed.db").await;
    restored.load().await.unwrap();
    assert_eq!(restored.output_runs(&set(), 9).await.unwrap(), []);
    assert_eq!(place.leftovers(), [] as [String; 0]);
}

#[tokio::test]
async fn what_is_no_sound_catalog_of_this_schema_is_not_restored() {
    let place = Place::new();
    let catalog = place.open("catalog.db").await;
    submitted(&catalog, &[pending(1, 0, 9)]).await;
    for task in 0..9 {
        write(&catalog, task).await;
    }
    let good = place.at("backup.db");
    backup(&place.at("catalog.db"), &good, false).await.unwrap();
    let to = place.at("restored.db");
    let refusal = async |from: PathBuf| {
        let error = restore(&from, &to, false, "me").await.unwrap_err();
        assert!(!to.exists());
        error
    };

    let error = refusal(place.at("nothing.db")).await;
    assert!(matches!(error, BackupError::Missing(_)), "{error}");

    fs::write(place.at("text.db"), "dear diary ".repeat(100)).unwrap();
    let said = refusal(place.at("text.db")).await.to_string();
    assert!(said.contains("not a SQLite database"), "{said}");

    let changed = async |name: &str, statement: &'static str| {
        fs::copy(&good, place.at(name)).unwrap();
        let url = format!("sqlite://{}", place.at(name).display());
        let mut raw = sqlx::SqliteConnection::connect(&url).await.unwrap();
        let text = format!("PRAGMA foreign_keys = OFF; {statement}");
        let text = sqlx::AssertSqlSafe(text);
        sqlx::raw_sql(text).execute(&mut raw).await.unwrap();
        raw.close().await.unwrap();
        refusal(place.at(name)).await
    };
    let error = changed(
        "newer.db",
        "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
         VALUES (999, 'future', 1, x'00', 0)",
    );
    let error = error.await;
    let newer = matches!(
        error,
        BackupError::Catalog(CatalogError::Newer { found: 999, .. })
    );
    assert!(newer, "{error}");
    let error = changed(
        "other.db",
        "UPDATE _sqlx_migrations SET checksum = x'00' WHERE version = 2",
    );
    let error = error.await;
    let other = matches!(
        error,
        BackupError::Catalog(CatalogError::OtherSchema { step: 2, .. })
    );
    assert!(other, "{error}");
    let said = changed("stranger.db", "DROP TABLE _sqlx_migrations").await;
    assert!(said.to_string().contains("no catalog of picofarm"));
    let said = changed("orphans.db", "DELETE FROM result_set").await;
    assert!(said.to_string().contains("damaged"), "{said}");

    let mut bytes = fs::read(&good).unwrap();
    let half = bytes.len() / 2;
    fs::write(place.at("half.db"), &bytes[..half]).unwrap();
    let said = refusal(place.at("half.db")).await.to_string();
    assert!(said.contains("damaged"), "{said}");
    for byte in &mut bytes[4096 * 3..] {
        *byte ^= 0x5a;
    }
    fs::write(place.at("noise.db"), &bytes).unwrap();
    let said = refusal(place.at("noise.db")).await.to_string();
    assert!(said.contains("damaged"), "{said}");
    assert_eq!(place.leftovers(), [] as [String; 0]);
}
