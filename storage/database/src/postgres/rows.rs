//! Rows of ranges, outputs and history, written in bulk as arrays.

use std::collections::{BTreeMap, HashMap};

use picofarm_catalog::{Changes, Exception, NewEvent, Output, Range};
use picofarm_proto::ids::StageRef;
use sqlx::{PgConnection, Row};

use super::writer::{Result, Sql, WriteError, Writer};
use crate::sql::{self, StateColumns, int};

/// Writes the rows of a change set that contain data from other programs.
pub(super) async fn write_rows(writer: &mut Writer<'_>, changes: &Changes) -> Result<()> {
    insert_outputs(writer, &changes.outputs).await?;
    for exception in changes.exceptions.values() {
        put_exception(writer, exception).await?;
    }
    for worker in changes.workers.values() {
        sqlx::query(
            "INSERT INTO worker (id, incarnation, name, last_seen_ms) VALUES ($1, $2, $3, $4) \
             ON CONFLICT (id) DO UPDATE SET incarnation = excluded.incarnation, name = excluded.name, \
             last_seen_ms = excluded.last_seen_ms",
        )
        .bind(worker.id.uuid())
        .bind(worker.incarnation.uuid())
        .bind(&worker.name)
        .bind(worker.last_seen_ms)
        .execute(&mut *writer.c)
        .await?;
    }
    insert_events(writer, &changes.events).await
}

async fn put_exception(writer: &mut Writer<'_>, exception: &Exception) -> Result<()> {
    let stage = writer.keys(exception.stage).await?.stage;
    sqlx::query(
        "INSERT INTO exception (stage, task, failures, crashes, interruptions, longest_ms, dead, last_error) \
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8) \
         ON CONFLICT (stage, task) DO UPDATE SET failures = excluded.failures, crashes = excluded.crashes, \
         interruptions = excluded.interruptions, longest_ms = excluded.longest_ms, dead = excluded.dead, last_error = excluded.last_error",
    )
    .bind(stage)
    .bind(int(exception.task))
    .bind(i64::from(exception.failures))
    .bind(i64::from(exception.crashes))
    .bind(i64::from(exception.interruptions))
    .bind(int(exception.longest_ms))
    .bind(exception.dead)
    .bind(&exception.last_error)
    .execute(&mut *writer.c)
    .await?;
    Ok(())
}

pub(super) async fn insert_ranges(
    writer: &mut Writer<'_>,
    rows: &[(i64, &Range)],
    mine: bool,
) -> Result<()> {
    if rows.is_empty() {
        return Ok(());
    }
    let columns: Vec<StateColumns> = rows
        .iter()
        .map(|(_, r)| StateColumns::from(&r.state))
        .collect();
    let number = |of: fn(&Range) -> i64| rows.iter().map(|(_, r)| of(r)).collect::<Vec<_>>();
    let owner = mine.then_some(writer.instance);
    sqlx::query(
        "INSERT INTO task_range (id, stage, lo, hi, epoch, crashes, state, not_before_ms, worker, incarnation, \
         lease_until_ms, marks, owner) \
         SELECT *, $13 FROM UNNEST($1::UUID[], $2::BIGINT[], $3::BIGINT[], $4::BIGINT[], $5::BIGINT[], $6::BIGINT[], \
         $7::BIGINT[], $8::BIGINT[], $9::UUID[], $10::UUID[], $11::BIGINT[], $12::BYTEA[])",
    )
    .bind(rows.iter().map(|(_, r)| r.id.uuid()).collect::<Vec<_>>())
    .bind(rows.iter().map(|(key, _)| *key).collect::<Vec<_>>())
    .bind(number(|r| int(r.lo)))
    .bind(number(|r| int(r.hi)))
    .bind(number(|r| int(r.epoch.0)))
    .bind(number(|r| i64::from(r.crashes)))
    .bind(columns.iter().map(|c| c.state).collect::<Vec<_>>())
    .bind(columns.iter().map(|c| c.not_before_ms).collect::<Vec<_>>())
    .bind(columns.iter().map(|c| c.worker).collect::<Vec<_>>())
    .bind(columns.iter().map(|c| c.incarnation).collect::<Vec<_>>())
    .bind(columns.iter().map(|c| c.lease_until_ms).collect::<Vec<_>>())
    .bind(columns.into_iter().map(|c| c.marks).collect::<Vec<_>>())
    .bind(owner)
    .execute(&mut *writer.c)
    .await?;
    Ok(())
}

/// Writes an unowned range, merged with its neighbours in the same state unless another instance
/// has them locked.
pub(super) async fn give(writer: &mut Writer<'_>, key: i64, range: &Range) -> Result<()> {
    let mut range = range.clone();
    let columns = StateColumns::from(&range.state);
    if range.merges() {
        let rows = sqlx::query(
            "DELETE FROM task_range WHERE id IN (SELECT id FROM task_range WHERE stage = $1 AND state = $2 \
             AND (hi = $3 OR lo = $4) AND owner IS NULL AND crashes = 0 AND coalesce(not_before_ms, 0) = 0 \
             FOR UPDATE SKIP LOCKED) RETURNING lo, hi, epoch",
        )
        .bind(key)
        .bind(columns.state)
        .bind(int(range.lo))
        .bind(int(range.hi))
        .fetch_all(&mut *writer.c)
        .await?;
        for row in rows {
            let number = |column| row.try_get::<i64, _>(column).map(i64::unsigned_abs);
            range.lo = range.lo.min(number("lo")?);
            range.hi = range.hi.max(number("hi")?);
            range.epoch.0 = range.epoch.0.max(number("epoch")?);
        }
    }
    insert_ranges(writer, &[(key, &range)], false).await
}

