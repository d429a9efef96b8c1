//! Jobs as a whole: recorded, ended, cancelled, tried again.

use std::collections::HashMap;

use picofarm_proto::{
    ids::JobId,
    model::{EventKind, JobState},
};

use super::{
    query,
    write::{Desk, RANGE, Result, WriteError, give, insert_events, insert_ranges, ranges},
};
use crate::{
    Job, JobEnd, NewEvent, Range, RangeState,
    sql::{self, int},
};

/// Ends an active job of which nothing is pending or leased. Its row is locked first: of two houses that finish their
/// last tasks at once, the second sees what the first wrote.
pub(super) async fn end_if_over(
    desk: &mut Desk<'_>,
    id: JobId,
    at_ms: i64,
) -> Result<Option<JobEnd>> {
    let key = desk.job(id).await?;
    let active: Option<i32> =
        sqlx::query_scalar("SELECT 1 FROM job WHERE key = $1 AND state = 0 FOR UPDATE")
            .bind(key)
            .fetch_optional(&mut *desk.c)
            .await?;
    if active.is_none() {
        return Ok(None);
    }
    let open: Option<i32> = sqlx::query_scalar(
        "SELECT 1 FROM task_range JOIN stage ON stage.key = task_range.stage \
         WHERE stage.job = $1 AND state IN (0, 1) LIMIT 1",
    )
    .bind(key)
    .fetch_optional(&mut *desk.c)
    .await?;
    if open.is_some() {
        return Ok(None);
    }
    let counts = query::counts(desk.c, key).await?;
    let state = if counts.dead > 0 {
        JobState::Failed
    } else {
        JobState::Done
    };
    sqlx::query(
        "UPDATE job SET state = $2, ended_ms = $3, tasks = $4, done = $5, reused = $6, dead = $7, \
         (timed, seconds) = (SELECT count(*), coalesce(sum(seconds), 0) FROM output \
           WHERE NOT adopted AND result_set IN (SELECT result_set FROM stage WHERE job = $1)) WHERE key = $1",
    )
    .bind(key)
    .bind(sql::job_state_code(state))
    .bind(at_ms)
    .bind(int(counts.total))
    .bind(int(counts.done))
    .bind(int(counts.reused))
    .bind(int(counts.dead))
    .execute(&mut *desk.c)
    .await?;
    insert_events(desk, &[NewEvent::ended(id, at_ms, &counts)]).await?;
    Ok(Some(JobEnd {
        job: id,
        state,
        at_ms,
    }))
}

pub(super) async fn submit(
    desk: &mut Desk<'_>,
    job: &Job,
    ranges: &[Range],
    events: &[NewEvent],
) -> Result<bool> {
    let spec = serde_json::to_string(&*job.spec).expect("a spec is plain data");
    let key: Option<i64> = sqlx::query_scalar(
        "INSERT INTO job (id, spec_hash, spec, state, submitted_ms) VALUES ($1, $2, $3, 0, $4) \
         ON CONFLICT DO NOTHING RETURNING key",
    )
    .bind(job.id.uuid())
    .bind(&job.spec_hash)
    .bind(spec)
    .bind(job.submitted_ms)
    .fetch_optional(&mut *desk.c)
    .await?;
    let Some(key) = key else {
        return Ok(false);
    };
    let mut stages = HashMap::new();
    for stage in job.stages() {
        let set = &stage.set;
        sqlx::query(
            "INSERT INTO result_set (store, dataset, stage_key) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING",
        )
        .bind(&set.store)
        .bind(&set.dataset)
        .bind(&set.stage_key.0[..])
        .execute(&mut *desk.c)
        .await?;
        let stage_key: i64 = sqlx::query_scalar(
            "INSERT INTO stage (job, ordinal, result_set, tasks) SELECT $1, $2, key, $3 FROM result_set \
             WHERE store = $4 AND dataset = $5 AND stage_key = $6 RETURNING key",
        )
        .bind(key)
        .bind(i64::from(stage.id.stage))
        .bind(int(stage.tasks))
        .bind(&set.store)
        .bind(&set.dataset)
        .bind(&set.stage_key.0[..])
        .fetch_one(&mut *desk.c)
        .await?;
        stages.insert(stage.id, stage_key);
    }
    let rows: Vec<_> = ranges.iter().map(|r| (stages[&r.stage], r)).collect();
    insert_ranges(desk, &rows, false).await?;
    insert_events(desk, events).await?;
    end_if_over(desk, job.id, job.submitted_ms).await?;
    Ok(true)
}

pub(super) async fn cancel(desk: &mut Desk<'_>, job: JobId, now_ms: i64) -> Result<bool> {
    let key = desk.job(job).await?;
    let cancelled =
        sqlx::query("UPDATE job SET state = $1, ended_ms = $2 WHERE key = $3 AND state = 0")
            .bind(sql::job_state_code(JobState::Cancelled))
            .bind(now_ms)
            .bind(key)
            .execute(&mut *desk.c)
            .await?
            .rows_affected()
            > 0;
    if cancelled {
        let event = NewEvent::of(job, now_ms, EventKind::Cancelled, String::new());
        insert_events(desk, &[event]).await?;
    }
    Ok(cancelled)
}

pub(super) async fn retry(desk: &mut Desk<'_>, job: JobId, now_ms: i64) -> Result<u64> {
    let key = desk.job(job).await?;
    // The job's row first, as whoever ends it does.
    sqlx::query("SELECT 1 FROM job WHERE key = $1 FOR UPDATE")
        .bind(key)
        .execute(&mut *desk.c)
        .await?;
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "DELETE FROM task_range WHERE state = 4 AND stage IN (SELECT key FROM stage WHERE job = $1) RETURNING {RANGE}"
    )))
    .bind(key)
    .fetch_all(&mut *desk.c)
    .await?;
    let mut retried = 0;
    for mut range in ranges(&rows)? {
        retried += range.len();
        range.crashes = 0;
        range.state = RangeState::Pending { not_before_ms: 0 };
        let stage = desk.keys(range.stage).await?.stage;
        give(desk, stage, &range).await?;
        sqlx::query("DELETE FROM exception WHERE stage = $1 AND task >= $2 AND task < $3")
            .bind(stage)
            .bind(int(range.lo))
            .bind(int(range.hi))
            .execute(&mut *desk.c)
            .await?;
    }
    if retried > 0 {
        sqlx::query("UPDATE job SET state = 0, ended_ms = NULL, tasks = NULL WHERE key = $1")
            .bind(key)
            .execute(&mut *desk.c)
            .await
            .map_err(|e| match e.as_database_error() {
                Some(e) if e.is_unique_violation() => WriteError::Conflict(sql::LATER_JOB.into()),
                _ => WriteError::Sql(e),
            })?;
        let message = format!("{retried} dead tasks are pending again");
        let event = NewEvent::of(job, now_ms, EventKind::Retried, message);
        insert_events(desk, &[event]).await?;
    }
    Ok(retried)
}
