//! What is written of ranges, outputs and history, in one transaction each.

use std::collections::{BTreeMap, HashMap};

use picofarm_proto::ids::{InstanceId, JobId, RangeId, StageRef};
use sqlx::{Connection, QueryBuilder, Row, Sqlite, SqliteConnection, sqlite::SqliteConnectOptions};
use uuid::Uuid;

use super::{files::Files, jobs, query};
use crate::sql::{self, StateColumns, int};
use picofarm_catalog::{Changes, Claim, NewEvent, Output, Owned, Range, Settled, Want};

/// Rows in one statement; SQLite takes 32,766 parameters and no row here has more than 13.
const ROWS: usize = 1000;
/// Pending ranges looked at for one wish.
const LOOK_AT: i64 = 256;

pub(super) enum WriteError {
    Conflict(String),
    /// The files are not the database's any more.
    Lost(String),
    Sql(sqlx::Error),
}

impl From<sqlx::Error> for WriteError {
    fn from(e: sqlx::Error) -> Self {
        Self::Sql(e)
    }
}

pub(super) type Result<T> = std::result::Result<T, WriteError>;

/// The connection that writes.
pub(super) struct Writer {
    options: SqliteConnectOptions,
    /// `None` after a transaction that did not end in order.
    connection: Option<SqliteConnection>,
    files: Files,
    keys: Keys,
}

impl Writer {
    pub(super) fn new(
        connection: SqliteConnection,
        options: SqliteConnectOptions,
        files: Files,
    ) -> Self {
        Self {
            options,
            connection: Some(connection),
            files,
            keys: Keys::default(),
        }
    }

    /// Checks that what is open is what lies at the path.
    pub(super) fn check(&self) -> Result<()> {
        self.files.check().map_err(WriteError::Lost)
    }

    /// Runs `work` in a transaction, which is kept if `keep` and undone else.
    ///
    /// A connection whose transaction does not end in order (no room for the commit, and none for the rollback either) counts
    /// it as open for ever: such a one is given up, and the next transaction has a new one.
    pub(super) async fn transaction<T>(
        &mut self,
        keep: bool,
        work: impl AsyncFnOnce(&mut SqliteConnection, &mut Keys) -> Result<T>,
    ) -> Result<T> {
        self.check()?;
        // Whoever stops waiting half-way leaves none behind.
        let mut connection = match self.connection.take() {
            Some(connection) => connection,
            None => SqliteConnection::connect_with(&self.options).await?,
        };
        let (done, ended) = run(&mut connection, &mut self.keys, keep, work).await;
        if done.is_err() {
            // Keys of rows that are no more.
            self.keys = Keys::default();
        }
        match &ended {
            Ok(()) => self.connection = Some(connection),
            Err(error) => {
                tracing::warn!(%error, "the catalog's connection is given up after a failed transaction");
                let _ = connection.close_hard().await;
            }
        }
        let done = done?;
        ended?;
        // What was written into a file that is nowhere any more is not written.
        self.check()?;
        Ok(done)
    }

    pub(super) async fn close(self) {
        if let Some(connection) = self.connection
            && let Err(error) = connection.close().await
        {
            tracing::warn!(%error, "closing the catalog");
        }
    }
}

/// What came of the work, and of the end of its transaction.
async fn run<T>(
    connection: &mut SqliteConnection,
    keys: &mut Keys,
    keep: bool,
    work: impl AsyncFnOnce(&mut SqliteConnection, &mut Keys) -> Result<T>,
) -> (Result<T>, std::result::Result<(), sqlx::Error>) {
    let mut tx = match connection.begin_with("BEGIN IMMEDIATE").await {
        Ok(tx) => tx,
        Err(error) => {
            let why = sqlx::Error::Protocol(error.to_string());
            return (Err(WriteError::Sql(error)), Err(why));
        }
    };
    let done = work(&mut tx, keys).await;
    let ended = match keep && done.is_ok() {
        true => tx.commit().await,
        false => tx.rollback().await,
    };
    (done, ended)
}

/// Integer keys of stages, remembered: they never change.
#[derive(Default)]
pub(super) struct Keys(HashMap<StageRef, StageKeys>);

#[derive(Clone, Copy)]
pub(super) struct StageKeys {
    pub stage: i64,
    pub job: i64,
    pub result_set: i64,
}

