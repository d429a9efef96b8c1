//! Operations on whole jobs: record, end, cancel and retry.

use std::collections::HashMap;

use picofarm_proto::{
    ids::{JobId, StageRef},
    messages::EventKind,
};
use sqlx::SqliteConnection;

use super::{
    job_query, query, rights_query,
    rows::{give, insert_events, insert_ranges},
    stage_query,
    writer::{Keys, Result, WriteError},
};
use crate::sql::{self, int};
use picofarm_catalog::{NewEvent, Outcome, RangeState, Settled, StageRecord, Submission};

/// If a stage is over, opens the stages that waited for it, and ends the job if it was the last.
pub(super) async fn stage_over(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    stage: StageRef,
    at_ms: i64,
) -> Result<Settled> {
    let key = keys.stage(c, stage).await?;
    let state: i64 = sqlx::query_scalar("SELECT state FROM job WHERE key = ?")
        .bind(key.job)
        .fetch_one(&mut *c)
        .await?;
    if state != 0 || stage_query::is_open(c, key.stage).await? {
        return Ok(Settled::default());
    }
    settle(c, keys, stage.job, at_ms).await
}

async fn settle(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    id: JobId,
    at_ms: i64,
) -> Result<Settled> {
    let key = keys.job(c, id).await?;
    let (settled, events) = stage_query::settle(c, key, id, at_ms).await?;
    insert_events(c, keys, &events).await?;
    Ok(settled)
}

/// Records a job. `spec` is its spec in JSON.
pub(super) async fn record(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    submission: &Submission<'_>,
    spec: &str,
) -> Result<Outcome> {
    for (set, run) in submission.done() {
        if query::checked(&mut *c, set, run).await? < run.hi - run.lo {
            return Ok(Outcome::Changed);
        }
    }
    if !job_query::exist(&mut *c, submission.after).await? {
        return Ok(Outcome::Changed);
    }
    let free = rights_query::free_places(&mut *c, submission.places, submission.permitted).await?;
    let Some(free) = free else {
        return Ok(Outcome::Changed);
    };
    if let Some(former) = submission.instead_of {
        job_query::supersede(&mut *c, former).await?;
    }
    let job = submission.job;
    let key: Option<i64> = sqlx::query_scalar(
        "INSERT INTO job (id, spec_hash, spec, state, submitted_ms, username, project, name) VALUES (?, ?, ?, 0, ?, ?, ?, ?) \
         ON CONFLICT DO NOTHING RETURNING key",
    )
    .bind(job.id.uuid())
    .bind(&job.spec_hash)
    .bind(spec)
    .bind(job.submitted_ms)
    .bind(&job.user)
    .bind(&job.spec.project)
    .bind(&job.spec.name)
    .fetch_optional(&mut *c)
    .await?;
    let Some(key) = key else {
        return Ok(Outcome::Exists);
    };
    job_query::begin_after(&mut *c, key, submission.after).await?;
    rights_query::take_places(&mut *c, &free).await?;
    for gone in submission.gone {
        query::drop_output(&mut *c, gone).await?;
    }
    let mut stages = HashMap::new();
    for stage in submission.stages {
        let key = insert_stage(&mut *c, key, stage).await?;
        stages.insert(stage.id, key);
    }
    let rows: Vec<_> = submission
        .ranges
        .iter()
        .map(|r| (stages[&r.stage], r))
        .collect();
    insert_ranges(c, &rows, false).await?;
    insert_events(c, keys, submission.events).await?;
    settle(c, keys, job.id, job.submitted_ms).await?;
    Ok(Outcome::New)
}

/// Records a stage of the job with this key. Returns the stage's key.
async fn insert_stage(c: &mut SqliteConnection, job: i64, stage: &StageRecord) -> Result<i64> {
    let set = &stage.set;
    sqlx::query(
        "INSERT INTO result_set (store, dataset, stage_key) VALUES (?, ?, ?) ON CONFLICT DO NOTHING",
    )
    .bind(&set.store)
    .bind(&set.dataset)
    .bind(&set.stage_key.0[..])
    .execute(&mut *c)
    .await?;
    let key = sqlx::query_scalar(
        "INSERT INTO stage (job, ordinal, result_set, tasks, state, needs, tolerate_dead) \
             SELECT ?1, ?2, key, ?3, 0, ?7, ?8 FROM result_set \
             WHERE store = ?4 AND dataset = ?5 AND stage_key = ?6 RETURNING key",
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
    c: &mut SqliteConnection,
    keys: &mut Keys,
    job: JobId,
    why: &str,
    now_ms: i64,
) -> Result<bool> {
    let key = keys.job(c, job).await?;
    let cancelled = job_query::cancel(c, key, now_ms).await?;
    if cancelled {
        let event = NewEvent::new(job, now_ms, EventKind::Cancelled, why.to_owned());
        insert_events(c, keys, &[event]).await?;
    }
    Ok(cancelled)
}

pub(super) async fn pause(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    job: JobId,
    paused: bool,
    who: &str,
    now_ms: i64,
) -> Result<bool> {
    let key = keys.job(c, job).await?;
    let changed = job_query::pause(c, key, paused).await?;
    if changed {
        let kind = match paused {
            true => EventKind::Paused,
            false => EventKind::Resumed,
        };
        let event = NewEvent::new(job, now_ms, kind, who.to_owned());
        insert_events(c, keys, &[event]).await?;
    }
    Ok(changed)
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
        let stage = keys.stage(c, range.stage).await?.stage;
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
        let event = NewEvent::new(job, now_ms, EventKind::Retried, message);
        insert_events(c, keys, &[event]).await?;
        settle(c, keys, job, now_ms).await?;
    }
    Ok(retried)
}
