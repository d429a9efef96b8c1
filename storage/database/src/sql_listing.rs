//! Queries on many jobs, for one database: pages of the job list, and deletion of old jobs. They
//! never read a spec. `listing_queries!(Sqlite, SqliteConnection, SqliteRow, "")` generates a
//! module `listing_query`, which uses the module `job_query`. The last argument is the clause that
//! locks the rows of a query, if the database has one.

macro_rules! listing_queries {
    ($database:ty, $connection:ty, $row:ty, $lock:literal) => {
        pub(crate) mod listing_query {
            use std::collections::BTreeMap;

            use picofarm_proto::{ids::JobId, messages::{JobState, JobSummary, TaskCounts}};
            use sqlx::{QueryBuilder, Row};

            use super::query::{marks, uint};
            use picofarm_catalog::{Forgotten, JobQuery, Page, Mark};
            use crate::{seen::seen, sql::{self, bad}};

            type Connection = $connection;
            type DbRow = $row;
            type Result<T> = std::result::Result<T, sqlx::Error>;

            pub(crate) async fn page(c: &mut Connection, query: &JobQuery) -> Result<Page> {
                let [all, user, projects] = crate::seen::columns(&query.sight);
                let ids = query.find.as_deref().and_then(crate::listing::ids);
                let number = query.find.as_deref().and_then(crate::listing::number);
                let most = i64::from(query.limit.max(1));
                let mut rows = sqlx::query(concat!(
                    "SELECT key, id, name, username, project, state, paused, submitted_ms, ended_ms, tasks, done, reused, \
                     dead FROM job WHERE key < $1 AND (CAST($2 AS BIGINT) IS NULL OR state = $2) \
                     AND (CAST($3 AS TEXT) IS NULL OR username = $3) \
                     AND (CAST($4 AS TEXT) IS NULL OR key = $11 OR (id >= $5 AND id <= $6) \
                       OR (CAST($11 AS BIGINT) IS NULL AND name = $4)) AND ",
                    seen!("$7", "$8", "$9"),
                    " ORDER BY key DESC LIMIT $10"
                ))
                .bind(query.before.unwrap_or(i64::MAX))
                .bind(query.state.map(sql::job_state_code))
                .bind(&query.user)
                .bind(&query.find)
                .bind(ids.map(|(first, _)| first))
                .bind(ids.map(|(_, last)| last))
                .bind(all)
                .bind(user)
                .bind(projects)
                // One more row shows whether there is another page.
                .bind(most + 1)
                .bind(number)
                .fetch_all(&mut *c)
                .await?;
                let more = rows.len() as i64 > most;
                rows.truncate(usize::try_from(most).unwrap_or(usize::MAX));
                let mut keys = Vec::with_capacity(rows.len());
                let mut open = Vec::new();
                for row in &rows {
                    let key: i64 = row.try_get("key")?;
                    keys.push(key);
                    if row.try_get::<Option<i64>, _>("tasks")?.is_none() {
                        open.push(key);
                    }
                }
                let mut counts = counts(c, &open).await?;
                let jobs = rows.iter().zip(&keys).map(|(row, key)| {
                    let tasks = match row.try_get::<Option<i64>, _>("tasks")? {
                        Some(_) => ended(row)?,
                        None => counts.remove(key).unwrap_or_default(),
                    };
                    summary(row, tasks)
                });
                Ok(Page {
                    jobs: jobs.collect::<Result<_>>()?,
                    next: keys.last().copied().filter(|_| more),
                })
            }

            /// Returns the counts of a job that has ended, which are stored in its row.
            fn ended(row: &DbRow) -> Result<TaskCounts> {
                let (total, done, dead) = (uint(row, "tasks")?, uint(row, "done")?, uint(row, "dead")?);
                Ok(TaskCounts {
                    total,
                    done,
                    reused: uint(row, "reused")?,
                    leased: 0,
                    pending: total.saturating_sub(done + dead),
                    dead,
                })
            }

            fn summary(row: &DbRow, tasks: TaskCounts) -> Result<JobSummary> {
                let state = sql::job_state(row.try_get("state")?)?;
                Ok(JobSummary {
                    id: JobId::from_uuid(row.try_get("id")?),
                    number: uint(row, "key")?,
                    name: row.try_get("name")?,
                    user: row.try_get("username")?,
                    project: row.try_get("project")?,
                    state,
                    paused: row.try_get("paused")? && state == JobState::Active,
                    tasks,
                    submitted_at_ms: row.try_get("submitted_ms")?,
                    ended_at_ms: row.try_get("ended_ms")?,
                    left_s: None,
                })
            }

            /// Returns the number of tasks in each state of these jobs, counted from their ranges.
            async fn counts(c: &mut Connection, jobs: &[i64]) -> Result<BTreeMap<i64, TaskCounts>> {
                if jobs.is_empty() {
                    return Ok(BTreeMap::new());
                }
                let whole = of_jobs(
                    "SELECT stage.job, task_range.state, CAST(sum(hi - lo) AS BIGINT) AS tasks FROM stage \
                     JOIN task_range ON task_range.stage = stage.key WHERE task_range.state <> 1 AND stage.job IN (",
                    jobs,
                    ") GROUP BY stage.job, task_range.state",
                );
                let leased = of_jobs(
                    "SELECT stage.job, marks FROM stage JOIN task_range ON task_range.stage = stage.key \
                     WHERE task_range.state = 1 AND stage.job IN (",
                    jobs,
                    ")",
                );
                counted(c, whole, leased).await
            }

            /// Returns the number of tasks in each state over all active jobs.
            pub(crate) async fn active_tasks(c: &mut Connection) -> Result<TaskCounts> {
                // All tasks are counted under one job key.
                let whole = QueryBuilder::new(
                    "SELECT CAST(0 AS BIGINT) AS job, task_range.state, CAST(sum(hi - lo) AS BIGINT) AS tasks FROM job \
                     JOIN stage ON stage.job = job.key JOIN task_range ON task_range.stage = stage.key \
                     WHERE job.state = 0 AND task_range.state <> 1 GROUP BY task_range.state",
                );
                let leased = QueryBuilder::new(
                    "SELECT CAST(0 AS BIGINT) AS job, marks FROM job \
                     JOIN stage ON stage.job = job.key JOIN task_range ON task_range.stage = stage.key \
                     WHERE job.state = 0 AND task_range.state = 1",
                );
                let counts = counted(c, whole, leased).await?;
                Ok(counts.into_values().next().unwrap_or_default())
            }

            /// Returns the counts of two queries: of ranges by job and state, and of leased ranges
            /// by their marks.
            async fn counted(
                c: &mut Connection,
                mut whole: QueryBuilder<$database>,
                mut leased: QueryBuilder<$database>,
            ) -> Result<BTreeMap<i64, TaskCounts>> {
                let mut counts: BTreeMap<i64, TaskCounts> = BTreeMap::new();
                for row in &whole.build().fetch_all(&mut *c).await? {
                    let n = uint(row, "tasks")?;
                    let counts = counts.entry(row.try_get("job")?).or_default();
                    match row.try_get::<i64, _>("state")? {
                        sql::PENDING => counts.pending += n,
                        sql::DONE => counts.done += n,
                        sql::DONE_REUSED => {
                            counts.done += n;
                            counts.reused += n;
                        }
                        sql::DEAD => counts.dead += n,
                        other => return Err(bad("state", other)),
                    }
                }
                for row in &leased.build().fetch_all(c).await? {
                    let counts = counts.entry(row.try_get("job")?).or_default();
                    for mark in marks(row)? {
                        match mark {
                            Mark::Todo => counts.leased += 1,
                            Mark::Done => counts.done += 1,
                            Mark::Reused => {
                                counts.done += 1;
                                counts.reused += 1;
                            }
                            Mark::Left => {}
                        }
                    }
                }
                for counts in counts.values_mut() {
                    counts.total = counts.done + counts.leased + counts.pending + counts.dead;
                }
                Ok(counts)
            }

            /// Builds a statement with a list of keys.
            fn of_jobs(before: &str, keys: &[i64], after: &str) -> QueryBuilder<$database> {
                let mut text = QueryBuilder::new(before);
                let mut list = text.separated(", ");
                for key in keys {
                    list.push_bind(*key);
                }
                text.push(after);
                text
            }

            /// Deletes some old records: first jobs that ended before this time, with their
            /// history, then outputs of result sets without any job. It deletes few rows per call,
            /// because other writers wait.
            pub(crate) async fn forget(c: &mut Connection, before_ms: i64) -> Result<Forgotten> {
                let keys: Vec<i64> = sqlx::query_scalar(
                    // A job that an active one waits for stays.
                    "SELECT key FROM job WHERE state <> 0 AND ended_ms < $1 AND NOT EXISTS \
                       (SELECT 1 FROM job_after JOIN job AS later ON later.key = job_after.job \
                        WHERE job_after.needs = job.key AND later.state = 0) ORDER BY ended_ms LIMIT $2",
                )
                .bind(before_ms)
                .bind(crate::listing::JOBS)
                .fetch_all(&mut *c)
                .await?;
                if keys.is_empty() {
                    return forget_outputs(c).await;
                }
                let mut left = crate::listing::ROWS;
                // The job itself is deleted last. If it has too many rows, the next call deletes
                // the rest.
                for (before, after) in [
                    (
                        "DELETE FROM event WHERE sequence IN (SELECT sequence FROM event WHERE job IN (",
                        ") LIMIT ",
                    ),
                    (
                        "DELETE FROM exception WHERE (stage, task) IN (SELECT stage, task FROM exception \
                         WHERE stage IN (SELECT key FROM stage WHERE job IN (",
                        ")) LIMIT ",
                    ),
                    (
                        "DELETE FROM task_range WHERE id IN (SELECT id FROM task_range \
                         WHERE stage IN (SELECT key FROM stage WHERE job IN (",
                        ")) LIMIT ",
                    ),
                ] {
                    let mut text = of_jobs(before, &keys, after);
                    text.push_bind(left);
                    text.push(")");
                    let gone = text.build().execute(&mut *c).await?.rows_affected();
                    left -= i64::try_from(gone).unwrap_or(left);
                    if left <= 0 {
                        return Ok(Forgotten { jobs: 0, more: true });
                    }
                }
                for before in [
                    "DELETE FROM job_after WHERE job IN (",
                    "DELETE FROM job_after WHERE needs IN (",
                    "DELETE FROM stage WHERE job IN (",
                    "DELETE FROM job WHERE key IN (",
                ] {
                    of_jobs(before, &keys, ")").build().execute(&mut *c).await?;
                }
                Ok(Forgotten {
                    jobs: u32::try_from(keys.len()).unwrap_or(u32::MAX),
                    more: true,
                })
            }

            async fn forget_outputs(c: &mut Connection) -> Result<Forgotten> {
                let sets: Vec<i64> = sqlx::query_scalar(concat!(
                    "SELECT key FROM result_set WHERE NOT EXISTS \
                     (SELECT 1 FROM stage WHERE stage.result_set = result_set.key) LIMIT $1",
                    $lock
                ))
                .bind(crate::listing::JOBS)
                .fetch_all(&mut *c)
                .await?;
                if sets.is_empty() {
                    return Ok(Forgotten::default());
                }
                // A job that was being recorded during the search may use one of the sets. Now that
                // the rows are locked, no other job can.
                let used: Vec<i64> = of_jobs("SELECT DISTINCT result_set FROM stage WHERE result_set IN (", &sets, ")")
                    .build_query_scalar()
                    .fetch_all(&mut *c)
                    .await?;
                let sets: Vec<i64> = sets.into_iter().filter(|set| !used.contains(set)).collect();
                if sets.is_empty() {
                    return Ok(Forgotten { jobs: 0, more: true });
                }
                let mut text = of_jobs(
                    "DELETE FROM output WHERE (result_set, task) IN (SELECT result_set, task FROM output \
                     WHERE result_set IN (",
                    &sets,
                    ") LIMIT ",
                );
                text.push_bind(crate::listing::ROWS);
                text.push(")");
                let gone = text.build().execute(&mut *c).await?.rows_affected();
                if gone < crate::listing::ROWS as u64 {
                    of_jobs("DELETE FROM result_set WHERE key IN (", &sets, ")")
                        .build()
                        .execute(c)
                        .await?;
                }
                Ok(Forgotten { jobs: 0, more: true })
            }
        }
    };
}

pub(crate) use listing_queries;
