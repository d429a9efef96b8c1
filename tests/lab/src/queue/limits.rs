//! Measures limits of the database itself with durable transactions, for comparison. The first
//! limit is a queue with a row per task, where clients claim batches in one transaction and
//! complete them in another, as a scheduler without ranges would. The second is rows of the size of
//! an output, appended by one client as fast as the database accepts them; no catalog can exceed
//! this.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use sqlx::{
    Connection, PgConnection, QueryBuilder, SqliteConnection,
    sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous},
};

use picofarm_database::CatalogPlace;

const TABLE: &str = "CREATE TABLE raw_limit (set_key BIGINT NOT NULL, task BIGINT NOT NULL, manifest {bytes} NOT NULL, \
                     bytes BIGINT NOT NULL, seconds DOUBLE PRECISION NOT NULL, PRIMARY KEY (set_key, task))";

/// Returns the tasks per second that clients claim and complete in a table with a row per task,
/// `batch` per transaction: on Postgres with eight clients and `SKIP LOCKED`; on SQLite with the
/// only writer that it allows. Takes about `time` and leaves nothing behind. The catalog must not
/// be open in SQLite's case.
///
/// # Errors
/// Fails if the database cannot be written.
pub async fn queue_limit(
    place: &CatalogPlace,
    batch: usize,
    time: Duration,
) -> Result<f64, sqlx::Error> {
    match place {
        CatalogPlace::Sqlite(path) => {
            let path = path.with_extension("raw");
            let measured = sqlite_queue(raw_options(&path), batch, time).await;
            remove_raw(&path);
            measured
        }
        CatalogPlace::Postgres(url) => postgres_queue(url, batch, time).await,
    }
}

/// Returns the rows per second that one client writes with `batch` rows per transaction. Takes
/// about `time` and leaves nothing behind. The catalog must not be open in SQLite's case.
///
/// # Errors
/// Fails if the database cannot be written.
pub async fn raw_limit(
    place: &CatalogPlace,
    batch: usize,
    time: Duration,
) -> Result<f64, sqlx::Error> {
    match place {
        CatalogPlace::Sqlite(path) => {
            let path = path.with_extension("raw");
            let measured = sqlite(raw_options(&path), batch, time).await;
            remove_raw(&path);
            measured
        }
        CatalogPlace::Postgres(url) => postgres(url, batch, time).await,
    }
}

fn raw_options(path: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(path)
        .create_if_missing(true)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
}

fn remove_raw(path: &Path) {
    for suffix in ["", "-wal", "-shm"] {
        let mut file = path.to_owned().into_os_string();
        file.push(suffix);
        // Not all of these files exist.
        let _ = std::fs::remove_file(file);
    }
}

/// Number of clients of a Postgres queue.
const CLIENTS: usize = 8;
/// Number of tasks in the queue: more than can be done in the time.
const QUEUED: i64 = 300_000;
const QUEUE: &str = "CREATE TABLE raw_queue (task BIGINT PRIMARY KEY, state SMALLINT NOT NULL, worker BIGINT NOT NULL, \
                     manifest {bytes})";
const QUEUE_INDEX: &str = "CREATE INDEX raw_queue_open ON raw_queue (task) WHERE state = 0";

async fn sqlite_queue(
    options: SqliteConnectOptions,
    batch: usize,
    time: Duration,
) -> Result<f64, sqlx::Error> {
    let mut c = SqliteConnection::connect_with(&options).await?;
    sqlx::query(sqlx::AssertSqlSafe(QUEUE.replace("{bytes}", "BLOB")))
        .execute(&mut c)
        .await?;
    sqlx::query(QUEUE_INDEX).execute(&mut c).await?;
    sqlx::query(
        "WITH RECURSIVE n (task) AS (SELECT 0 UNION ALL SELECT task + 1 FROM n WHERE task + 1 < $1) \
         INSERT INTO raw_queue SELECT task, 0, 0, NULL FROM n",
    )
    .bind(QUEUED)
    .execute(&mut c)
    .await?;
    let (start, mut done) = (Instant::now(), 0);
    while start.elapsed() < time && done < QUEUED {
        let claimed: Vec<i64> = sqlx::query_scalar(
            "UPDATE raw_queue SET state = 1, worker = 1 WHERE task IN \
             (SELECT task FROM raw_queue WHERE state = 0 ORDER BY task LIMIT $1) RETURNING task",
        )
        .bind(batch as i64)
        .fetch_all(&mut c)
        .await?;
        let mut tx = c.begin().await?;
        for task in &claimed {
            sqlx::query(
                "UPDATE raw_queue SET state = 2, manifest = $1 WHERE task = $2 AND worker = 1",
            )
            .bind(vec![*task as u8; 32])
            .bind(task)
            .execute(&mut *tx)
            .await?;
        }
        tx.commit().await?;
        done += claimed.len() as i64;
    }
    let rate = done as f64 / start.elapsed().as_secs_f64();
    c.close().await?;
    Ok(rate)
}

async fn postgres_queue(url: &str, batch: usize, time: Duration) -> Result<f64, sqlx::Error> {
    let mut c = PgConnection::connect(url).await?;
    let drop_it = "DROP TABLE IF EXISTS raw_queue";
    sqlx::query(drop_it).execute(&mut c).await?;
    sqlx::query(sqlx::AssertSqlSafe(QUEUE.replace("{bytes}", "BYTEA")))
        .execute(&mut c)
        .await?;
    sqlx::query(QUEUE_INDEX).execute(&mut c).await?;
    sqlx::query(
        "INSERT INTO raw_queue SELECT task, 0, 0, NULL FROM generate_series(0, $1 - 1) AS s (task)",
    )
    .bind(QUEUED)
    .execute(&mut c)
    .await?;
    let start = Instant::now();
    let clients = (1..=CLIENTS as i64).map(|me| postgres_client(url, me, batch, (start, time)));
    let done: i64 = futures::future::try_join_all(clients)
        .await?
        .into_iter()
        .sum();
    let rate = done as f64 / start.elapsed().as_secs_f64();
    sqlx::query(drop_it).execute(&mut c).await?;
    c.close().await?;
    Ok(rate)
}

/// Claims and completes tasks until the time is over, and returns their number.
async fn postgres_client(
    url: &str,
    me: i64,
    batch: usize,
    (start, time): (Instant, Duration),
) -> Result<i64, sqlx::Error> {
    let mut c = PgConnection::connect(url).await?;
    let mut done = 0;
    while start.elapsed() < time {
        let claimed: Vec<i64> = sqlx::query_scalar(
            "UPDATE raw_queue SET state = 1, worker = $1 WHERE task IN (SELECT task FROM raw_queue WHERE state = 0 \
             ORDER BY task LIMIT $2 FOR UPDATE SKIP LOCKED) RETURNING task",
        )
        .bind(me)
        .bind(batch as i64)
        .fetch_all(&mut c)
        .await?;
        if claimed.is_empty() {
            break;
        }
        let manifests: Vec<Vec<u8>> = claimed.iter().map(|t| vec![*t as u8; 32]).collect();
        sqlx::query(
            "UPDATE raw_queue SET state = 2, manifest = done.manifest \
             FROM UNNEST($1::BIGINT[], $2::BYTEA[]) AS done (task, manifest) \
             WHERE raw_queue.task = done.task AND worker = $3",
        )
        .bind(&claimed)
        .bind(manifests)
        .bind(me)
        .execute(&mut c)
        .await?;
        done += claimed.len() as i64;
    }
    c.close().await?;
    Ok(done)
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
