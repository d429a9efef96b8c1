//! Jobs as a whole: recorded, ended, cancelled, tried again.

use std::collections::HashMap;

use picofarm_proto::{
    ids::JobId,
    model::{EventKind, JobState},
};
use sqlx::SqliteConnection;

use super::{
    query,
    write::{Keys, Result, WriteError, give, insert_events, insert_ranges},
};
use crate::{
    Job, JobEnd, NewEvent, Range, RangeState,
    sql::{self, int},
};

/// Ends an active job of which nothing is pending or leased.
pub(super) async fn end_if_over(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    id: JobId,
    at_ms: i64,
) -> Result<Option<JobEnd>> {
    let key = keys.job(c, id).await?;
    let active: Option<i64> = sqlx::query_scalar("SELECT 1 FROM job WHERE key = ? AND state = 0")
        .bind(key)
        .fetch_optional(&mut *c)
        .await?;
    let open: Option<i64> = sqlx::query_scalar(
        "SELECT 1 FROM task_range JOIN stage ON stage.key = task_range.stage \
         WHERE stage.job = ? AND state IN (0, 1) LIMIT 1",
    )
    .bind(key)
    .fetch_optional(&mut *c)
    .await?;
    if active.is_none() || open.is_some() {
        return Ok(None);
    }
    let counts = query::counts(c, key).await?;
    let state = if counts.dead > 0 {
        JobState::Failed
    } else {
        JobState::Done
    };
    sqlx::query(
        "UPDATE job SET state = ?2, ended_ms = ?3, tasks = ?4, done = ?5, reused = ?6, dead = ?7, \
         (timed, seconds) = (SELECT count(*), coalesce(sum(seconds), 0.0) FROM output \
           WHERE NOT adopted AND result_set IN (SELECT result_set FROM stage WHERE job = ?1)) WHERE key = ?1",
    )
    .bind(key)
    .bind(sql::job_state_code(state))
    .bind(at_ms)
    .bind(int(counts.total))
    .bind(int(counts.done))
    .bind(int(counts.reused))
    .bind(int(counts.dead))
    .execute(&mut *c)
    .await?;
    insert_events(c, keys, &[NewEvent::ended(id, at_ms, &counts)]).await?;
    Ok(Some(JobEnd {
        job: id,
        state,
        at_ms,
    }))
}

pub(super) async fn submit(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    job: &Job,
    ranges: &[Range],
    events: &[NewEvent],
) -> Result<bool> {
    let spec = serde_json::to_string(&*job.spec).expect("a spec is plain data");
    let key: Option<i64> = sqlx::query_scalar(
        "INSERT INTO job (id, spec_hash, spec, state, submitted_ms) VALUES (?, ?, ?, 0, ?) \
         ON CONFLICT DO NOTHING RETURNING key",
    )
    .bind(job.id.uuid())
    .bind(&job.spec_hash)
    .bind(spec)
    .bind(job.submitted_ms)
    .fetch_optional(&mut *c)
    .await?;
    let Some(key) = key else {
        return Ok(false);
    };
    let mut stages = HashMap::new();
    for stage in job.stages() {
        let set = &stage.set;
        sqlx::query("INSERT INTO result_set (store, dataset, stage_key) VALUES (?, ?, ?) ON CONFLICT DO NOTHING")
            .bind(&set.store)
            .bind(&set.dataset)
            .bind(&set.stage_key.0[..])
            .execute(&mut *c)
            .await?;
        let stage_key: i64 = sqlx::query_scalar(
            "INSERT INTO stage (job, ordinal, result_set, tasks) SELECT ?, ?, key, ? FROM result_set \
             WHERE store = ? AND dataset = ? AND stage_key = ? RETURNING key",
        )
        .bind(key)
        .bind(i64::from(stage.id.stage))
        .bind(int(stage.tasks))
        .bind(&set.store)
        .bind(&set.dataset)
        .bind(&set.stage_key.0[..])
        .fetch_one(&mut *c)
        .await?;
        stages.insert(stage.id, stage_key);
    }
    let rows: Vec<_> = ranges.iter().map(|r| (stages[&r.stage], r)).collect();
    insert_ranges(c, &rows, false).await?;
    insert_events(c, keys, events).await?;
    end_if_over(c, keys, job.id, job.submitted_ms).await?;
    Ok(true)
}

pub(super) async fn cancel(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    job: JobId,
    now_ms: i64,
) -> Result<bool> {
    let key = keys.job(c, job).await?;
    let cancelled =
        sqlx::query("UPDATE job SET state = ?, ended_ms = ? WHERE key = ? AND state = 0")
            .bind(sql::job_state_code(JobState::Cancelled))
            .bind(now_ms)
            .bind(key)
            .execute(&mut *c)
            .await?
            .rows_affected()
            > 0;
    if cancelled {
        let event = NewEvent::of(job, now_ms, EventKind::Cancelled, String::new());
        insert_events(c, keys, &[event]).await?;
    }
    Ok(cancelled)
}

pub(super) async fn retry(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    job: JobId,
    now_ms: i64,
) -> Result<u64> {
    let key = keys.job(c, job).await?;
    let rows = sqlx::query(
        "DELETE FROM task_range WHERE state = 4 AND stage IN (SELECT key FROM stage WHERE job = ?) RETURNING \
         *, (SELECT id FROM job WHERE key = ?1) AS job_id, \
         (SELECT ordinal FROM stage WHERE stage.key = task_range.stage) AS ordinal",
    )
    .bind(key)
    .fetch_all(&mut *c)
    .await?;
    let mut retried = 0;
    for row in &rows {
        let mut range = query::range(row)?;
        retried += range.len();
        range.crashes = 0;
        range.state = RangeState::Pending { not_before_ms: 0 };
        let stage = keys.of(c, range.stage).await?.stage;
        give(c, stage, &range).await?;
        sqlx::query("DELETE FROM exception WHERE stage = ? AND task >= ? AND task < ?")
            .bind(stage)
            .bind(int(range.lo))
            .bind(int(range.hi))
            .execute(&mut *c)
            .await?;
    }
    if retried > 0 {
        sqlx::query("UPDATE job SET state = 0, ended_ms = NULL, tasks = NULL WHERE key = ?")
            .bind(key)
            .execute(&mut *c)
            .await
            .map_err(|e| match e.as_database_error() {
                Some(e) if e.is_unique_violation() => WriteError::Conflict(sql::LATER_JOB.into()),
                _ => WriteError::Sql(e),
            })?;
        let message = format!("{retried} dead tasks are pending again");
        let event = NewEvent::of(job, now_ms, EventKind::Retried, message);
        insert_events(c, keys, &[event]).await?;
    }
    Ok(retried)
}
