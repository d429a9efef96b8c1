//! Queries about jobs and stages, for one database: `job_queries!(SqliteConnection, SqliteRow)`
//! generates a module `job_query`, which uses the modules `query` (see [`crate::sql`]) and
//! `stage_query` (see [`crate::sql_stages`]).

/// The condition for jobs with a stage in the data set `$2` of the store `$1` that are active or
/// have written something.
macro_rules! at {
    () => {
        "key IN (SELECT stage.job FROM stage \
           JOIN result_set ON result_set.key = stage.result_set WHERE store = $1 AND dataset = $2 \
           AND (stage.done > 0 OR EXISTS (SELECT 1 FROM job AS live WHERE live.key = stage.job AND live.state = 0) \
             OR EXISTS (SELECT 1 FROM task_range WHERE task_range.stage = stage.key \
               AND task_range.state IN (2, 3))))"
    };
}
pub(crate) use at;

/// The condition that no task of a job may begin: it is paused, or a job before it is not done.
macro_rules! held {
    () => {
        "(job.paused OR EXISTS (SELECT 1 FROM job_after JOIN job AS former ON former.key = job_after.needs \
           WHERE job_after.job = job.key AND former.state <> 1))"
    };
}
pub(crate) use held;

macro_rules! job_queries {
    ($connection:ty, $row:ty) => {
        pub(crate) mod job_query {
            use std::{collections::BTreeMap, sync::Arc};

            use picofarm_proto::{ids::{JobId, StageRef}, messages::JobState, spec::JobSpec};
            use sqlx::Row;

            use super::query::{exception, stage_of, uint};
            use super::stage_query::{final_stages, nodes};
            use picofarm_catalog::{FormerJob, Free, Holdups, Job, JobRecord, ResultSet, Timing, Sight, Specs};
            use crate::{seen::seen, sql::{self, bad}, sql_jobs::{at, held}};

            type Connection = $connection;
            type DbRow = $row;
            type Result<T> = std::result::Result<T, sqlx::Error>;

            fn job(row: &DbRow) -> Result<Job> {
                let spec: JobSpec =
                    serde_json::from_str(row.try_get("spec")?).map_err(|e| bad("spec", e))?;
                Ok(Job {
                    id: JobId::from_uuid(row.try_get("id")?),
                    spec_hash: row.try_get("spec_hash")?,
                    spec: Arc::new(spec),
                    state: sql::job_state(row.try_get("state")?)?,
                    submitted_ms: row.try_get("submitted_ms")?,
                    ended_ms: row.try_get("ended_ms")?,
                    paused: row.try_get("paused")?,
                    user: row.try_get("username")?,
                })
            }

            pub(crate) async fn active_jobs(c: &mut Connection) -> Result<Vec<Job>> {
                let rows = sqlx::query("SELECT * FROM job WHERE state = 0 ORDER BY key")
                    .fetch_all(c)
                    .await?;
                rows.iter().map(job).collect()
            }

            /// Returns the active jobs, and whether each is paused or waits for another job.
            pub(crate) async fn active(c: &mut Connection) -> Result<BTreeMap<JobId, bool>> {
                let rows = sqlx::query(concat!("SELECT id, ", held!(), " AS paused FROM job WHERE state = 0"))
                    .fetch_all(c)
                    .await?;
                rows.iter()
                    .map(|row| Ok((JobId::from_uuid(row.try_get("id")?), row.try_get("paused")?)))
                    .collect()
            }

            /// Returns the unowned pending tasks of open stages of active jobs.
            pub(crate) async fn free(c: &mut Connection, now_ms: i64) -> Result<BTreeMap<StageRef, Free>> {
                let rows = sqlx::query(concat!(
                    "SELECT job.id AS job_id, stage.ordinal, ",
                    $crate::sql_jobs::free_columns!("$1"),
                    " FROM task_range \
                     JOIN stage ON stage.key = task_range.stage JOIN job ON job.key = stage.job \
                     WHERE task_range.state = 0 AND owner IS NULL AND stage.state = 1 AND job.state = 0 \
                     GROUP BY job.id, stage.ordinal",
                ))
                .bind(now_ms)
                .fetch_all(c)
                .await?;
                rows.iter()
                    .map(|row| Ok((stage_of(row)?, free_of(row)?)))
                    .collect()
            }

            /// Returns the unowned tasks of one stage.
            pub(crate) async fn free_of_stage(c: &mut Connection, key: i64, now_ms: i64) -> Result<Free> {
                let row = sqlx::query(concat!(
                    "SELECT ",
                    $crate::sql_jobs::free_columns!("$2"),
                    " FROM task_range JOIN stage ON stage.key = task_range.stage \
                     WHERE stage = $1 AND task_range.state = 0 AND owner IS NULL AND stage.state = 1",
                ))
                .bind(key)
                .bind(now_ms)
                .fetch_one(c)
                .await?;
                free_of(&row)
            }

            fn free_of(row: &DbRow) -> Result<Free> {
                Ok(Free {
                    ready: uint(row, "ready")?,
                    suspects: uint(row, "suspects")?,
                    later: uint(row, "later")?,
                    next_ms: row.try_get("next_ms")?,
                })
            }

            pub(crate) async fn timing(c: &mut Connection, set: &ResultSet) -> Result<Timing> {
                let row = sqlx::query(
                    "SELECT count(*) AS timed, CAST(coalesce(sum(seconds), 0) AS DOUBLE PRECISION) AS seconds, \
                     CAST(coalesce(sum(bytes), 0) AS DOUBLE PRECISION) AS bytes \
                     FROM output WHERE NOT adopted AND result_set = \
                     (SELECT key FROM result_set WHERE store = $1 AND dataset = $2 AND stage_key = $3)",
                )
                .bind(&set.store)
                .bind(&set.dataset)
                .bind(&set.stage_key.0[..])
                .fetch_one(c)
                .await?;
                Ok(Timing {
                    tasks: uint(&row, "timed")?,
                    seconds: row.try_get("seconds")?,
                    bytes: row.try_get("bytes")?,
                })
            }

            /// Returns a job with its counts.
            pub(crate) async fn record(c: &mut Connection, id: JobId) -> Result<Option<JobRecord>> {
                let row = sqlx::query("SELECT * FROM job WHERE id = $1")
                    .bind(id.uuid())
                    .fetch_optional(&mut *c)
                    .await?;
                let Some(row) = row else {
                    return Ok(None);
                };
                let key: i64 = row.try_get("key")?;
                let stages = match row.try_get::<Option<i64>, _>("tasks")? {
                    Some(_) => final_stages(c, key).await?,
                    None => {
                        let nodes = nodes(c, key).await?;
                        nodes.into_iter().map(|(stage, _)| stage).collect()
                    }
                };
                Ok(Some(JobRecord {
                    job: job(&row)?,
                    stages,
                    timing: Timing {
                        tasks: uint(&row, "timed")?,
                        seconds: row.try_get("seconds")?,
                        // A job's row has no total size; only its outputs do.
                        bytes: 0.0,
                    },
                    unverified: unverified(c, key).await?,
                }))
            }

            /// Returns the number of a job's results that were not found in their store.
            async fn unverified(c: &mut Connection, key: i64) -> Result<u64> {
                let row = sqlx::query(
                    "SELECT count(*) AS results FROM stage JOIN output ON output.result_set = stage.result_set \
                     AND output.task < stage.tasks WHERE stage.job = $1 AND output.checked = $2",
                )
                .bind(key)
                .bind(false)
                .fetch_one(c)
                .await?;
                uint(&row, "results")
            }

            /// Cancels an active job. Returns `false` if it is not active.
            pub(crate) async fn cancel(c: &mut Connection, key: i64, now_ms: i64) -> Result<bool> {
                let cancelled =
                    sqlx::query("UPDATE job SET state = $1, ended_ms = $2 WHERE key = $3 AND state = 0")
                        .bind(sql::job_state_code(JobState::Cancelled))
                        .bind(now_ms)
                        .bind(key)
                        .execute(c)
                        .await?;
                Ok(cancelled.rows_affected() > 0)
            }

            /// Pauses or resumes an active job. Returns `false` if that changes nothing.
            pub(crate) async fn pause(c: &mut Connection, key: i64, paused: bool) -> Result<bool> {
                let changed = sqlx::query("UPDATE job SET paused = $1 WHERE key = $2 AND state = 0 AND paused <> $1")
                    .bind(paused)
                    .bind(key)
                    .execute(c)
                    .await?;
                Ok(changed.rows_affected() > 0)
            }

            /// Returns the state of a job.
            pub(crate) async fn state(c: &mut Connection, id: JobId) -> Result<Option<JobState>> {
                let state: Option<i64> = sqlx::query_scalar("SELECT state FROM job WHERE id = $1")
                    .bind(id.uuid())
                    .fetch_optional(c)
                    .await?;
                state.map(sql::job_state).transpose()
            }

            /// Marks a done job with lost results, so that another job with the same spec may be
            /// recorded.
            pub(crate) async fn supersede(c: &mut Connection, id: JobId) -> Result<()> {
                sqlx::query("UPDATE job SET superseded = $1 WHERE id = $2 AND state = 1")
                    .bind(true)
                    .bind(id.uuid())
                    .execute(c)
                    .await?;
                Ok(())
            }

            /// Returns the number of a user's active jobs.
            pub(crate) async fn unfinished_jobs(c: &mut Connection, user: &str) -> Result<u64> {
                let row = sqlx::query("SELECT count(*) AS jobs FROM job WHERE username = $1 AND state = 0")
                    .bind(user)
                    .fetch_one(c)
                    .await?;
                uint(&row, "jobs")
            }

            pub(crate) async fn job_with(c: &mut Connection, spec_hash: &str) -> Result<Option<Job>> {
                let row = sqlx::query("SELECT * FROM job WHERE spec_hash = $1 ORDER BY key DESC LIMIT 1")
                    .bind(spec_hash)
                    .fetch_optional(c)
                    .await?;
                row.as_ref().map(job).transpose()
            }

            /// The maximum total size of the specs of the latest jobs, because they are in memory
            /// at the same time.
            const RECENT_BYTES: i64 = 16 << 20;

            /// Returns the latest jobs in any state, newest first.
            pub(crate) async fn recent(c: &mut Connection, most: u32, sight: &Sight) -> Result<Vec<Job>> {
                let [all, user, projects] = crate::seen::columns(sight);
                let text = concat!(
                    "SELECT * FROM job WHERE key IN (SELECT key FROM (SELECT key, \
                     sum(octet_length(spec)) OVER (ORDER BY key DESC) AS total FROM (SELECT key, spec FROM job WHERE ",
                    seen!("$2", "$3", "$4"),
                    " ORDER BY key DESC LIMIT $1) AS latest) AS sized WHERE total <= $5) ORDER BY key DESC"
                );
                let rows = sqlx::query(text)
                    .bind(i64::from(most))
                    .bind(all)
                    .bind(user)
                    .bind(projects)
                    .bind(RECENT_BYTES)
                    .fetch_all(c)
                    .await?;
                rows.iter().map(job).collect()
            }

            pub(crate) async fn spec_bytes(c: &mut Connection, specs: Specs<'_>) -> Result<u64> {
                let bytes: Option<i64> = match specs {
                    Specs::Job(id) => {
                        sqlx::query_scalar("SELECT CAST(octet_length(spec) AS BIGINT) FROM job WHERE id = $1")
                            .bind(id.uuid())
                            .fetch_optional(c)
                            .await?
                    }
                    Specs::With(hash) => {
                        sqlx::query_scalar(
                            "SELECT CAST(octet_length(spec) AS BIGINT) FROM job WHERE spec_hash = $1 \
                             ORDER BY key DESC LIMIT 1",
                        )
                        .bind(hash)
                        .fetch_optional(c)
                        .await?
                    }
                    Specs::At(store, dataset) => {
                        let text = concat!(
                            "SELECT CAST(coalesce(sum(octet_length(spec)), 0) AS BIGINT) FROM job WHERE ",
                            at!()
                        );
                        let sum = sqlx::query_scalar(text).bind(store).bind(dataset);
                        sum.fetch_optional(c).await?
                    }
                    Specs::Recent(most, sight) => {
                        let [all, user, projects] = crate::seen::columns(sight);
                        let text = concat!(
                            "SELECT CAST(coalesce(sum(octet_length(spec)), 0) AS BIGINT) FROM (SELECT spec FROM job WHERE ",
                            seen!("$2", "$3", "$4"),
                            " ORDER BY key DESC LIMIT $1) AS latest"
                        );
                        let sum = sqlx::query_scalar(text)
                            .bind(i64::from(most))
                            .bind(all)
                            .bind(user)
                            .bind(projects);
                        let sum: Option<i64> = sum.fetch_optional(c).await?;
                        sum.map(|sum| sum.min(RECENT_BYTES))
                    }
                };
                Ok(bytes.and_then(|n| u64::try_from(n).ok()).unwrap_or(0))
            }

            /// Returns jobs with a stage in a data set that are active or have written something.
            pub(crate) async fn jobs_at(c: &mut Connection, store: &str, dataset: &str) -> Result<Vec<Job>> {
                let rows = sqlx::query(concat!("SELECT * FROM job WHERE ", at!(), " ORDER BY key DESC"))
                .bind(store)
                .bind(dataset)
                .fetch_all(c)
                .await?;
                rows.iter().map(job).collect()
            }

            /// Returns whether all of these jobs exist.
            pub(crate) async fn exist(c: &mut Connection, jobs: &[JobId]) -> Result<bool> {
                for job in jobs {
                    if state(&mut *c, *job).await?.is_none() {
                        return Ok(false);
                    }
                }
                Ok(true)
            }

            /// Records that a job begins when others are done.
            pub(crate) async fn begin_after(c: &mut Connection, key: i64, after: &[JobId]) -> Result<()> {
                for former in after {
                    sqlx::query(
                        "INSERT INTO job_after (job, needs) SELECT $1, key FROM job WHERE id = $2 ON CONFLICT DO NOTHING",
                    )
                    .bind(key)
                    .bind(former.uuid())
                    .execute(&mut *c)
                    .await?;
                }
                Ok(())
            }

            /// Returns the jobs that must be done before this one begins, and are not.
            async fn formers(c: &mut Connection, job: JobId) -> Result<Vec<FormerJob>> {
                let rows = sqlx::query(
                    "SELECT former.id, former.key, former.state FROM job_after JOIN job ON job.key = job_after.job \
                     JOIN job AS former ON former.key = job_after.needs \
                     WHERE job.id = $1 AND former.state <> 1 ORDER BY former.key",
                )
                .bind(job.uuid())
                .fetch_all(c)
                .await?;
                rows.iter()
                    .map(|row| {
                        Ok(FormerJob {
                            job: JobId::from_uuid(row.try_get("id")?),
                            number: uint(row, "key")?,
                            state: sql::job_state(row.try_get("state")?)?,
                        })
                    })
                    .collect()
            }

            pub(crate) async fn holdups(c: &mut Connection, job: JobId, now_ms: i64) -> Result<Holdups> {
                let row = sqlx::query(
                    "SELECT \
                     CAST(coalesce(sum(CASE WHEN not_before_ms <= $2 THEN hi - lo ELSE 0 END), 0) AS BIGINT) AS ready, \
                     CAST(coalesce(sum(CASE WHEN not_before_ms > $2 THEN hi - lo ELSE 0 END), 0) AS BIGINT) AS waiting, \
                     min(CASE WHEN not_before_ms > $2 THEN not_before_ms END) AS next_ms \
                     FROM task_range JOIN stage ON stage.key = task_range.stage JOIN job ON job.key = stage.job \
                     WHERE job.id = $1 AND task_range.state = 0 AND stage.state = 1",
                )
                .bind(job.uuid())
                .bind(now_ms)
                .fetch_one(&mut *c)
                .await?;
                let failed = sqlx::query(
                    "SELECT exception.*, job.id AS job_id, stage.ordinal FROM exception \
                     JOIN stage ON stage.key = exception.stage JOIN job ON job.key = stage.job \
                     WHERE job.id = $1 ORDER BY dead DESC, failures + crashes + interruptions DESC, task LIMIT 5",
                )
                .bind(job.uuid())
                .fetch_all(&mut *c)
                .await?;
                Ok(Holdups {
                    after: formers(c, job).await?,
                    ready: uint(&row, "ready")?,
                    waiting: uint(&row, "waiting")?,
                    next_ms: row.try_get("next_ms")?,
                    failed: failed
                        .iter()
                        .map(|row| exception(row, stage_of(row)?))
                        .collect::<Result<_>>()?,
                })
            }
        }
    };
}

/// The columns of a [`Free`](picofarm_catalog::Free); the parameter `$now` is the current time.
macro_rules! free_columns {
    ($now:literal) => {
        concat!(
            "CAST(coalesce(sum(CASE WHEN not_before_ms <= ",
            $now,
            " AND crashes = 0 THEN hi - lo ELSE 0 END), 0) \
             AS BIGINT) AS ready, ",
            "CAST(coalesce(sum(CASE WHEN not_before_ms <= ",
            $now,
            " AND crashes > 0 THEN hi - lo ELSE 0 END), 0) \
             AS BIGINT) AS suspects, ",
            "CAST(coalesce(sum(CASE WHEN not_before_ms > ",
            $now,
            " THEN hi - lo ELSE 0 END), 0) AS BIGINT) AS later, ",
            "min(CASE WHEN not_before_ms > ",
            $now,
            " THEN not_before_ms END) AS next_ms",
        )
    };
}

pub(crate) use free_columns;
pub(crate) use job_queries;
