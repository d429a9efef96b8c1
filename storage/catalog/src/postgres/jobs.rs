//! Jobs as a whole: recorded, ended, cancelled, tried again.

use std::collections::HashMap;

use picofarm_proto::{
    ids::{JobId, StageRef},
    model::EventKind,
};

use super::{
    job_query,
    write::{Desk, RANGE, Result, WriteError, give, insert_events, insert_ranges, ranges},
};
use crate::{
    Job, NewEvent, Range, RangeState, Settled,
    sql::{self, int},
};

/// Where a stage is over, opens those that waited for it and ends the job if that was the last. The job's row is locked
/// first: of two houses that finish their last tasks at once, the second sees what the first wrote.
pub(super) async fn stage_over(
    desk: &mut Desk<'_>,
    stage: StageRef,
    at_ms: i64,
) -> Result<Settled> {
    let keys = desk.keys(stage).await?;
    if !hold(desk, keys.job).await? || job_query::is_open(desk.c, keys.stage).await? {
        return Ok(Settled::default());
    }
    settle(desk, stage.job, at_ms).await
}

/// Locks the row of a job; whether it is active.
async fn hold(desk: &mut Desk<'_>, key: i64) -> Result<bool> {
    let state: Option<i64> = sqlx::query_scalar("SELECT state FROM job WHERE key = $1 FOR UPDATE")
        .bind(key)
        .fetch_optional(&mut *desk.c)
        .await?;
    Ok(state == Some(0))
}

async fn settle(desk: &mut Desk<'_>, id: JobId, at_ms: i64) -> Result<Settled> {
    let key = desk.job(id).await?;
    let (settled, events) = job_query::settle(desk.c, key, id, at_ms).await?;
    insert_events(desk, &events).await?;
    Ok(settled)
}

pub(super) async fn submit(
    desk: &mut Desk<'_>,
    job: &Job,
    ranges: &[Range],
    events: &[NewEvent],
) -> Result<bool> {
    let spec = serde_json::to_string(&*job.spec).expect("a spec is plain data");
    let key: Option<i64> = sqlx::query_scalar(
        "INSERT INTO job (id, spec_hash, spec, state, submitted_ms, username) VALUES ($1, $2, $3, 0, $4, $5) \
         ON CONFLICT DO NOTHING RETURNING key",
    )
    .bind(job.id.uuid())
    .bind(&job.spec_hash)
    .bind(spec)
    .bind(job.submitted_ms)
    .bind(&job.user)
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
            "INSERT INTO stage (job, ordinal, result_set, tasks, state, needs, tolerate_dead) \
             SELECT $1, $2, key, $3, 0, $7, $8 FROM result_set \
             WHERE store = $4 AND dataset = $5 AND stage_key = $6 RETURNING key",
        )
        .bind(key)
        .bind(i64::from(stage.id.stage))
        .bind(int(stage.tasks))
        .bind(&set.store)
        .bind(&set.dataset)
        .bind(&set.stage_key.0[..])
        .bind(sql::needs_text(&stage.needs))
        .bind(stage.tolerate_dead)
        .fetch_one(&mut *desk.c)
        .await?;
        stages.insert(stage.id, stage_key);
    }
    let rows: Vec<_> = ranges.iter().map(|r| (stages[&r.stage], r)).collect();
    insert_ranges(desk, &rows, false).await?;
    insert_events(desk, events).await?;
    settle(desk, job.id, job.submitted_ms).await?;
    Ok(true)
}

pub(super) async fn cancel(
    desk: &mut Desk<'_>,
    job: JobId,
    why: &str,
    now_ms: i64,
) -> Result<bool> {
    let key = desk.job(job).await?;
    let cancelled = job_query::cancel(desk.c, key, now_ms).await?;
    if cancelled {
        let event = NewEvent::of(job, now_ms, EventKind::Cancelled, why.to_owned());
        insert_events(desk, &[event]).await?;
    }
    Ok(cancelled)
}

pub(super) async fn pause(
    desk: &mut Desk<'_>,
    job: JobId,
    paused: bool,
    who: &str,
    now_ms: i64,
) -> Result<bool> {
    let key = desk.job(job).await?;
    let changed = job_query::pause(desk.c, key, paused).await?;
    if changed {
        let kind = match paused {
            true => EventKind::Paused,
            false => EventKind::Resumed,
        };
        let event = NewEvent::of(job, now_ms, kind, who.to_owned());
        insert_events(desk, &[event]).await?;
    }
    Ok(changed)
}

pub(super) async fn retry(desk: &mut Desk<'_>, job: JobId, now_ms: i64) -> Result<u64> {
    let key = desk.job(job).await?;
    // The job's row first, as whoever ends it does.
    hold(desk, key).await?;
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
        settle(desk, job, now_ms).await?;
    }
    Ok(retried)
}
