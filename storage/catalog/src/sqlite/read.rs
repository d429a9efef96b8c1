//! Queries, on read-only connections.

use std::{path::Path, sync::Arc};

use picofarm_proto::{
    ids::{Incarnation, JobId, WorkerId},
    model::{Event, JobSpec},
};
use sqlx::{Row, SqlitePool};

use super::{
    errors,
    rows::{self, bad, int, uint, uuid},
};
use crate::{
    CatalogError,
    record::{EventQuery, Exception, Job, ResultSet, Run, Snapshot, Timing, Worker},
};

pub(super) async fn load(path: &Path, pool: &SqlitePool) -> Result<Snapshot, CatalogError> {
    read_all(pool).await.map_err(|e| match e {
        sqlx::Error::ColumnDecode { index, source } => CatalogError::Unusable {
            path: path.to_owned(),
            what: format!("column {index} cannot be read ({source})"),
        },
        e => errors::classify(path, e),
    })
}

async fn read_all(pool: &SqlitePool) -> Result<Snapshot, sqlx::Error> {
    // One transaction, so that all tables are of one moment.
    let mut tx = pool.begin().await?;
    let mut snapshot = Snapshot::default();
    for row in sqlx::query(
        "SELECT id, spec_hash, spec, state, submitted_ms, ended_ms FROM job ORDER BY key",
    )
    .fetch_all(&mut *tx)
    .await?
    {
        let spec: JobSpec =
            serde_json::from_str(row.try_get("spec")?).map_err(|e| bad("spec", e))?;
        snapshot.jobs.push(Job {
            id: JobId::from_uuid(uuid(&row, "id")?),
            spec_hash: row.try_get("spec_hash")?,
            spec: Arc::new(spec),
            state: rows::job_state(row.try_get("state")?)?,
            submitted_ms: row.try_get("submitted_ms")?,
            ended_ms: row.try_get("ended_ms")?,
        });
    }
    for row in sqlx::query(
        "SELECT task_range.*, job.id AS job_id FROM task_range JOIN stage ON stage.key = task_range.stage \
         JOIN job ON job.key = stage.job ORDER BY task_range.stage, lo",
    )
    .fetch_all(&mut *tx)
    .await?
    {
        snapshot.ranges.push(rows::range(&row)?);
    }
    for row in sqlx::query(
        "SELECT exception.*, job.id AS job_id FROM exception JOIN stage ON stage.key = exception.stage \
         JOIN job ON job.key = stage.job ORDER BY exception.stage, task",
    )
    .fetch_all(&mut *tx)
    .await?
    {
        let small = |column| {
            uint(&row, column).and_then(|v| u32::try_from(v).map_err(|e| bad(column, e)))
        };
        snapshot.exceptions.push(Exception {
            job: JobId::from_uuid(uuid(&row, "job_id")?),
            task: uint(&row, "task")?,
            failures: small("failures")?,
            crashes: small("crashes")?,
            dead: row.try_get("dead")?,
            last_error: row.try_get("last_error")?,
        });
    }
    for row in sqlx::query("SELECT * FROM worker ORDER BY id")
        .fetch_all(&mut *tx)
        .await?
    {
        snapshot.workers.push(Worker {
            id: WorkerId::from_uuid(uuid(&row, "id")?),
            incarnation: Incarnation::from_uuid(uuid(&row, "incarnation")?),
            name: row.try_get("name")?,
            last_seen_ms: row.try_get("last_seen_ms")?,
        });
    }
    tx.rollback().await?;
    Ok(snapshot)
}

