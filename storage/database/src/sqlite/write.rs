//! Claims and commits, each in one transaction.

use picofarm_catalog::{Changes, Claim, Owned, Range, Settled, Want};
use picofarm_proto::ids::{InstanceId, RangeId};
use sqlx::{QueryBuilder, Sqlite, SqliteConnection};
use uuid::Uuid;

use super::{
    job_query, jobs, query,
    rows::{ROWS, give, insert_ranges, write_rows},
    usage_query,
    writer::{Keys, Result, WriteError},
};
use crate::{sql::int, sql_jobs::held};

/// The number of pending ranges examined for one request.
const LOOK_AT: i64 = 256;

/// Bytes written at the start of a life, to check that there is space for a batch.
const ROOM: i64 = 256 << 10;

/// Records the instance of the current life.
pub(super) async fn record_instance(
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

/// Bytes written during a life, to check for free space.
const SOME_ROOM: i64 = 64 << 10;

/// Rewrites one page for each 4 KiB of this space.
pub(super) async fn try_room(c: &mut SqliteConnection) -> std::result::Result<(), sqlx::Error> {
    sqlx::query("UPDATE life SET room = zeroblob(?) WHERE key = 1")
        .bind(SOME_ROOM)
        .execute(c)
        .await?;
    Ok(())
}

/// Returns the ranges that this instance owns.
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
        let key = keys.stage(c, want.stage).await?.stage;
        let rows = sqlx::query(concat!(
            "SELECT task_range.*, job.id AS job_id, ordinal FROM task_range JOIN stage ON stage.key = task_range.stage \
             JOIN job ON job.key = stage.job WHERE stage = ? AND task_range.state = 0 AND owner IS NULL \
             AND not_before_ms <= ? AND (? OR crashes = 0) AND stage.state = 1 AND job.state = 0 AND NOT ",
            held!(),
            " ORDER BY not_before_ms, lo LIMIT ?",
        ))
        .bind(key)
        .bind(want.now_ms)
        .bind(want.suspects)
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
        claims.push(Claim {
            owned: Owned {
                exceptions: query::exceptions(c, &ranges).await?,
                ranges,
            },
            existing,
            left: job_query::free_of_stage(c, key, want.now_ms).await?,
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
        rows.push((keys.stage(c, range.stage).await?.stage, range));
    }
    insert_ranges(c, &rows, true).await?;
    for range in changes.free.values() {
        let key = keys.stage(c, range.stage).await?.stage;
        give(c, key, range).await?;
    }
    write_rows(c, keys, changes).await?;
    for ((day, job), usage) in &changes.usage {
        let job = keys.job(c, *job).await?;
        // A catalog in SQLite has one instance at a time, so all share their rows.
        usage_query::add(c, Uuid::nil(), (*day, job), usage).await?;
    }
    let mut settled = Settled::default();
    for (stage, at_ms) in &changes.perhaps_over {
        settled.join(jobs::stage_over(c, keys, *stage, *at_ms).await?);
    }
    Ok(settled)
}

/// Deletes the former state of every changed range, after checking that it exists.
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