impl Keys {
    pub(super) async fn of(
        &mut self,
        c: &mut SqliteConnection,
        stage: StageRef,
    ) -> Result<StageKeys> {
        if let Some(keys) = self.0.get(&stage) {
            return Ok(*keys);
        }
        let found: Option<(i64, i64, i64)> = sqlx::query_as(
            "SELECT stage.key, stage.job, stage.result_set FROM stage JOIN job ON job.key = stage.job \
             WHERE job.id = ? AND ordinal = ?",
        )
        .bind(stage.job.uuid())
        .bind(i64::from(stage.stage))
        .fetch_optional(c)
        .await?;
        let (key, job, result_set) =
            found.ok_or_else(|| WriteError::Conflict(format!("there is no stage {stage}")))?;
        let keys = StageKeys {
            stage: key,
            job,
            result_set,
        };
        self.0.insert(stage, keys);
        Ok(keys)
    }

    pub(super) async fn job(&mut self, c: &mut SqliteConnection, job: JobId) -> Result<i64> {
        Ok(self.of(c, StageRef { job, stage: 0 }).await?.job)
    }
}

/// Bytes that a life writes when it begins, to see that a batch finds room.
const ROOM: i64 = 256 << 10;

/// Notes whose life it is now.
pub(super) async fn found(
    c: &mut SqliteConnection,
    instance: InstanceId,
) -> std::result::Result<(), sqlx::Error> {
    sqlx::query("INSERT OR REPLACE INTO life (key, instance, room) VALUES (1, ?, zeroblob(?))")
        .bind(instance.uuid())
        .bind(ROOM)
        .execute(c)
        .await?;
    Ok(())
}

/// The ranges in this instance's hands.
pub(super) async fn owned(
    c: &mut SqliteConnection,
) -> std::result::Result<Vec<Range>, sqlx::Error> {
    let rows = sqlx::query(
        "SELECT task_range.*, job.id AS job_id, ordinal FROM task_range JOIN stage ON stage.key = task_range.stage \
         JOIN job ON job.key = stage.job WHERE owner IS NOT NULL ORDER BY task_range.stage, lo",
    )
    .fetch_all(c)
    .await?;
    rows.iter().map(query::range).collect()
}

pub(super) async fn claim(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    wants: &[Want],
) -> Result<Vec<Claim>> {
    let mut claims = Vec::with_capacity(wants.len());
    for want in wants {
        let key = keys.of(c, want.stage).await?.stage;
        let rows = sqlx::query(
            "SELECT task_range.*, job.id AS job_id, ordinal FROM task_range JOIN stage ON stage.key = task_range.stage \
             JOIN job ON job.key = stage.job WHERE stage = ? AND task_range.state = 0 AND owner IS NULL \
             AND not_before_ms <= ? AND stage.state = 1 AND job.state = 0 AND NOT job.paused \
             ORDER BY not_before_ms, lo LIMIT ?",
        )
        .bind(key)
        .bind(want.now_ms)
        .bind(LOOK_AT)
        .fetch_all(&mut *c)
        .await?;
        let mut ranges = Vec::new();
        let mut missing = want.tasks;
        for row in &rows {
            if missing == 0 {
                break;
            }
            let mut range = query::range(row)?;
            if range.len() <= missing {
                sqlx::query("UPDATE task_range SET owner = 1 WHERE id = ?")
                    .bind(range.id.uuid())
                    .execute(&mut *c)
                    .await?;
            } else {
                let cut = range.lo + missing;
                sqlx::query("UPDATE task_range SET lo = ? WHERE id = ?")
                    .bind(int(cut))
                    .bind(range.id.uuid())
                    .execute(&mut *c)
                    .await?;
                range.id = RangeId::from_uuid(Uuid::now_v7());
                range.hi = cut;
                insert_ranges(c, &[(key, &range)], true).await?;
            }
            missing -= range.len();
            ranges.push(range);
        }
        let mut existing = Vec::new();
        for range in ranges.iter().filter(|_| !want.force) {
            existing.extend(query::runs_of_stage(c, want.stage, range.lo, range.hi).await?);
        }
        existing.sort_unstable_by_key(|run| run.lo);
        let left: Option<i64> = sqlx::query_scalar(
            "SELECT sum(hi - lo) FROM task_range JOIN stage ON stage.key = task_range.stage \
             WHERE stage = ? AND task_range.state = 0 AND owner IS NULL AND stage.state = 1",
        )
        .bind(key)
        .fetch_one(&mut *c)
        .await?;
        claims.push(Claim {
            owned: Owned {
                exceptions: query::exceptions(c, &ranges).await?,
                ranges,
            },
            existing,
            left: left.unwrap_or(0).unsigned_abs(),
        });
    }
    Ok(claims)
}

