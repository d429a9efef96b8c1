//! Code shared by SQLite and Postgres: the codes in columns, and queries with SQL text that both
//! understand. The queries are a macro over the database's types, because sqlx has no common type
//! for a connection.

mod codes;

pub(crate) use codes::*;

/// The text of a history query, for a job condition and an order.
macro_rules! history {
    ($job:literal, $order:literal) => {
        concat!(
            "SELECT event.*, job.id AS job_id FROM event \
             JOIN job ON job.key = event.job WHERE sequence > $1 AND ",
            $job,
            " AND (CAST($2 AS BIGINT) IS NULL OR (lo <= $2 AND $2 < hi)) \
             AND (CAST($5 AS BIGINT) IS NULL OR event.stage = $5) \
             AND (CAST($6 AS BIGINT) IS NULL OR event.kind <> $6) AND ",
            crate::seen::seen!("$7", "$8", "$9"),
            " ",
            $order,
            " LIMIT $3"
        )
    };
}
pub(crate) use history;

/// Defines the queries for one database: `queries!(SqliteConnection, SqliteRow)` generates a module
/// `query`.
macro_rules! queries {
    ($connection:ty, $row:ty) => {
        pub(crate) mod query {
            use picofarm_proto::{ids::{Epoch, Incarnation, JobId, RangeId, StageRef, WorkerId}, messages::{Event, EventKind}};
            use sqlx::Row;

            use picofarm_catalog::{EventQuery, Exception, LeaseState, Mark, Output, Range, RangeState, ResultSet, Run, TaskRecord, Worker, Gone, Recorded};
            use crate::{sql::{self, bad, history, int}};

            type Connection = $connection;
            type DbRow = $row;
            type Result<T> = std::result::Result<T, sqlx::Error>;

            pub(crate) fn uint(row: &DbRow, column: &'static str) -> Result<u64> {
                u64::try_from(row.try_get::<i64, _>(column)?).map_err(|e| bad(column, e))
            }

            pub(crate) fn small(row: &DbRow, column: &'static str) -> Result<u32> {
                u32::try_from(row.try_get::<i64, _>(column)?).map_err(|e| bad(column, e))
            }

            pub(crate) fn stage_of(row: &DbRow) -> Result<StageRef> {
                Ok(StageRef {
                    job: JobId::from_uuid(row.try_get("job_id")?),
                    stage: small(row, "ordinal")?,
                })
            }

            /// Parses a row of `task_range` with its stage's `job_id` and `ordinal`.
            pub(crate) fn range(row: &DbRow) -> Result<Range> {
                let state = match row.try_get::<i64, _>("state")? {
                    sql::PENDING => RangeState::Pending {
                        not_before_ms: row.try_get("not_before_ms")?,
                    },
                    sql::LEASED => RangeState::Leased(LeaseState {
                        worker: WorkerId::from_uuid(row.try_get("worker")?),
                        incarnation: Incarnation::from_uuid(row.try_get("incarnation")?),
                        until_ms: row.try_get("lease_until_ms")?,
                        marks: marks(row)?,
                    }),
                    sql::DONE => RangeState::Done { reused: false },
                    sql::DONE_REUSED => RangeState::Done { reused: true },
                    sql::DEAD => RangeState::Dead,
                    other => return Err(bad("state", other)),
                };
                Ok(Range {
                    id: RangeId::from_uuid(row.try_get("id")?),
                    stage: stage_of(row)?,
                    lo: uint(row, "lo")?,
                    hi: uint(row, "hi")?,
                    epoch: Epoch(uint(row, "epoch")?),
                    crashes: small(row, "crashes")?,
                    state,
                })
            }

            pub(crate) fn marks(row: &DbRow) -> Result<Vec<Mark>> {
                let bytes: Vec<u8> = row.try_get("marks")?;
                bytes.into_iter().map(sql::mark).collect()
            }

            pub(crate) async fn workers(c: &mut Connection) -> Result<Vec<Worker>> {
                let rows = sqlx::query("SELECT * FROM worker ORDER BY id")
                    .fetch_all(c)
                    .await?;
                rows.iter()
                    .map(|row| {
                        Ok(Worker {
                            id: WorkerId::from_uuid(row.try_get("id")?),
                            incarnation: Incarnation::from_uuid(row.try_get("incarnation")?),
                            name: row.try_get("name")?,
                            last_seen_ms: row.try_get("last_seen_ms")?,
                        })
                    })
                    .collect()
            }

            /// Returns the failures of the tasks in these ranges.
            pub(crate) async fn exceptions(c: &mut Connection, ranges: &[Range]) -> Result<Vec<Exception>> {
                let mut found = Vec::new();
                for range in ranges {
                    let rows = sqlx::query(
                        "SELECT exception.*, job.id AS job_id, stage.ordinal FROM exception \
                         JOIN stage ON stage.key = exception.stage JOIN job ON job.key = stage.job \
                         WHERE job.id = $1 AND stage.ordinal = $2 AND task >= $3 AND task < $4 ORDER BY task",
                    )
                    .bind(range.stage.job.uuid())
                    .bind(i64::from(range.stage.stage))
                    .bind(int(range.lo))
                    .bind(int(range.hi))
                    .fetch_all(&mut *c)
                    .await?;
                    for row in &rows {
                        found.push(exception(row, stage_of(row)?)?);
                    }
                }
                Ok(found)
            }

            /// Returns runs of tasks in `lo..hi` with existing, checked outputs. The query uses
            /// gaps and islands: within a run, the task minus its rank is constant. An output that
            /// a worker reported but nobody has checked is not reused by another job.
            pub(crate) async fn runs_of_stage(c: &mut Connection, stage: StageRef, lo: u64, hi: u64) -> Result<Vec<Run>> {
                let rows = sqlx::query(
                    "SELECT min(task) AS lo, max(task) + 1 AS hi FROM ( \
                       SELECT task, task - row_number() OVER (ORDER BY task) AS island FROM output WHERE result_set = \
                       (SELECT result_set FROM stage JOIN job ON job.key = stage.job WHERE job.id = $1 AND ordinal = $2) \
                       AND task >= $3 AND task < $4 AND checked) AS islands GROUP BY island ORDER BY lo",
                )
                .bind(stage.job.uuid())
                .bind(i64::from(stage.stage))
                .bind(int(lo))
                .bind(int(hi))
                .fetch_all(c)
                .await?;
                rows.iter().map(run).collect()
            }

            pub(crate) async fn output_runs(c: &mut Connection, set: &ResultSet, count: u64) -> Result<Vec<Run>> {
                let rows = sqlx::query(
                    "SELECT min(task) AS lo, max(task) + 1 AS hi FROM ( \
                       SELECT task, task - row_number() OVER (ORDER BY task) AS island FROM output WHERE result_set = \
                       (SELECT key FROM result_set WHERE store = $1 AND dataset = $2 AND stage_key = $3) \
                       AND task < $4) AS islands GROUP BY island ORDER BY lo",
                )
                .bind(&set.store)
                .bind(&set.dataset)
                .bind(&set.stage_key.0[..])
                .bind(int(count))
                .fetch_all(c)
                .await?;
                rows.iter().map(run).collect()
            }

            pub(crate) async fn recorded(c: &mut Connection, set: &ResultSet, count: u64) -> Result<Vec<Recorded>> {
                let rows = sqlx::query(
                    "SELECT task, manifest, checked FROM output WHERE result_set = \
                     (SELECT key FROM result_set WHERE store = $1 AND dataset = $2 AND stage_key = $3) \
                     AND task < $4 ORDER BY task",
                )
                .bind(&set.store)
                .bind(&set.dataset)
                .bind(&set.stage_key.0[..])
                .bind(int(count))
                .fetch_all(c)
                .await?;
                rows.iter()
                    .map(|row| {
                        let manifest: Vec<u8> = row.try_get("manifest")?;
                        Ok(Recorded {
                            task: uint(row, "task")?,
                            manifest: manifest
                                .try_into()
                                .map_err(|_| bad("manifest", "not 32 bytes long"))?,
                            checked: row.try_get("checked")?,
                        })
                    })
                    .collect()
            }

            /// Returns how many outputs of these tasks are recorded as checked.
            pub(crate) async fn checked(c: &mut Connection, set: &ResultSet, run: Run) -> Result<u64> {
                let row = sqlx::query(
                    "SELECT count(*) AS outputs FROM output WHERE result_set = \
                     (SELECT key FROM result_set WHERE store = $1 AND dataset = $2 AND stage_key = $3) \
                     AND task >= $4 AND task < $5 AND checked",
                )
                .bind(&set.store)
                .bind(&set.dataset)
                .bind(&set.stage_key.0[..])
                .bind(int(run.lo))
                .bind(int(run.hi))
                .fetch_one(c)
                .await?;
                uint(&row, "outputs")
            }

            /// Marks an output as found in the store.
            pub(crate) async fn mark_checked(c: &mut Connection, set: &ResultSet, output: &Recorded) -> Result<()> {
                sqlx::query(
                    "UPDATE output SET checked = $6 WHERE result_set = \
                     (SELECT key FROM result_set WHERE store = $1 AND dataset = $2 AND stage_key = $3) \
                     AND task = $4 AND manifest = $5",
                )
                .bind(&set.store)
                .bind(&set.dataset)
                .bind(&set.stage_key.0[..])
                .bind(int(output.task))
                .bind(&output.manifest[..])
                .bind(true)
                .execute(c)
                .await?;
                Ok(())
            }

            /// Deletes the record of an output. Returns `false` if there is none with this
            /// manifest.
            pub(crate) async fn drop_output(c: &mut Connection, gone: &Gone) -> Result<bool> {
                let dropped = sqlx::query(
                    "DELETE FROM output WHERE result_set = \
                     (SELECT key FROM result_set WHERE store = $1 AND dataset = $2 AND stage_key = $3) \
                     AND task = $4 AND manifest = $5",
                )
                .bind(&gone.set.store)
                .bind(&gone.set.dataset)
                .bind(&gone.set.stage_key.0[..])
                .bind(int(gone.task))
                .bind(&gone.manifest[..])
                .execute(c)
                .await?;
                Ok(dropped.rows_affected() > 0)
            }

            fn run(row: &DbRow) -> Result<Run> {
                Ok(Run {
                    lo: uint(row, "lo")?,
                    hi: uint(row, "hi")?,
                })
            }

            pub(crate) fn exception(row: &DbRow, stage: StageRef) -> Result<Exception> {
                Ok(Exception {
                    stage,
                    task: uint(row, "task")?,
                    failures: small(row, "failures")?,
                    crashes: small(row, "crashes")?,
                    interruptions: small(row, "interruptions")?,
                    longest_ms: uint(row, "longest_ms")?,
                    dead: row.try_get("dead")?,
                    last_error: row.try_get("last_error")?,
                })
            }

            pub(crate) async fn task(c: &mut Connection, stage: StageRef, task: u64) -> Result<TaskRecord> {
                let key: Option<(i64, i64)> = sqlx::query_as(
                    "SELECT stage.key, stage.result_set FROM stage JOIN job ON job.key = stage.job \
                     WHERE job.id = $1 AND ordinal = $2",
                )
                .bind(stage.job.uuid())
                .bind(i64::from(stage.stage))
                .fetch_optional(&mut *c)
                .await?;
                let Some((key, set)) = key else {
                    return Ok(TaskRecord::default());
                };
                let rows = sqlx::query(
                    "SELECT task_range.*, job.id AS job_id, stage.ordinal FROM task_range \
                     JOIN stage ON stage.key = task_range.stage JOIN job ON job.key = stage.job \
                     WHERE task_range.stage = $1 AND lo <= $2 AND $2 < hi",
                )
                .bind(key)
                .bind(int(task))
                .fetch_all(&mut *c)
                .await?;
                let ranges = rows.iter().map(range).collect::<Result<Vec<_>>>()?;
                let row = sqlx::query("SELECT * FROM exception WHERE stage = $1 AND task = $2")
                    .bind(key)
                    .bind(int(task))
                    .fetch_optional(&mut *c)
                    .await?;
                let failures = row.as_ref().map(|row| exception(row, stage)).transpose()?;
                let row = sqlx::query("SELECT * FROM output WHERE result_set = $1 AND task = $2")
                    .bind(set)
                    .bind(int(task))
                    .fetch_optional(c)
                    .await?;
                let output = row.map(|row| -> Result<Output> {
                    let manifest: Vec<u8> = row.try_get("manifest")?;
                    Ok(Output {
                        stage,
                        task,
                        manifest: manifest
                            .try_into()
                            .map_err(|_| bad("manifest", "not 32 bytes"))?,
                        bytes: uint(&row, "bytes")?,
                        seconds: row.try_get("seconds")?,
                        epoch: Epoch(uint(&row, "epoch")?),
                        adopted: row.try_get("adopted")?,
                        checked: row.try_get("checked")?,
                    })
                });
                Ok(TaskRecord {
                    // A task that left a lease is in two ranges: its own, and the lease with the
                    // mark `Left`.
                    range: ranges.into_iter().find(|range| match &range.state {
                        RangeState::Leased(lease) => {
                            lease.marks.get((task - range.lo) as usize) != Some(&Mark::Left)
                        }
                        _ => true,
                    }),
                    exception: failures,
                    output: output.transpose()?,
                })
            }

            pub(crate) async fn events(c: &mut Connection, query: &EventQuery) -> Result<Vec<Event>> {
                let job = match query.job {
                    None => None,
                    Some(id) => {
                        let key = sqlx::query_scalar::<_, i64>("SELECT key FROM job WHERE id = $1")
                            .bind(id.uuid())
                            .fetch_optional(&mut *c)
                            .await?;
                        let Some(key) = key else {
                            return Ok(Vec::new());
                        };
                        Some(key)
                    }
                };
                // There are four query texts, so that each can use a matching index.
                let text = match (job, query.newest) {
                    (Some(_), false) => history!("event.job = $4", "ORDER BY sequence"),
                    (Some(_), true) => history!("event.job = $4", "ORDER BY sequence DESC"),
                    (None, false) => history!("CAST($4 AS BIGINT) IS NULL", "ORDER BY sequence"),
                    (None, true) => history!("CAST($4 AS BIGINT) IS NULL", "ORDER BY sequence DESC"),
                };
                let [all, user, projects] = crate::seen::columns(&query.sight);
                let mut rows = sqlx::query(text)
                    .bind(i64::try_from(query.after).unwrap_or(i64::MAX))
                    .bind(query.task.map(|t| i64::try_from(t).unwrap_or(i64::MAX)))
                    .bind(i64::from(query.limit))
                    .bind(job)
                    .bind(query.stage.map(i64::from))
                    .bind((!query.logs).then(|| sql::event_kind_code(EventKind::Log)))
                    .bind(all)
                    .bind(user)
                    .bind(projects)
                    .fetch_all(c)
                    .await?;
                if query.newest {
                    rows.reverse();
                }
                rows.iter()
                    .map(|row| {
                        let task = |column| {
                            let task: Option<i64> = row.try_get(column)?;
                            task.map(|t| u64::try_from(t).map_err(|e| bad(column, e))).transpose()
                        };
                        let (lo, hi) = (task("lo")?, task("hi")?);
                        Ok(Event {
                            sequence: uint(row, "sequence")?,
                            at_ms: row.try_get("at_ms")?,
                            job: JobId::from_uuid(row.try_get("job_id")?),
                            stage: row
                                .try_get::<Option<i64>, _>("stage")?
                                .map(|n| u32::try_from(n).map_err(|e| bad("stage", e)))
                                .transpose()?,
                            kind: sql::event_kind(row.try_get("kind")?)?,
                            task: lo.filter(|lo| hi == Some(lo + 1)),
                            lo,
                            hi,
                            worker: row.try_get("worker")?,
                            message: row.try_get("message")?,
                            seconds: row.try_get("seconds")?,
                        })
                    })
                    .collect()
            }
        }
    };
}

pub(crate) use queries;
