//! Rows of ranges, outputs and history.

use std::collections::{BTreeMap, HashMap};

use picofarm_catalog::{Changes, NewEvent, Output, Range};
use picofarm_proto::ids::StageRef;
use sqlx::{QueryBuilder, Row, Sqlite, SqliteConnection};

use super::writer::{Keys, Result, WriteError};
use crate::sql::{self, StateColumns, int};

/// Rows per statement. SQLite allows 32,766 parameters, and no row here has more than 13.
pub(super) const ROWS: usize = 1000;

/// Writes the rows of a change set that contain data from other programs.
pub(super) async fn write_rows(
    c: &mut SqliteConnection,
    keys: &mut Keys,
    changes: &Changes,
) -> Result<()> {
    insert_outputs(c, keys, &changes.outputs).await?;
    for exception in changes.exceptions.values() {
        let stage = keys.stage(c, exception.stage).await?.stage;
        sqlx::query(
            "INSERT INTO exception (stage, task, failures, crashes, interruptions, longest_ms, dead, last_error) \
             VALUES (?, ?, ?, ?, ?, ?, ?, ?) \
             ON CONFLICT DO UPDATE SET failures = excluded.failures, crashes = excluded.crashes, \
             interruptions = excluded.interruptions, longest_ms = excluded.longest_ms, dead = excluded.dead, last_error = excluded.last_error",
        )
        .bind(stage)
        .bind(int(exception.task))
        .bind(exception.failures)
        .bind(exception.crashes)
        .bind(exception.interruptions)
        .bind(int(exception.longest_ms))
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

/// Writes an unowned range, merged with its neighbours in the same state.
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
            sets.push(keys.stage(c, output.stage).await?.result_set);
        }
        let mut insert = QueryBuilder::<Sqlite>::new(
            "INSERT INTO output (result_set, task, manifest, bytes, seconds, epoch, adopted, checked) ",
        );
        insert.push_values(chunk.iter().zip(sets), |mut row, (output, set)| {
            row.push_bind(set)
                .push_bind(int(output.task))
                .push_bind(output.manifest.to_vec())
                .push_bind(int(output.bytes))
                .push_bind(output.seconds)
                .push_bind(int(output.epoch.0))
                .push_bind(output.adopted)
                .push_bind(output.checked);
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

/// Returns the manifests of many tasks, with one query per stage.
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