pub(super) async fn output_runs(
    pool: &SqlitePool,
    set: &ResultSet,
    count: u64,
) -> Result<Vec<Run>, sqlx::Error> {
    // Gaps and islands: within a run, task minus its rank is constant.
    let rows = sqlx::query(
        "SELECT min(task) AS lo, max(task) + 1 AS hi FROM ( \
           SELECT task, task - row_number() OVER (ORDER BY task) AS island FROM output \
           WHERE result_set = (SELECT key FROM result_set WHERE store = ? AND dataset = ? AND stage_key = ?) \
           AND task < ?) GROUP BY island ORDER BY lo",
    )
    .bind(&set.store)
    .bind(&set.dataset)
    .bind(&set.stage_key.0[..])
    .bind(int(count))
    .fetch_all(pool)
    .await?;
    rows.iter()
        .map(|row| {
            Ok(Run {
                lo: uint(row, "lo")?,
                hi: uint(row, "hi")?,
            })
        })
        .collect()
}

pub(super) async fn manifests(
    pool: &SqlitePool,
    tasks: &[(JobId, u64)],
) -> Result<Vec<Option<[u8; 32]>>, sqlx::Error> {
    if tasks.is_empty() {
        return Ok(Vec::new());
    }
    let mut connection = pool.acquire().await?;
    let mut found = Vec::with_capacity(tasks.len());
    for (job, task) in tasks {
        let manifest: Option<Vec<u8>> = sqlx::query_scalar(
            "SELECT manifest FROM output WHERE task = ? AND result_set = \
             (SELECT result_set FROM stage JOIN job ON job.key = stage.job WHERE job.id = ?)",
        )
        .bind(int(*task))
        .bind(&job.uuid().as_bytes()[..])
        .fetch_optional(&mut *connection)
        .await?;
        found.push(
            manifest
                .map(|m| {
                    m.try_into()
                        .map_err(|_| bad("manifest", "not 32 bytes long"))
                })
                .transpose()?,
        );
    }
    Ok(found)
}

pub(super) async fn timing(pool: &SqlitePool, set: &ResultSet) -> Result<Timing, sqlx::Error> {
    let row = sqlx::query(
        "SELECT count(*) AS tasks, total(seconds) AS seconds FROM output WHERE adopted = 0 AND result_set = \
         (SELECT key FROM result_set WHERE store = ? AND dataset = ? AND stage_key = ?)",
    )
    .bind(&set.store)
    .bind(&set.dataset)
    .bind(&set.stage_key.0[..])
    .fetch_one(pool)
    .await?;
    Ok(Timing {
        tasks: uint(&row, "tasks")?,
        seconds: row.try_get("seconds")?,
    })
}

pub(super) async fn events(
    path: &Path,
    pool: &SqlitePool,
    query: &EventQuery,
) -> Result<Vec<Event>, CatalogError> {
    let read = async {
        let rows = sqlx::query(
            "SELECT sequence, at_ms, kind, lo, hi, worker, seconds, message FROM event \
             WHERE job = (SELECT key FROM job WHERE id = ?1) AND sequence > ?2 \
             AND (?3 IS NULL OR (lo <= ?3 AND ?3 < hi)) ORDER BY sequence LIMIT ?4",
        )
        .bind(&query.job.uuid().as_bytes()[..])
        .bind(i64::try_from(query.after).unwrap_or(i64::MAX))
        .bind(query.task.map(|t| i64::try_from(t).unwrap_or(i64::MAX)))
        .bind(query.limit)
        .fetch_all(pool)
        .await?;
        rows.iter()
            .map(|row| {
                let (lo, hi): (Option<i64>, Option<i64>) = (row.try_get("lo")?, row.try_get("hi")?);
                let single = lo.filter(|lo| hi == Some(lo + 1));
                Ok(Event {
                    sequence: uint(row, "sequence")?,
                    at_ms: row.try_get("at_ms")?,
                    job: query.job,
                    kind: rows::event_kind(row.try_get("kind")?)?,
                    task: single
                        .map(|t| u64::try_from(t).map_err(|e| bad("lo", e)))
                        .transpose()?,
                    worker: row.try_get("worker")?,
                    message: row.try_get("message")?,
                    seconds: row.try_get("seconds")?,
                })
            })
            .collect::<Result<Vec<_>, sqlx::Error>>()
    };
    read.await.map_err(|e| errors::classify(path, e))
}
