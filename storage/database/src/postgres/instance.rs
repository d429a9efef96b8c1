//! The lifecycle of an instance: its creation, renewal, loss and end, and the ranges it inherits
//! from others.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::ids::{InstanceId, JobId, RangeId, StageRef, WorkerId};
use sqlx::{PgConnection, Row};
use uuid::Uuid;

use super::{
    query,
    writer::{RANGE, Result, Sql, WriteError, Writer, ranges},
};
use picofarm_catalog::{Range, Run};

/// Locks the instance's row until the transaction ends, so that no other instance can declare it
/// lost in the meantime. An expired row is sufficient if it was not deleted, because the instance
/// still owns its ranges.
pub(super) async fn fence(c: &mut PgConnection, instance: InstanceId) -> Result<()> {
    let alive: Option<i32> =
        sqlx::query_scalar("SELECT 1 FROM instance WHERE id = $1 FOR KEY SHARE")
            .bind(instance.uuid())
            .fetch_optional(c)
            .await?;
    alive.map(|_| ()).ok_or(WriteError::Fenced)
}

/// Fills some pages of a separate table, because other tables may have free pages when the disk is
/// full. The caller's transaction rolls this back, or the table is dropped at its end.
pub(super) async fn try_room(c: &mut PgConnection) -> Sql<()> {
    // 64 rows of 1 KiB, which are too short to be compressed.
    for step in [
        "CREATE TEMPORARY TABLE room (filler TEXT NOT NULL) ON COMMIT DROP",
        "INSERT INTO room SELECT repeat('x', 1024) FROM generate_series(1, 64)",
        "DROP TABLE room",
    ] {
        sqlx::query(step).execute(&mut *c).await?;
    }
    Ok(())
}

/// Creates an instance, which inherits the ranges of a former life of the same process.
pub(super) async fn create_instance(
    c: &mut PgConnection,
    instance: InstanceId,
    former: Option<InstanceId>,
    name: &str,
    seconds: f64,
) -> Sql<()> {
    sqlx::query(
        "INSERT INTO instance (id, name, workers, until) \
         VALUES ($1, $2, 0, clock_timestamp() + make_interval(secs => $3))",
    )
    .bind(instance.uuid())
    .bind(name)
    .bind(seconds)
    .execute(&mut *c)
    .await?;
    if let Some(former) = former {
        sqlx::query("DELETE FROM instance WHERE id = $1")
            .bind(former.uuid())
            .execute(c)
            .await?;
    }
    Ok(())
}

/// Extends the instance's lifetime. Returns `false` if it was declared lost.
pub(super) async fn renew(
    c: &mut PgConnection,
    instance: InstanceId,
    workers: u32,
    seconds: f64,
) -> Sql<bool> {
    let renewed = sqlx::query(
        "UPDATE instance SET until = clock_timestamp() + make_interval(secs => $3), workers = $2 \
         WHERE id = $1",
    )
    .bind(instance.uuid())
    .bind(i64::from(workers))
    .bind(seconds)
    .execute(c)
    .await?;
    Ok(renewed.rows_affected() == 1)
}

/// Takes over the ranges of instances that have expired or are gone. An instance with a write in
/// progress has its row locked, so this call waits for it and then sees its changes.
pub(super) async fn take_lost(c: &mut PgConnection, instance: InstanceId) -> Sql<Vec<Range>> {
    sqlx::query("DELETE FROM instance WHERE until < clock_timestamp()")
        .execute(&mut *c)
        .await?;
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "UPDATE task_range SET owner = $1 WHERE owner IS NOT NULL \
         AND NOT EXISTS (SELECT 1 FROM instance WHERE instance.id = owner) RETURNING {RANGE}"
    )))
    .bind(instance.uuid())
    .fetch_all(c)
    .await?;
    ranges(&rows)
}

