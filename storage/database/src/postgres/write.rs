//! Claims and commits of an instance. All writes go through its [`Writer`], behind the fence.

use picofarm_catalog::{Changes, Claim, Owned, Range, Settled, Want};
use picofarm_proto::ids::RangeId;
use uuid::Uuid;

use super::{
    job_query, jobs, query,
    rows::{give, insert_ranges, write_rows},
    usage_query,
    writer::{RANGE, Result, WriteError, Writer},
};
use crate::{sql::int, sql_jobs::held};

/// The number of pending ranges examined for one request.
const LOOK_AT: i64 = 256;
pub(super) async fn claim(writer: &mut Writer<'_>, wants: &[Want]) -> Result<Vec<Claim>> {
    let mut claims = Vec::with_capacity(wants.len());
    let held = held!();
    for want in wants {
        let key = writer.keys(want.stage).await?.stage;
        let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
            "SELECT {RANGE} FROM task_range WHERE stage = $1 AND state = 0 AND owner IS NULL AND not_before_ms <= $2 \
             AND ($4 OR crashes = 0) \
             AND EXISTS (SELECT 1 FROM job JOIN stage ON stage.job = job.key \
               WHERE stage.key = $1 AND stage.state = 1 AND job.state = 0 AND NOT {held}) \
             ORDER BY not_before_ms, lo LIMIT $3 FOR UPDATE SKIP LOCKED"
        )))
        .bind(key)
        .bind(want.now_ms)
        .bind(LOOK_AT)
        .bind(want.suspects)
        .fetch_all(&mut *writer.c)
        .await?;
        let mut claimed: Vec<Range> = Vec::new();
        let mut whole = Vec::new();
        let mut missing = want.tasks;
        for row in &rows {
            if missing == 0 {
                break;
            }
            let mut range = query::range(row)?;
            if range.len() <= missing {
                whole.push(range.id.uuid());
            } else {
                let cut = range.lo + missing;
                sqlx::query("UPDATE task_range SET lo = $1 WHERE id = $2")
                    .bind(int(cut))
                    .bind(range.id.uuid())
                    .execute(&mut *writer.c)
                    .await?;
                range.id = RangeId::from_uuid(Uuid::now_v7());
                range.hi = cut;
                insert_ranges(writer, &[(key, &range)], true).await?;
            }
            missing -= range.len();
            claimed.push(range);
        }
        sqlx::query("UPDATE task_range SET owner = $1 WHERE id = ANY($2)")
            .bind(writer.instance)
            .bind(&whole)
            .execute(&mut *writer.c)
            .await?;
        let mut existing = Vec::new();
        for range in claimed.iter().filter(|_| !want.force) {
            existing.extend(query::runs_of_stage(writer.c, want.stage, range.lo, range.hi).await?);
        }
        existing.sort_unstable_by_key(|run| run.lo);
        claims.push(Claim {
            owned: Owned {
                exceptions: query::exceptions(writer.c, &claimed).await?,
                ranges: claimed,
            },
            existing,
            left: job_query::free_of_stage(writer.c, key, want.now_ms).await?,
        });
    }
    Ok(claims)
}

pub(super) async fn changes(writer: &mut Writer<'_>, changes: &Changes) -> Result<Settled> {
    replace_known(writer, changes).await?;
    let mut rows = Vec::with_capacity(changes.ranges.len());
    for range in changes.ranges.values() {
        rows.push((writer.keys(range.stage).await?.stage, range));
    }
    insert_ranges(writer, &rows, true).await?;
    for range in changes.free.values() {
        let key = writer.keys(range.stage).await?.stage;
        give(writer, key, range).await?;
    }
    write_rows(writer, changes).await?;
    for ((day, job), usage) in &changes.usage {
        let job = writer.job(*job).await?;
        usage_query::add(writer.c, writer.instance, (*day, job), usage).await?;
    }
    let mut settled = Settled::default();
    for (stage, at_ms) in &changes.perhaps_over {
        settled.join(jobs::stage_over(writer, *stage, *at_ms).await?);
    }
    Ok(settled)
}

/// Deletes the former state of every changed range, after checking that this instance owns it.
async fn replace_known(writer: &mut Writer<'_>, changes: &Changes) -> Result<()> {
    let known: Vec<Uuid> = changes.known().map(RangeId::uuid).collect();
    if known.is_empty() {
        return Ok(());
    }
    let found = sqlx::query("DELETE FROM task_range WHERE owner = $1 AND id = ANY($2)")
        .bind(writer.instance)
        .bind(&known)
        .execute(&mut *writer.c)
        .await?
        .rows_affected();
    if found != known.len() as u64 {
        return Err(WriteError::Conflict(format!(
            "{found} of {} ranges are still this coordinator's; a worker took the others along to another",
            known.len()
        )));
    }
    Ok(())
}
