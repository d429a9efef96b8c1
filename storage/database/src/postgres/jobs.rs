//! Operations on whole jobs: record, end, cancel and retry.

use std::collections::HashMap;

use picofarm_proto::{
    ids::{JobId, StageRef},
    messages::EventKind,
};

use sqlx::PgConnection;

use super::{
    job_query, query, rights_query,
    rows::{give, insert_events, insert_ranges},
    stage_query,
    writer::{RANGE, Result, WriteError, Writer, ranges},
};
use crate::sql::{self, int};
use picofarm_catalog::{NewEvent, Outcome, RangeState, Settled, StageRecord, Submission};

/// If a stage is over, opens the stages that waited for it, and ends the job if it was the last.
/// The job's row is locked first, so that if two instances finish their last tasks at the same
/// time, the second sees the changes of the first.
pub(super) async fn stage_over(
    writer: &mut Writer<'_>,
    stage: StageRef,
    at_ms: i64,
) -> Result<Settled> {
    let keys = writer.keys(stage).await?;
    if !hold(writer, keys.job).await? || stage_query::is_open(writer.c, keys.stage).await? {
        return Ok(Settled::default());
    }
    settle(writer, stage.job, at_ms).await
}

/// Locks the row of a job. Returns whether the job is active.
async fn hold(writer: &mut Writer<'_>, key: i64) -> Result<bool> {
    let state: Option<i64> = sqlx::query_scalar("SELECT state FROM job WHERE key = $1 FOR UPDATE")
        .bind(key)
        .fetch_optional(&mut *writer.c)
        .await?;
    Ok(state == Some(0))
}

async fn settle(writer: &mut Writer<'_>, id: JobId, at_ms: i64) -> Result<Settled> {
    let key = writer.job(id).await?;
    let (settled, events) = stage_query::settle(writer.c, key, id, at_ms).await?;
    insert_events(writer, &events).await?;
    Ok(settled)
}

/// Records a job. `spec` is its spec in JSON.
pub(super) async fn record(
    writer: &mut Writer<'_>,
    submission: &Submission<'_>,
    spec: &str,
) -> Result<Outcome> {
    for (set, run) in submission.done() {
        if query::checked(&mut *writer.c, set, run).await? < run.hi - run.lo {
            return Ok(Outcome::Changed);
        }
    }
    if !submission.places.is_empty() {
        // Two submitters at two coordinators must not both take a folder and its subfolder.
        sqlx::query("LOCK TABLE owned_place IN SHARE ROW EXCLUSIVE MODE")
            .execute(&mut *writer.c)
            .await?;
    }
    if !job_query::exist(&mut *writer.c, submission.after).await? {
        return Ok(Outcome::Changed);
    }
    let free =
        rights_query::free_places(&mut *writer.c, submission.places, submission.permitted).await?;
    let Some(free) = free else {
        return Ok(Outcome::Changed);
    };
    if let Some(former) = submission.instead_of {
        job_query::supersede(&mut *writer.c, former).await?;
    }
    let job = submission.job;
    let key: Option<i64> = sqlx::query_scalar(
        "INSERT INTO job (id, spec_hash, spec, state, submitted_ms, username, project, name) \
         VALUES ($1, $2, $3, 0, $4, $5, $6, $7) \
         ON CONFLICT DO NOTHING RETURNING key",
    )
    .bind(job.id.uuid())
    .bind(&job.spec_hash)
    .bind(spec)
    .bind(job.submitted_ms)
    .bind(&job.user)
    .bind(&job.spec.project)
    .bind(&job.spec.name)
    .fetch_optional(&mut *writer.c)
    .await?;
    let Some(key) = key else {
        return Ok(Outcome::Exists);
    };
    job_query::begin_after(&mut *writer.c, key, submission.after).await?;
    rights_query::take_places(&mut *writer.c, &free).await?;
    for gone in submission.gone {
        query::drop_output(&mut *writer.c, gone).await?;
    }
    let mut stages = HashMap::new();
    for stage in submission.stages {
        let key = insert_stage(&mut *writer.c, key, stage).await?;
        stages.insert(stage.id, key);
    }
    let rows: Vec<_> = submission
        .ranges
        .iter()
        .map(|r| (stages[&r.stage], r))
        .collect();
    insert_ranges(writer, &rows, false).await?;
    insert_events(writer, submission.events).await?;
    settle(writer, job.id, job.submitted_ms).await?;
    Ok(Outcome::New)
}