/// Returns the number of live instances and of their workers.
pub(super) async fn count_instances(c: &mut PgConnection) -> Sql<(u32, u32)> {
    let row = sqlx::query(
        "SELECT count(*) AS instances, CAST(coalesce(sum(workers), 0) AS BIGINT) AS workers FROM instance \
         WHERE until > clock_timestamp()",
    )
    .fetch_one(c)
    .await?;
    let number = |column| {
        row.try_get::<i64, _>(column)
            .map(|n| u32::try_from(n).unwrap_or(u32::MAX))
    };
    Ok((number("instances")?, number("workers")?))
}

/// Returns the leased ranges that this instance owns.
pub(super) async fn leased(c: &mut PgConnection, instance: InstanceId) -> Sql<BTreeSet<RangeId>> {
    let ids: Vec<Uuid> =
        sqlx::query_scalar("SELECT id FROM task_range WHERE owner = $1 AND state = 1")
            .bind(instance.uuid())
            .fetch_all(c)
            .await?;
    Ok(ids.into_iter().map(RangeId::from_uuid).collect())
}

/// Returns the number of workers with leases from other instances, by job.
pub(super) async fn busy(c: &mut PgConnection, instance: InstanceId) -> Sql<BTreeMap<JobId, u32>> {
    let rows = sqlx::query(
        "SELECT job.id, count(DISTINCT worker) AS workers FROM task_range JOIN stage ON stage.key = task_range.stage \
         JOIN job ON job.key = stage.job WHERE task_range.state = 1 AND owner <> $1 GROUP BY job.id",
    )
    .bind(instance.uuid())
    .fetch_all(c)
    .await?;
    rows.iter()
        .map(|row| {
            let workers = u32::try_from(row.try_get::<i64, _>("workers")?).unwrap_or(u32::MAX);
            Ok((JobId::from_uuid(row.try_get("id")?), workers))
        })
        .collect()
}

/// Returns the ranges that other instances have leased, in stages that share outputs with another
/// stage of an active job.
pub(super) async fn shared(
    c: &mut PgConnection,
    instance: InstanceId,
) -> Sql<BTreeMap<StageRef, Vec<Run>>> {
    let rows = sqlx::query(
        "SELECT job.id AS job_id, stage.ordinal, lo, hi FROM task_range \
         JOIN stage ON stage.key = task_range.stage JOIN job ON job.key = stage.job \
         WHERE task_range.state = 1 AND owner <> $1 AND EXISTS (SELECT 1 FROM stage AS other \
           JOIN job AS its ON its.key = other.job \
           WHERE other.result_set = stage.result_set AND other.key <> stage.key AND its.state = 0)",
    )
    .bind(instance.uuid())
    .fetch_all(c)
    .await?;
    let mut shared: BTreeMap<StageRef, Vec<Run>> = BTreeMap::new();
    for row in &rows {
        let run = Run {
            lo: query::uint(row, "lo")?,
            hi: query::uint(row, "hi")?,
        };
        shared.entry(query::stage_of(row)?).or_default().push(run);
    }
    Ok(shared)
}

/// Releases every range that is not leased, and deletes the instance. Other instances take over its
/// leases.
pub(super) async fn leave(c: &mut PgConnection, instance: InstanceId) -> Sql<()> {
    sqlx::query("UPDATE task_range SET owner = NULL WHERE owner = $1 AND state = 0")
        .bind(instance.uuid())
        .execute(&mut *c)
        .await?;
    sqlx::query("DELETE FROM instance WHERE id = $1")
        .bind(instance.uuid())
        .execute(c)
        .await?;
    Ok(())
}

pub(super) async fn adopt(writer: &mut Writer<'_>, worker: WorkerId) -> Result<Vec<Range>> {
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "UPDATE task_range SET owner = $1 WHERE worker = $2 AND state = 1 AND owner <> $1 RETURNING {RANGE}"
    )))
    .bind(writer.instance)
    .bind(worker.uuid())
    .fetch_all(&mut *writer.c)
    .await?;
    Ok(ranges(&rows)?)
}