pub(super) async fn changes(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    changes: &Changes,
) -> Result<Settled> {
    replace_known(c, changes).await?;
    let mut rows = Vec::with_capacity(changes.ranges.len());
    for range in changes.ranges.values() {
        rows.push((keys.of(c, range.stage).await?.stage, range));
    }
    insert_ranges(c, &rows, true).await?;
    for range in changes.free.values() {
        let key = keys.of(c, range.stage).await?.stage;
        give(c, key, range).await?;
    }
    write_rows(c, keys, changes).await?;
    let mut settled = Settled::default();
    for (stage, at_ms) in &changes.perhaps_over {
        settled.join(jobs::stage_over(c, keys, *stage, *at_ms).await?);
    }
    Ok(settled)
}

/// Writes the rows of a change set that hold what others sent.
pub(super) async fn write_rows(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    changes: &Changes,
) -> Result<()> {
    insert_outputs(c, keys, &changes.outputs).await?;
    for exception in changes.exceptions.values() {
        let stage = keys.of(c, exception.stage).await?.stage;
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
        .bind(worker.id.uuid())
        .bind(worker.incarnation.uuid())
        .bind(&worker.name)
        .bind(worker.last_seen_ms)
        .execute(&mut *c)
        .await?;
    }
    insert_events(c, keys, &changes.events).await
}

/// Removes the former state of every range that changes, having checked that it is there.
async fn replace_known(c: &mut SqliteConnection, changes: &Changes) -> Result<()> {
    let known: Vec<RangeId> = changes.known().collect();
    for chunk in known.chunks(ROWS) {
        let mut delete = QueryBuilder::<Sqlite>::new(
            "DELETE FROM task_range WHERE owner IS NOT NULL AND id IN (",
        );
        let mut ids = delete.separated(", ");
        for id in chunk {
            ids.push_bind(id.uuid());
        }
        delete.push(")");
        let found = delete.build().execute(&mut *c).await?.rows_affected();
        if found != chunk.len() as u64 {
            return Err(WriteError::Conflict(format!(
                "{found} of {} ranges are as this coordinator knows them",
                chunk.len()
            )));
        }
    }
    Ok(())
}

pub(super) async fn insert_ranges(
    c: &mut SqliteConnection,
    rows: &[(i64, &Range)],
    mine: bool,
) -> Result<()> {
    for chunk in rows.chunks(ROWS) {
        let mut insert = QueryBuilder::<Sqlite>::new(
            "INSERT INTO task_range (id, stage, lo, hi, epoch, crashes, state, owner, not_before_ms, worker, \
             incarnation, lease_until_ms, marks) ",
        );
        insert.push_values(chunk, |mut row, (key, range)| {
            let columns = StateColumns::from(&range.state);
            row.push_bind(range.id.uuid())
                .push_bind(*key)
                .push_bind(int(range.lo))
                .push_bind(int(range.hi))
                .push_bind(int(range.epoch.0))
                .push_bind(i64::from(range.crashes))
                .push_bind(columns.state)
                .push_bind(mine.then_some(1i64))
                .push_bind(columns.not_before_ms)
                .push_bind(columns.worker)
                .push_bind(columns.incarnation)
                .push_bind(columns.lease_until_ms)
                .push_bind(columns.marks);
        });
        insert.build().execute(&mut *c).await?;
    }
    Ok(())
}

/// Writes a range of nobody's, merged with its neighbours in the same state.
pub(super) async fn give(c: &mut SqliteConnection, key: i64, range: &Range) -> Result<()> {
    let mut range = range.clone();
    let columns = StateColumns::from(&range.state);
    if range.merges() {
        let rows = sqlx::query(
            "DELETE FROM task_range WHERE stage = ?1 AND state = ?2 AND (hi = ?3 OR lo = ?4) AND owner IS NULL \
             AND crashes = 0 AND coalesce(not_before_ms, 0) = 0 RETURNING lo, hi, epoch",
        )
        .bind(key)
        .bind(columns.state)
        .bind(int(range.lo))
        .bind(int(range.hi))
        .fetch_all(&mut *c)
        .await?;
        for row in rows {
            let number = |column| row.try_get::<i64, _>(column).map(i64::unsigned_abs);
            range.lo = range.lo.min(number("lo")?);
            range.hi = range.hi.max(number("hi")?);
            range.epoch.0 = range.epoch.0.max(number("epoch")?);
        }
    }
    insert_ranges(c, &[(key, &range)], false).await
}