/// Records a stage of the job with this key. Returns the stage's key.
async fn insert_stage(c: &mut PgConnection, job: i64, stage: &StageRecord) -> Result<i64> {
    let set = &stage.set;
    sqlx::query(
        // The update locks the row, so that a concurrent deletion of results waits instead of
        // deleting the row that this stage refers to.
        "INSERT INTO result_set (store, dataset, stage_key) VALUES ($1, $2, $3) \
         ON CONFLICT (store, dataset, stage_key) DO UPDATE SET store = excluded.store",
    )
    .bind(&set.store)
    .bind(&set.dataset)
    .bind(&set.stage_key.0[..])
    .execute(&mut *c)
    .await?;
    let key = sqlx::query_scalar(
        "INSERT INTO stage (job, ordinal, result_set, tasks, state, needs, tolerate_dead) \
             SELECT $1, $2, key, $3, 0, $7, $8 FROM result_set \
             WHERE store = $4 AND dataset = $5 AND stage_key = $6 RETURNING key",
    )
    .bind(job)
    .bind(i64::from(stage.id.stage))
    .bind(int(stage.tasks))
    .bind(&set.store)
    .bind(&set.dataset)
    .bind(&set.stage_key.0[..])
    .bind(sql::needs_text(&stage.needs))
    .bind(stage.tolerate_dead)
    .fetch_one(c)
    .await?;
    Ok(key)
}

pub(super) async fn cancel(
    writer: &mut Writer<'_>,
    job: JobId,
    why: &str,
    now_ms: i64,
) -> Result<bool> {
    let key = writer.job(job).await?;
    let cancelled = job_query::cancel(writer.c, key, now_ms).await?;
    if cancelled {
        let event = NewEvent::new(job, now_ms, EventKind::Cancelled, why.to_owned());
        insert_events(writer, &[event]).await?;
    }
    Ok(cancelled)
}

pub(super) async fn pause(
    writer: &mut Writer<'_>,
    job: JobId,
    paused: bool,
    who: &str,
    now_ms: i64,
) -> Result<bool> {
    let key = writer.job(job).await?;
    let changed = job_query::pause(writer.c, key, paused).await?;
    if changed {
        let kind = match paused {
            true => EventKind::Paused,
            false => EventKind::Resumed,
        };
        let event = NewEvent::new(job, now_ms, kind, who.to_owned());
        insert_events(writer, &[event]).await?;
    }
    Ok(changed)
}

pub(super) async fn retry(writer: &mut Writer<'_>, job: JobId, now_ms: i64) -> Result<u64> {
    let key = writer.job(job).await?;
    // The job's row is locked first, as in the transaction that ends a job.
    hold(writer, key).await?;
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "DELETE FROM task_range WHERE state = 4 AND stage IN (SELECT key FROM stage WHERE job = $1) RETURNING {RANGE}"
    )))
    .bind(key)
    .fetch_all(&mut *writer.c)
    .await?;
    let mut retried = 0;
    for mut range in ranges(&rows)? {
        retried += range.len();
        range.crashes = 0;
        range.state = RangeState::Pending { not_before_ms: 0 };
        let stage = writer.keys(range.stage).await?.stage;
        give(writer, stage, &range).await?;
        sqlx::query("DELETE FROM exception WHERE stage = $1 AND task >= $2 AND task < $3")
            .bind(stage)
            .bind(int(range.lo))
            .bind(int(range.hi))
            .execute(&mut *writer.c)
            .await?;
    }
    if retried > 0 {
        sqlx::query("UPDATE job SET state = 0, ended_ms = NULL, tasks = NULL WHERE key = $1")
            .bind(key)
            .execute(&mut *writer.c)
            .await
            .map_err(|e| match e.as_database_error() {
                Some(e) if e.is_unique_violation() => WriteError::Conflict(sql::LATER_JOB.into()),
                _ => WriteError::Sql(e),
            })?;
        let message = format!("{retried} dead tasks are pending again");
        let event = NewEvent::new(job, now_ms, EventKind::Retried, message);
        insert_events(writer, &[event]).await?;
        settle(writer, job, now_ms).await?;
    }
    Ok(retried)
}
