//! Changes → SQL, in one transaction.

use std::collections::HashMap;

use picofarm_proto::ids::JobId;
use sqlx::{Connection, QueryBuilder, Sqlite, SqliteConnection};

use super::rows::{self, int};
use crate::{
    Changes,
    record::{Job, Range, RangeState, ResultSet},
};

/// Rows in one statement; SQLite takes 32,766 parameters and no row here has more than 12.
const ROWS: usize = 1000;

pub(super) enum ApplyError {
    Conflict(String),
    Sql(sqlx::Error),
}

impl From<sqlx::Error> for ApplyError {
    fn from(e: sqlx::Error) -> Self {
        Self::Sql(e)
    }
}

/// Short integer keys of jobs, remembered: they never change.
#[derive(Default)]
pub(super) struct Keys(HashMap<JobId, JobKeys>);

#[derive(Clone, Copy)]
struct JobKeys {
    job: i64,
    stage: i64,
    result_set: i64,
}

impl Keys {
    async fn of(&mut self, c: &mut SqliteConnection, id: JobId) -> Result<JobKeys, ApplyError> {
        if let Some(keys) = self.0.get(&id) {
            return Ok(*keys);
        }
        let found: Option<(i64, i64, i64)> = sqlx::query_as(
            "SELECT job.key, stage.key, stage.result_set FROM job JOIN stage ON stage.job = job.key WHERE job.id = ?",
        )
        .bind(&id.uuid().as_bytes()[..])
        .fetch_optional(c)
        .await?;
        let (job, stage, result_set) =
            found.ok_or_else(|| ApplyError::Conflict(format!("there is no job {id}")))?;
        let keys = JobKeys {
            job,
            stage,
            result_set,
        };
        self.0.insert(id, keys);
        Ok(keys)
    }
}

/// Writes all of `changes`, or nothing.
pub(super) async fn transaction(
    connection: &mut SqliteConnection,
    keys: &mut Keys,
    changes: &Changes,
) -> Result<(), ApplyError> {
    let mut tx = connection.begin_with("BEGIN IMMEDIATE").await?;
    let result = match write(&mut tx, keys, changes).await {
        Ok(()) => tx.commit().await.map_err(ApplyError::Sql),
        // Dropping the transaction undoes it.
        Err(error) => Err(error),
    };
    if result.is_err() {
        // Keys found in a transaction that is undone may not exist.
        for job in &changes.jobs {
            keys.0.remove(&job.id);
        }
    }
    result
}

async fn write(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    changes: &Changes,
) -> Result<(), ApplyError> {
    for job in &changes.jobs {
        insert_job(c, job).await?;
    }
    for (id, (state, ended)) in &changes.job_states {
        sqlx::query("UPDATE job SET state = ?, ended_ms = ? WHERE id = ?")
            .bind(rows::job_state_code(*state))
            .bind(ended)
            .bind(&id.uuid().as_bytes()[..])
            .execute(&mut *c)
            .await?;
    }
    for id in &changes.gone {
        sqlx::query("DELETE FROM task_range WHERE id = ?")
            .bind(&id.uuid().as_bytes()[..])
            .execute(&mut *c)
            .await?;
    }
    for range in changes.ranges.values() {
        put_range(c, keys, range).await?;
    }
    insert_outputs(c, keys, changes).await?;
    for exception in changes.exceptions.values() {
        let stage = keys.of(c, exception.job).await?.stage;
        sqlx::query(
            "INSERT INTO exception (stage, task, failures, crashes, dead, last_error) VALUES (?, ?, ?, ?, ?, ?) \
             ON CONFLICT DO UPDATE SET failures = excluded.failures, crashes = excluded.crashes, \
             dead = excluded.dead, last_error = excluded.last_error",
        )
        .bind(stage)
        .bind(int(exception.task))
        .bind(exception.failures)
        .bind(exception.crashes)
        .bind(exception.dead)
        .bind(&exception.last_error)
        .execute(&mut *c)
        .await?;
    }
    for worker in changes.workers.values() {
        sqlx::query(
            "INSERT INTO worker (id, incarnation, name, last_seen_ms) VALUES (?, ?, ?, ?) \
             ON CONFLICT DO UPDATE SET incarnation = excluded.incarnation, name = excluded.name, \
             last_seen_ms = excluded.last_seen_ms",
        )
        .bind(&worker.id.uuid().as_bytes()[..])
        .bind(&worker.incarnation.uuid().as_bytes()[..])
        .bind(&worker.name)
        .bind(worker.last_seen_ms)
        .execute(&mut *c)
        .await?;
    }
    insert_events(c, keys, changes).await
}

