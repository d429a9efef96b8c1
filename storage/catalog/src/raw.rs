//! The limit that no catalog can pass: rows of the size of an output, written by one client into the same database as
//! fast as it takes them, each transaction durable. For benches.

use std::time::{Duration, Instant};

use sqlx::{
    Connection, PgConnection, QueryBuilder, SqliteConnection,
    sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous},
};

use crate::{CatalogError, CatalogPlace};

const TABLE: &str = "CREATE TABLE raw_limit (set_key BIGINT NOT NULL, task BIGINT NOT NULL, manifest {bytes} NOT NULL, \
                     bytes BIGINT NOT NULL, seconds DOUBLE PRECISION NOT NULL, PRIMARY KEY (set_key, task))";

impl CatalogPlace {
    /// Rows a second that one client writes with `batch` rows a transaction. Takes about `time`; leaves nothing behind.
    /// The catalog must not be open in SQLite's case.
    ///
    /// # Errors
    /// [`CatalogError`] when the database cannot be written.
    pub async fn raw_limit(&self, batch: usize, time: Duration) -> Result<f64, CatalogError> {
        let measured = match self {
            Self::Sqlite(path) => {
                let path = path.with_extension("raw");
                let options = SqliteConnectOptions::new()
                    .filename(&path)
                    .create_if_missing(true)
                    .journal_mode(SqliteJournalMode::Wal)
                    .synchronous(SqliteSynchronous::Full);
                let measured = sqlite(options, batch, time).await;
                for suffix in ["", "-wal", "-shm"] {
                    let mut file = path.clone().into_os_string();
                    file.push(suffix);
                    // Not all of them are there.
                    let _ = std::fs::remove_file(file);
                }
                measured
            }
            Self::Postgres(url) => postgres(url, batch, time).await,
        };
        measured.map_err(|source| CatalogError::Database {
            place: self.to_string(),
            source,
        })
    }
}

async fn sqlite(
    options: SqliteConnectOptions,
    batch: usize,
    time: Duration,
) -> Result<f64, sqlx::Error> {
    let mut c = SqliteConnection::connect_with(&options).await?;
    sqlx::query(sqlx::AssertSqlSafe(TABLE.replace("{bytes}", "BLOB")))
        .execute(&mut c)
        .await?;
    let start = Instant::now();
    let mut rows = 0;
    while start.elapsed() < time {
        let mut tx = c.begin().await?;
        let mut insert = QueryBuilder::<sqlx::Sqlite>::new(
            "INSERT INTO raw_limit (set_key, task, manifest, bytes, seconds) ",
        );
        insert.push_values(rows..rows + batch as i64, |mut row, task| {
            row.push_bind(1i64)
                .push_bind(task)
                .push_bind(vec![task as u8; 32])
                .push_bind(1i64)
                .push_bind(1.0f64);
        });
        insert.build().execute(&mut *tx).await?;
        tx.commit().await?;
        rows += batch as i64;
    }
    let rate = rows as f64 / start.elapsed().as_secs_f64();
    c.close().await?;
    Ok(rate)
}

async fn postgres(url: &str, batch: usize, time: Duration) -> Result<f64, sqlx::Error> {
    let mut c = PgConnection::connect(url).await?;
    sqlx::query("DROP TABLE IF EXISTS raw_limit")
        .execute(&mut c)
        .await?;
    sqlx::query(sqlx::AssertSqlSafe(TABLE.replace("{bytes}", "BYTEA")))
        .execute(&mut c)
        .await?;
    let start = Instant::now();
    let mut rows = 0;
    while start.elapsed() < time {
        let tasks: Vec<i64> = (rows..rows + batch as i64).collect();
        let manifests: Vec<Vec<u8>> = tasks.iter().map(|t| vec![*t as u8; 32]).collect();
        sqlx::query(
            "INSERT INTO raw_limit SELECT 1, task, manifest, 1, 1.0 \
             FROM UNNEST($1::BIGINT[], $2::BYTEA[]) AS rows (task, manifest)",
        )
        .bind(tasks)
        .bind(manifests)
        .execute(&mut c)
        .await?;
        rows += batch as i64;
    }
    let rate = rows as f64 / start.elapsed().as_secs_f64();
    sqlx::query("DROP TABLE raw_limit").execute(&mut c).await?;
    c.close().await?;
    Ok(rate)
}
