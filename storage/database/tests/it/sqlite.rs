//! Tests of a SQLite catalog as a file: who may open it, and which files are not touched.

use picofarm_catalog::{Catalog, CatalogError};
use picofarm_database::SqliteCatalog;
use sqlx::Connection;

async fn open(folder: &tempfile::TempDir) -> SqliteCatalog {
    SqliteCatalog::open(&folder.path().join("a/b/c.db"), "the test")
        .await
        .unwrap()
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
async fn a_closed_catalog_is_free_whoever_still_has_it() {
    let folder = tempfile::tempdir().unwrap();
    let first = open(&folder).await;
    first.close().await;
    let second = open(&folder).await;
    // Closing a catalog twice has no effect on the second one.
    first.close().await;
    let path = folder.path().join("a/b/c.db");
    let error = SqliteCatalog::open(&path, "the third").await.err().unwrap();
    assert!(matches!(error, CatalogError::Held { .. }));
    drop((first, second));
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
