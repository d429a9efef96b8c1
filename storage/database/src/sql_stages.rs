//! Queries about the stages of a job, for one database:
//! `stage_queries!(SqliteConnection, SqliteRow)` generates a module `stage_query`, which uses the
//! module `query` (see [`crate::sql`]).

macro_rules! stage_queries {
    ($connection:ty, $row:ty) => {
        pub(crate) mod stage_query {
            use std::collections::BTreeMap;

            use picofarm_proto::{ids::{JobId, StageRef}, messages::{EventKind, StageState, TaskCounts}};
            use sqlx::Row;

            use super::query::{marks, uint};
            use picofarm_catalog::{JobEnd, Mark, NewEvent, Settled, StageCounts};
            use crate::{graph::{self, Node}, sql::{self, bad, int}};

            type Connection = $connection;
            type DbRow = $row;
            type Result<T> = std::result::Result<T, sqlx::Error>;

            /// Returns the stages of a job that has ended, with their final counts.
            pub(crate) async fn final_stages(c: &mut Connection, key: i64) -> Result<Vec<StageCounts>> {
                let rows = sqlx::query("SELECT * FROM stage WHERE job = $1 ORDER BY ordinal")
                    .bind(key)
                    .fetch_all(c)
                    .await?;
                let stage = |row: &DbRow| {
                    let (total, done, dead) = (uint(row, "tasks")?, uint(row, "done")?, uint(row, "dead")?);
                    let counts = TaskCounts {
                        total,
                        done,
                        reused: uint(row, "reused")?,
                        leased: 0,
                        pending: total.saturating_sub(done + dead),
                        dead,
                    };
                    Ok(StageCounts {
                        state: sql::stage_state(row.try_get("state")?)?,
                        counts,
                    })
                };
                rows.iter().map(stage).collect()
            }

            /// Returns the stages of a job in order, with their tasks counted.
            pub(crate) async fn nodes(c: &mut Connection, key: i64) -> Result<Vec<(StageCounts, Node)>> {
                let mut counts: BTreeMap<i64, TaskCounts> = BTreeMap::new();
                let rows = sqlx::query(
                    "SELECT task_range.stage, task_range.state, CAST(sum(hi - lo) AS BIGINT) AS tasks FROM task_range \
                     JOIN stage ON stage.key = task_range.stage \
                     WHERE stage.job = $1 AND task_range.state <> 1 GROUP BY task_range.stage, task_range.state",
                )
                .bind(key)
                .fetch_all(&mut *c)
                .await?;
                for row in &rows {
                    let n = uint(row, "tasks")?;
                    let counts = counts.entry(row.try_get("stage")?).or_default();
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
                let rows = sqlx::query(
                    "SELECT task_range.stage, marks FROM task_range JOIN stage ON stage.key = task_range.stage \
                     WHERE stage.job = $1 AND task_range.state = 1",
                )
                .bind(key)
                .fetch_all(&mut *c)
                .await?;
                for row in &rows {
                    let counts = counts.entry(row.try_get("stage")?).or_default();
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
                let rows = sqlx::query("SELECT * FROM stage WHERE job = $1 ORDER BY ordinal")
                    .bind(key)
                    .fetch_all(c)
                    .await?;
                rows.iter()
                    .map(|row| {
                        let mut counts = counts
                            .get(&row.try_get::<i64, _>("key")?)
                            .copied()
                            .unwrap_or_default();
                        counts.total = counts.done + counts.leased + counts.pending + counts.dead;
                        let state = sql::stage_state(row.try_get("state")?)?;
                        let node = Node {
                            needs: sql::needs(row.try_get("needs")?)?,
                            tolerate_dead: row.try_get("tolerate_dead")?,
                            counts,
                        };
                        Ok((StageCounts { state, counts }, node))
                    })
                    .collect()
            }

            /// Opens the stages of an active job that may begin, and ends the job if it is over.
            /// Returns these changes with the events for the history. The caller must lock the
            /// job's row, so that if two instances finish their last tasks at the same time, the
            /// second sees the changes of the first.
            pub(crate) async fn settle(
                c: &mut Connection,
                key: i64,
                id: JobId,
                at_ms: i64,
            ) -> Result<(Settled, Vec<NewEvent>)> {
                let mut settled = Settled::default();
                let mut events = Vec::new();
                let stages = nodes(c, key).await?;
                let (before, nodes): (Vec<_>, Vec<_>) = stages.into_iter().unzip();
                let (states, end) = graph::states(&nodes);
                for (ordinal, (before, state)) in before.iter().zip(&states).enumerate() {
                    if before.state == *state {
                        continue;
                    }
                    sqlx::query("UPDATE stage SET state = $1 WHERE job = $2 AND ordinal = $3")
                        .bind(sql::stage_state_code(*state))
                        .bind(key)
                        .bind(int(ordinal as u64))
                        .execute(&mut *c)
                        .await?;
                    if *state == StageState::Open {
                        let stage = ordinal as u32;
                        settled.opened.push(StageRef { job: id, stage });
                        if !nodes[ordinal].needs.is_empty() {
                            let event = NewEvent::new(id, at_ms, EventKind::Opened, String::new());
                            events.push(NewEvent { stage: Some(stage), ..event });
                        }
                    }
                }
                let Some(state) = end else {
                    return Ok((settled, events));
                };
                let mut counts = TaskCounts::default();
                for (ordinal, node) in nodes.iter().enumerate() {
                    counts += node.counts;
                    sqlx::query("UPDATE stage SET done = $1, reused = $2, dead = $3 WHERE job = $4 AND ordinal = $5")
                        .bind(int(node.counts.done))
                        .bind(int(node.counts.reused))
                        .bind(int(node.counts.dead))
                        .bind(key)
                        .bind(int(ordinal as u64))
                        .execute(&mut *c)
                        .await?;
                }
                sqlx::query(
                    "UPDATE job SET state = $2, ended_ms = $3, tasks = $4, done = $5, reused = $6, dead = $7, \
                     (timed, seconds) = (SELECT count(*), coalesce(sum(seconds), 0.0) FROM output \
                       WHERE NOT adopted AND result_set IN (SELECT result_set FROM stage WHERE job = $1)) WHERE key = $1",
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
                events.push(NewEvent::ended(id, at_ms, &counts));
                settled.ends.push(JobEnd {
                    job: id,
                    state,
                    at_ms,
                });
                Ok((settled, events))
            }

            /// Returns whether a stage has pending or leased ranges.
            pub(crate) async fn is_open(c: &mut Connection, stage: i64) -> Result<bool> {
                let open = sqlx::query("SELECT 1 FROM task_range WHERE stage = $1 AND state IN (0, 1) LIMIT 1")
                    .bind(stage)
                    .fetch_optional(c)
                    .await?;
                Ok(open.is_some())
            }
        }
    };
}

pub(crate) use stage_queries;