async fn insert_outputs(writer: &mut Writer<'_>, outputs: &[Output]) -> Result<()> {
    if outputs.is_empty() {
        return Ok(());
    }
    sql::writable(outputs)?;
    let mut sets = Vec::with_capacity(outputs.len());
    for output in outputs {
        sets.push(writer.keys(output.stage).await?.result_set);
    }
    let written = sqlx::query(
        "INSERT INTO output (result_set, task, manifest, bytes, seconds, epoch, adopted, checked) \
         SELECT * FROM UNNEST($1::BIGINT[], $2::BIGINT[], $3::BYTEA[], $4::BIGINT[], $5::DOUBLE PRECISION[], \
         $6::BIGINT[], $7::BOOLEAN[], $8::BOOLEAN[]) ON CONFLICT DO NOTHING",
    )
    .bind(sets)
    .bind(outputs.iter().map(|o| int(o.task)).collect::<Vec<_>>())
    .bind(
        outputs
            .iter()
            .map(|o| o.manifest.to_vec())
            .collect::<Vec<_>>(),
    )
    .bind(outputs.iter().map(|o| int(o.bytes)).collect::<Vec<_>>())
    .bind(outputs.iter().map(|o| o.seconds).collect::<Vec<_>>())
    .bind(outputs.iter().map(|o| int(o.epoch.0)).collect::<Vec<_>>())
    .bind(outputs.iter().map(|o| o.adopted).collect::<Vec<_>>())
    .bind(outputs.iter().map(|o| o.checked).collect::<Vec<_>>())
    .execute(&mut *writer.c)
    .await?
    .rows_affected();
    if written != outputs.len() as u64 {
        let tasks: Vec<_> = outputs.iter().map(|o| (o.stage, o.task)).collect();
        let there = manifests(writer.c, &tasks).await?;
        sql::equal_manifests(outputs, &there).map_err(WriteError::Conflict)?;
    }
    Ok(())
}

/// Returns the manifests of many tasks, with one query per stage.
pub(super) async fn manifests(
    c: &mut PgConnection,
    tasks: &[(StageRef, u64)],
) -> Sql<Vec<Option<[u8; 32]>>> {
    let mut by_stage: BTreeMap<StageRef, Vec<i64>> = BTreeMap::new();
    for (stage, task) in tasks {
        by_stage.entry(*stage).or_default().push(int(*task));
    }
    let mut found = HashMap::new();
    for (stage, indices) in by_stage {
        let rows = sqlx::query(
            "SELECT task, manifest FROM output WHERE task = ANY($3) AND result_set = (SELECT result_set FROM stage \
             JOIN job ON job.key = stage.job WHERE job.id = $1 AND ordinal = $2)",
        )
        .bind(stage.job.uuid())
        .bind(i64::from(stage.stage))
        .bind(indices)
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

pub(super) async fn insert_events(writer: &mut Writer<'_>, events: &[NewEvent]) -> Result<()> {
    if events.is_empty() {
        return Ok(());
    }
    let mut jobs = Vec::with_capacity(events.len());
    for event in events {
        jobs.push(writer.job(event.job).await?);
    }
    let text =
        |of: fn(&NewEvent) -> &str| events.iter().map(|e| of(e).to_owned()).collect::<Vec<_>>();
    sqlx::query(
        "INSERT INTO event (at_ms, job, kind, lo, hi, worker, seconds, message, stage) \
         SELECT * FROM UNNEST($1::BIGINT[], $2::BIGINT[], $3::BIGINT[], $4::BIGINT[], $5::BIGINT[], $6::TEXT[], \
         $7::DOUBLE PRECISION[], $8::TEXT[], $9::BIGINT[])",
    )
    .bind(events.iter().map(|e| e.at_ms).collect::<Vec<_>>())
    .bind(jobs)
    .bind(
        events
            .iter()
            .map(|e| sql::event_kind_code(e.kind))
            .collect::<Vec<_>>(),
    )
    .bind(
        events
            .iter()
            .map(|e| e.tasks.map(|t| int(t.lo)))
            .collect::<Vec<_>>(),
    )
    .bind(
        events
            .iter()
            .map(|e| e.tasks.map(|t| int(t.hi)))
            .collect::<Vec<_>>(),
    )
    .bind(text(|e| &e.worker))
    .bind(events.iter().map(|e| e.seconds).collect::<Vec<_>>())
    .bind(text(|e| &e.message))
    .bind(
        events
            .iter()
            .map(|e| e.stage.map(i64::from))
            .collect::<Vec<_>>(),
    )
    .execute(&mut *writer.c)
    .await?;
    Ok(())
}