async fn insert_outputs(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    outputs: &[Output],
) -> Result<()> {
    sql::writable(outputs)?;
    for chunk in outputs.chunks(ROWS) {
        let mut sets = Vec::with_capacity(chunk.len());
        for output in chunk {
            sets.push(keys.of(c, output.stage).await?.result_set);
        }
        let mut insert = QueryBuilder::<Sqlite>::new(
            "INSERT INTO output (result_set, task, manifest, bytes, seconds, epoch, adopted) ",
        );
        insert.push_values(chunk.iter().zip(sets), |mut row, (output, set)| {
            row.push_bind(set)
                .push_bind(int(output.task))
                .push_bind(output.manifest.to_vec())
                .push_bind(int(output.bytes))
                .push_bind(output.seconds)
                .push_bind(int(output.epoch.0))
                .push_bind(output.adopted);
        });
        insert.push(" ON CONFLICT DO NOTHING");
        let written = insert.build().execute(&mut *c).await?.rows_affected();
        if written == chunk.len() as u64 {
            continue;
        }
        let tasks: Vec<_> = chunk.iter().map(|o| (o.stage, o.task)).collect();
        let there = manifests(c, &tasks).await?;
        sql::equal_manifests(chunk, &there).map_err(WriteError::Conflict)?;
    }
    Ok(())
}

/// The manifests of many tasks, in one query for each stage.
pub(super) async fn manifests(
    c: &mut SqliteConnection,
    tasks: &[(StageRef, u64)],
) -> std::result::Result<Vec<Option<[u8; 32]>>, sqlx::Error> {
    let mut by_stage: BTreeMap<StageRef, Vec<u64>> = BTreeMap::new();
    for (stage, task) in tasks {
        by_stage.entry(*stage).or_default().push(*task);
    }
    let mut found = HashMap::new();
    for (stage, indices) in by_stage {
        let rows = sqlx::query(
            "SELECT task, manifest FROM output WHERE task IN (SELECT value FROM json_each(?3)) AND result_set = \
             (SELECT result_set FROM stage JOIN job ON job.key = stage.job WHERE job.id = ?1 AND ordinal = ?2)",
        )
        .bind(stage.job.uuid())
        .bind(i64::from(stage.stage))
        .bind(serde_json::to_string(&indices).expect("numbers are JSON"))
        .fetch_all(&mut *c)
        .await?;
        for row in rows {
            let manifest: Vec<u8> = row.try_get("manifest")?;
            let manifest: [u8; 32] = manifest
                .try_into()
                .map_err(|_| sql::bad("manifest", "not 32 bytes long"))?;
            let task = row.try_get::<i64, _>("task")?.unsigned_abs();
            found.insert((stage, task), manifest);
        }
    }
    Ok(tasks.iter().map(|t| found.get(t).copied()).collect())
}

pub(super) async fn insert_events(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    events: &[NewEvent],
) -> Result<()> {
    for chunk in events.chunks(ROWS) {
        let mut jobs = Vec::with_capacity(chunk.len());
        for event in chunk {
            jobs.push(keys.job(c, event.job).await?);
        }
        let mut insert = QueryBuilder::<Sqlite>::new(
            "INSERT INTO event (at_ms, job, kind, lo, hi, worker, seconds, message, stage) ",
        );
        insert.push_values(chunk.iter().zip(jobs), |mut row, (event, job)| {
            row.push_bind(event.at_ms)
                .push_bind(job)
                .push_bind(sql::event_kind_code(event.kind))
                .push_bind(event.tasks.map(|t| int(t.lo)))
                .push_bind(event.tasks.map(|t| int(t.hi)))
                .push_bind(event.worker.clone())
                .push_bind(event.seconds)
                .push_bind(event.message.clone())
                .push_bind(event.stage.map(i64::from));
        });
        insert.build().execute(&mut *c).await?;
    }
    Ok(())
}