async fn insert_job(c: &mut SqliteConnection, job: &Job) -> Result<(), ApplyError> {
    let spec = serde_json::to_string(&*job.spec).expect("a spec is plain data");
    let set = ResultSet::of(&job.spec);
    let (job_key,): (i64,) = sqlx::query_as(
        "INSERT INTO job (id, spec_hash, spec, state, submitted_ms, ended_ms) VALUES (?, ?, ?, ?, ?, ?) RETURNING key",
    )
    .bind(&job.id.uuid().as_bytes()[..])
    .bind(&job.spec_hash)
    .bind(spec)
    .bind(rows::job_state_code(job.state))
    .bind(job.submitted_ms)
    .bind(job.ended_ms)
    .fetch_one(&mut *c)
    .await?;
    sqlx::query("INSERT INTO result_set (store, dataset, stage_key) VALUES (?, ?, ?) ON CONFLICT DO NOTHING")
        .bind(&set.store)
        .bind(&set.dataset)
        .bind(&set.stage_key.0[..])
        .execute(&mut *c)
        .await?;
    sqlx::query(
        "INSERT INTO stage (job, result_set, tasks) \
         SELECT ?, key, ? FROM result_set WHERE store = ? AND dataset = ? AND stage_key = ?",
    )
    .bind(job_key)
    .bind(int(job.spec.scenes.count))
    .bind(&set.store)
    .bind(&set.dataset)
    .bind(&set.stage_key.0[..])
    .execute(&mut *c)
    .await?;
    Ok(())
}

async fn put_range(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    range: &Range,
) -> Result<(), ApplyError> {
    let stage = keys.of(c, range.job).await?.stage;
    let lease = match &range.state {
        RangeState::Leased(lease) => Some(lease),
        _ => None,
    };
    let (state, not_before) = match &range.state {
        RangeState::Pending { not_before_ms } => (rows::PENDING, Some(*not_before_ms)),
        RangeState::Leased(_) => (rows::LEASED, None),
        RangeState::Done { reused: false } => (rows::DONE, None),
        RangeState::Done { reused: true } => (rows::DONE_REUSED, None),
        RangeState::Dead => (rows::DEAD, None),
    };
    let marks = lease.map(|l| l.marks.iter().map(|m| *m as u8).collect::<Vec<_>>());
    // An epoch never goes back: whoever tries knows less than the catalog.
    let written = sqlx::query(
        "INSERT INTO task_range (id, stage, lo, hi, epoch, crashes, state, not_before_ms, worker, incarnation, \
         lease_until_ms, marks) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?) \
         ON CONFLICT DO UPDATE SET lo = excluded.lo, hi = excluded.hi, epoch = excluded.epoch, \
         crashes = excluded.crashes, state = excluded.state, not_before_ms = excluded.not_before_ms, \
         worker = excluded.worker, incarnation = excluded.incarnation, \
         lease_until_ms = excluded.lease_until_ms, marks = excluded.marks \
         WHERE task_range.epoch <= excluded.epoch",
    )
    .bind(&range.id.uuid().as_bytes()[..])
    .bind(stage)
    .bind(int(range.lo))
    .bind(int(range.hi))
    .bind(int(range.epoch.0))
    .bind(range.crashes)
    .bind(state)
    .bind(not_before)
    .bind(lease.map(|l| l.worker.uuid().as_bytes().to_vec()))
    .bind(lease.map(|l| l.incarnation.uuid().as_bytes().to_vec()))
    .bind(lease.map(|l| l.until_ms))
    .bind(marks)
    .execute(c)
    .await?;
    if written.rows_affected() == 0 {
        return Err(ApplyError::Conflict(format!(
            "range {} has a later epoch than {}",
            range.id, range.epoch
        )));
    }
    Ok(())
}

async fn insert_outputs(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    changes: &Changes,
) -> Result<(), ApplyError> {
    for chunk in changes.outputs.chunks(ROWS) {
        let mut sets = Vec::with_capacity(chunk.len());
        for output in chunk {
            sets.push(keys.of(c, output.job).await?.result_set);
        }
        let mut query = QueryBuilder::<Sqlite>::new(
            "INSERT INTO output (result_set, task, manifest, bytes, seconds, epoch, adopted) ",
        );
        query.push_values(chunk.iter().zip(sets), |mut row, (output, set)| {
            row.push_bind(set)
                .push_bind(int(output.task))
                .push_bind(output.manifest.to_vec())
                .push_bind(int(output.bytes))
                .push_bind(output.seconds)
                .push_bind(int(output.epoch.0))
                .push_bind(output.adopted);
        });
        query.build().execute(&mut *c).await.map_err(|e| {
            if e.as_database_error()
                .is_some_and(|e| e.is_unique_violation())
            {
                ApplyError::Conflict("an output is committed already".into())
            } else {
                ApplyError::Sql(e)
            }
        })?;
    }
    Ok(())
}

async fn insert_events(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    changes: &Changes,
) -> Result<(), ApplyError> {
    for chunk in changes.events.chunks(ROWS) {
        let mut jobs = Vec::with_capacity(chunk.len());
        for event in chunk {
            jobs.push(keys.of(c, event.job).await?.job);
        }
        let mut query = QueryBuilder::<Sqlite>::new(
            "INSERT INTO event (at_ms, job, kind, lo, hi, worker, seconds, message) ",
        );
        query.push_values(chunk.iter().zip(jobs), |mut row, (event, job)| {
            row.push_bind(event.at_ms)
                .push_bind(job)
                .push_bind(rows::event_kind_code(event.kind))
                .push_bind(event.tasks.map(|t| int(t.lo)))
                .push_bind(event.tasks.map(|t| int(t.hi)))
                .push_bind(event.worker.clone())
                .push_bind(event.seconds)
                .push_bind(event.message.clone());
        });
        query.build().execute(&mut *c).await?;
    }
    Ok(())
}
