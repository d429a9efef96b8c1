//! Everything that writes. What a house writes it writes at its [`Desk`], behind the [`fence`]; rows go in bulk, as
//! arrays.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use picofarm_proto::{
    ids::{HouseId, JobId, RangeId, StageRef, WorkerId},
    model::{EventKind, JobState},
};
use sqlx::{PgConnection, Row, postgres::PgRow};
use uuid::Uuid;

use super::query;
use crate::{
    Changes, Claim, Exception, Job, JobEnd, NewEvent, Output, Owned, Range, Want,
    record::RangeState,
    sql::{self, StateColumns, int},
};

/// Pending ranges looked at for one wish.
const LOOK_AT: i64 = 256;
/// A range with the names of its job and stage.
const RANGE: &str = "task_range.*, (SELECT id FROM job JOIN stage ON stage.job = job.key WHERE stage.key = task_range.stage) AS job_id, \
                     (SELECT ordinal FROM stage WHERE stage.key = task_range.stage) AS ordinal";

pub(super) enum WriteError {
    Fenced,
    Conflict(String),
    Sql(sqlx::Error),
}

impl From<sqlx::Error> for WriteError {
    fn from(e: sqlx::Error) -> Self {
        Self::Sql(e)
    }
}

type Result<T> = std::result::Result<T, WriteError>;
type Sql<T> = std::result::Result<T, sqlx::Error>;

/// Integer keys of stages, remembered: they never change.
#[derive(Default)]
pub(super) struct Keys(HashMap<StageRef, StageKeys>);

#[derive(Clone, Copy)]
struct StageKeys {
    stage: i64,
    job: i64,
    result_set: i64,
}

/// Where a house writes: inside a transaction that has passed the fence.
pub(super) struct Desk<'a> {
    pub c: &'a mut PgConnection,
    pub house: Uuid,
    pub keys: &'a mut Keys,
}

impl Desk<'_> {
    async fn keys(&mut self, stage: StageRef) -> Result<StageKeys> {
        if let Some(keys) = self.keys.0.get(&stage) {
            return Ok(*keys);
        }
        let found: Option<(i64, i64, i64)> = sqlx::query_as(
            "SELECT stage.key, stage.job, stage.result_set FROM stage JOIN job ON job.key = stage.job \
             WHERE job.id = $1 AND ordinal = $2",
        )
        .bind(stage.job.uuid())
        .bind(i64::from(stage.stage))
        .fetch_optional(&mut *self.c)
        .await?;
        let (key, job, result_set) =
            found.ok_or_else(|| WriteError::Conflict(format!("there is no stage {stage}")))?;
        let keys = StageKeys {
            stage: key,
            job,
            result_set,
        };
        self.keys.0.insert(stage, keys);
        Ok(keys)
    }

    async fn job(&mut self, job: JobId) -> Result<i64> {
        Ok(self.keys(StageRef { job, stage: 0 }).await?.job)
    }
}

/// Holds the house's row until the transaction ends: it is alive, and cannot be found lost meanwhile.
pub(super) async fn fence(c: &mut PgConnection, house: HouseId) -> Result<()> {
    let alive: Option<i32> = sqlx::query_scalar(
        "SELECT 1 FROM house WHERE id = $1 AND until > clock_timestamp() FOR KEY SHARE",
    )
    .bind(house.uuid())
    .fetch_optional(c)
    .await?;
    alive.map(|_| ()).ok_or(WriteError::Fenced)
}

/// Founds a house, which inherits from a former life of the same process.
pub(super) async fn found(
    c: &mut PgConnection,
    house: HouseId,
    former: Option<HouseId>,
    name: &str,
    seconds: f64,
) -> Sql<()> {
    sqlx::query(
        "INSERT INTO house (id, name, workers, until) \
         VALUES ($1, $2, 0, clock_timestamp() + make_interval(secs => $3))",
    )
    .bind(house.uuid())
    .bind(name)
    .bind(seconds)
    .execute(&mut *c)
    .await?;
    if let Some(former) = former {
        sqlx::query("DELETE FROM house WHERE id = $1")
            .bind(former.uuid())
            .execute(c)
            .await?;
    }
    Ok(())
}

/// Prolongs the house's time; `false` where it is over.
pub(super) async fn renew(
    c: &mut PgConnection,
    house: HouseId,
    workers: u32,
    seconds: f64,
) -> Sql<bool> {
    let renewed = sqlx::query(
        "UPDATE house SET until = clock_timestamp() + make_interval(secs => $3), workers = $2 \
         WHERE id = $1 AND until > clock_timestamp()",
    )
    .bind(house.uuid())
    .bind(i64::from(workers))
    .bind(seconds)
    .execute(c)
    .await?;
    Ok(renewed.rows_affected() == 1)
}

/// Takes over the ranges of houses whose time is over, or that are no more. A house that writes just now holds its row,
/// so this waits for it and then sees what it wrote.
pub(super) async fn take_lost(c: &mut PgConnection, house: HouseId) -> Sql<Vec<Range>> {
    sqlx::query("DELETE FROM house WHERE until < clock_timestamp()")
        .execute(&mut *c)
        .await?;
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "UPDATE task_range SET owner = $1 WHERE owner IS NOT NULL \
         AND NOT EXISTS (SELECT 1 FROM house WHERE house.id = owner) RETURNING {RANGE}"
    )))
    .bind(house.uuid())
    .fetch_all(c)
    .await?;
    ranges(&rows)
}

/// Houses alive and their workers.
pub(super) async fn count_houses(c: &mut PgConnection) -> Sql<(u32, u32)> {
    let row = sqlx::query(
        "SELECT count(*) AS houses, CAST(coalesce(sum(workers), 0) AS BIGINT) AS workers FROM house \
         WHERE until > clock_timestamp()",
    )
    .fetch_one(c)
    .await?;
    let number = |column| {
        row.try_get::<i64, _>(column)
            .map(|n| u32::try_from(n).unwrap_or(u32::MAX))
    };
    Ok((number("houses")?, number("workers")?))
}

/// The leased ranges that are this house's.
pub(super) async fn leased(c: &mut PgConnection, house: HouseId) -> Sql<BTreeSet<RangeId>> {
    let ids: Vec<Uuid> =
        sqlx::query_scalar("SELECT id FROM task_range WHERE owner = $1 AND state = 1")
            .bind(house.uuid())
            .fetch_all(c)
            .await?;
    Ok(ids.into_iter().map(RangeId::from_uuid).collect())
}

/// Gives everything up that is not leased, and the house. Its leases find a new one.
pub(super) async fn leave(c: &mut PgConnection, house: HouseId) -> Sql<()> {
    sqlx::query("UPDATE task_range SET owner = NULL WHERE owner = $1 AND state = 0")
        .bind(house.uuid())
        .execute(&mut *c)
        .await?;
    sqlx::query("DELETE FROM house WHERE id = $1")
        .bind(house.uuid())
        .execute(c)
        .await?;
    Ok(())
}

pub(super) async fn adopt(desk: &mut Desk<'_>, worker: WorkerId) -> Result<Vec<Range>> {
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "UPDATE task_range SET owner = $1 WHERE worker = $2 AND state = 1 AND owner <> $1 RETURNING {RANGE}"
    )))
    .bind(desk.house)
    .bind(worker.uuid())
    .fetch_all(&mut *desk.c)
    .await?;
    Ok(ranges(&rows)?)
}

fn ranges(rows: &[PgRow]) -> Sql<Vec<Range>> {
    rows.iter().map(query::range).collect()
}

pub(super) async fn claim(desk: &mut Desk<'_>, wants: &[Want]) -> Result<Vec<Claim>> {
    let mut claims = Vec::with_capacity(wants.len());
    for want in wants {
        let key = desk.keys(want.stage).await?.stage;
        let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
            "SELECT {RANGE} FROM task_range WHERE stage = $1 AND state = 0 AND owner IS NULL AND not_before_ms <= $2 \
             AND EXISTS (SELECT 1 FROM job JOIN stage ON stage.job = job.key WHERE stage.key = $1 AND job.state = 0) \
             ORDER BY not_before_ms, lo LIMIT $3 FOR UPDATE SKIP LOCKED"
        )))
        .bind(key)
        .bind(want.now_ms)
        .bind(LOOK_AT)
        .fetch_all(&mut *desk.c)
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
                    .execute(&mut *desk.c)
                    .await?;
                range.id = RangeId::from_uuid(Uuid::now_v7());
                range.hi = cut;
                insert_ranges(desk, &[(key, &range)], true).await?;
            }
            missing -= range.len();
            claimed.push(range);
        }
        sqlx::query("UPDATE task_range SET owner = $1 WHERE id = ANY($2)")
            .bind(desk.house)
            .bind(&whole)
            .execute(&mut *desk.c)
            .await?;
        let mut existing = Vec::new();
        for range in &claimed {
            existing.extend(query::runs_of_stage(desk.c, want.stage, range.lo, range.hi).await?);
        }
        existing.sort_unstable_by_key(|run| run.lo);
        let left: i64 = sqlx::query_scalar(
            "SELECT CAST(coalesce(sum(hi - lo), 0) AS BIGINT) FROM task_range \
             WHERE stage = $1 AND state = 0 AND owner IS NULL",
        )
        .bind(key)
        .fetch_one(&mut *desk.c)
        .await?;
        claims.push(Claim {
            owned: Owned {
                exceptions: query::exceptions(desk.c, &claimed).await?,
                ranges: claimed,
            },
            existing,
            left: left.unsigned_abs(),
        });
    }
    Ok(claims)
}

pub(super) async fn changes(desk: &mut Desk<'_>, changes: &Changes) -> Result<Vec<JobEnd>> {
    replace_known(desk, changes).await?;
    let mut rows = Vec::with_capacity(changes.ranges.len());
    for range in changes.ranges.values() {
        rows.push((desk.keys(range.stage).await?.stage, range));
    }
    insert_ranges(desk, &rows, true).await?;
    for range in changes.free.values() {
        let key = desk.keys(range.stage).await?.stage;
        give(desk, key, range).await?;
    }
    insert_outputs(desk, &changes.outputs).await?;
    for exception in changes.exceptions.values() {
        put_exception(desk, exception).await?;
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
        .execute(&mut *desk.c)
        .await?;
    }
    insert_events(desk, &changes.events).await?;
    let mut ended = Vec::new();
    for (job, at_ms) in &changes.perhaps_over {
        ended.extend(end_if_over(desk, *job, *at_ms).await?);
    }
    Ok(ended)
}

async fn put_exception(desk: &mut Desk<'_>, exception: &Exception) -> Result<()> {
    let stage = desk.keys(exception.stage).await?.stage;
    sqlx::query(
        "INSERT INTO exception (stage, task, failures, crashes, dead, last_error) VALUES ($1, $2, $3, $4, $5, $6) \
         ON CONFLICT (stage, task) DO UPDATE SET failures = excluded.failures, crashes = excluded.crashes, \
         dead = excluded.dead, last_error = excluded.last_error",
    )
    .bind(stage)
    .bind(int(exception.task))
    .bind(i64::from(exception.failures))
    .bind(i64::from(exception.crashes))
    .bind(exception.dead)
    .bind(&exception.last_error)
    .execute(&mut *desk.c)
    .await?;
    Ok(())
}

/// Removes the former state of every range that changes, having checked that it is this house's.
async fn replace_known(desk: &mut Desk<'_>, changes: &Changes) -> Result<()> {
    let known: Vec<Uuid> = changes.known().map(RangeId::uuid).collect();
    if known.is_empty() {
        return Ok(());
    }
    let found = sqlx::query("DELETE FROM task_range WHERE owner = $1 AND id = ANY($2)")
        .bind(desk.house)
        .bind(&known)
        .execute(&mut *desk.c)
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

async fn insert_ranges(desk: &mut Desk<'_>, rows: &[(i64, &Range)], mine: bool) -> Result<()> {
    if rows.is_empty() {
        return Ok(());
    }
    let columns: Vec<StateColumns> = rows
        .iter()
        .map(|(_, r)| StateColumns::from(&r.state))
        .collect();
    let number = |of: fn(&Range) -> i64| rows.iter().map(|(_, r)| of(r)).collect::<Vec<_>>();
    let owner = mine.then_some(desk.house);
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
    .execute(&mut *desk.c)
    .await?;
    Ok(())
}

/// Writes a range of nobody's, merged with its neighbours in the same state, as far as no other house has them in its
/// hands just now.
async fn give(desk: &mut Desk<'_>, key: i64, range: &Range) -> Result<()> {
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
        .fetch_all(&mut *desk.c)
        .await?;
        for row in rows {
            let number = |column| row.try_get::<i64, _>(column).map(i64::unsigned_abs);
            range.lo = range.lo.min(number("lo")?);
            range.hi = range.hi.max(number("hi")?);
            range.epoch.0 = range.epoch.0.max(number("epoch")?);
        }
    }
    insert_ranges(desk, &[(key, &range)], false).await
}

async fn insert_outputs(desk: &mut Desk<'_>, outputs: &[Output]) -> Result<()> {
    if outputs.is_empty() {
        return Ok(());
    }
    let mut sets = Vec::with_capacity(outputs.len());
    for output in outputs {
        sets.push(desk.keys(output.stage).await?.result_set);
    }
    let written = sqlx::query(
        "INSERT INTO output (result_set, task, manifest, bytes, seconds, epoch, adopted) \
         SELECT * FROM UNNEST($1::BIGINT[], $2::BIGINT[], $3::BYTEA[], $4::BIGINT[], $5::DOUBLE PRECISION[], \
         $6::BIGINT[], $7::BOOLEAN[]) ON CONFLICT DO NOTHING",
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
    .execute(&mut *desk.c)
    .await?
    .rows_affected();
    if written != outputs.len() as u64 {
        let tasks: Vec<_> = outputs.iter().map(|o| (o.stage, o.task)).collect();
        let there = manifests(desk.c, &tasks).await?;
        sql::equal_manifests(outputs, &there).map_err(WriteError::Conflict)?;
    }
    Ok(())
}

/// The manifests of many tasks in one query for each stage.
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

async fn insert_events(desk: &mut Desk<'_>, events: &[NewEvent]) -> Result<()> {
    if events.is_empty() {
        return Ok(());
    }
    let mut jobs = Vec::with_capacity(events.len());
    for event in events {
        jobs.push(desk.job(event.job).await?);
    }
    let text = |of: fn(&NewEvent) -> &str| events.iter().map(|e| of(e).to_owned()).collect::<Vec<_>>();
    sqlx::query(
        "INSERT INTO event (at_ms, job, kind, lo, hi, worker, seconds, message) \
         SELECT * FROM UNNEST($1::BIGINT[], $2::BIGINT[], $3::BIGINT[], $4::BIGINT[], $5::BIGINT[], $6::TEXT[], \
         $7::DOUBLE PRECISION[], $8::TEXT[])",
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
    // Postgres' text holds no NUL.
    .bind(
        events
            .iter()
            .map(|e| e.message.replace('\0', "\u{fffd}"))
            .collect::<Vec<_>>(),
    )
    .execute(&mut *desk.c)
    .await?;
    Ok(())
}

/// Ends an active job of which nothing is pending or leased. Its row is locked first: of two houses that finish their
/// last tasks at once, the second sees what the first wrote.
async fn end_if_over(desk: &mut Desk<'_>, id: JobId, at_ms: i64) -> Result<Option<JobEnd>> {
    let key = desk.job(id).await?;
    let active: Option<i32> =
        sqlx::query_scalar("SELECT 1 FROM job WHERE key = $1 AND state = 0 FOR UPDATE")
            .bind(key)
            .fetch_optional(&mut *desk.c)
            .await?;
    if active.is_none() {
        return Ok(None);
    }
    let open: Option<i32> = sqlx::query_scalar(
        "SELECT 1 FROM task_range JOIN stage ON stage.key = task_range.stage \
         WHERE stage.job = $1 AND state IN (0, 1) LIMIT 1",
    )
    .bind(key)
    .fetch_optional(&mut *desk.c)
    .await?;
    if open.is_some() {
        return Ok(None);
    }
    let counts = query::counts(desk.c, key).await?;
    let state = if counts.dead > 0 {
        JobState::Failed
    } else {
        JobState::Done
    };
    sqlx::query(
        "UPDATE job SET state = $2, ended_ms = $3, tasks = $4, done = $5, reused = $6, dead = $7, \
         (timed, seconds) = (SELECT count(*), coalesce(sum(seconds), 0) FROM output \
           WHERE NOT adopted AND result_set IN (SELECT result_set FROM stage WHERE job = $1)) WHERE key = $1",
    )
    .bind(key)
    .bind(sql::job_state_code(state))
    .bind(at_ms)
    .bind(int(counts.total))
    .bind(int(counts.done))
    .bind(int(counts.reused))
    .bind(int(counts.dead))
    .execute(&mut *desk.c)
    .await?;
    insert_events(desk, &[NewEvent::ended(id, at_ms, &counts)]).await?;
    Ok(Some(JobEnd {
        job: id,
        state,
        at_ms,
    }))
}

pub(super) async fn submit(
    desk: &mut Desk<'_>,
    job: &Job,
    ranges: &[Range],
    events: &[NewEvent],
) -> Result<bool> {
    let spec = serde_json::to_string(&*job.spec).expect("a spec is plain data");
    let key: Option<i64> = sqlx::query_scalar(
        "INSERT INTO job (id, spec_hash, spec, state, submitted_ms) VALUES ($1, $2, $3, 0, $4) \
         ON CONFLICT DO NOTHING RETURNING key",
    )
    .bind(job.id.uuid())
    .bind(&job.spec_hash)
    .bind(spec)
    .bind(job.submitted_ms)
    .fetch_optional(&mut *desk.c)
    .await?;
    let Some(key) = key else {
        return Ok(false);
    };
    let mut stages = HashMap::new();
    for stage in job.stages() {
        let set = &stage.set;
        sqlx::query(
            "INSERT INTO result_set (store, dataset, stage_key) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING",
        )
        .bind(&set.store)
        .bind(&set.dataset)
        .bind(&set.stage_key.0[..])
        .execute(&mut *desk.c)
        .await?;
        let stage_key: i64 = sqlx::query_scalar(
            "INSERT INTO stage (job, ordinal, result_set, tasks) SELECT $1, $2, key, $3 FROM result_set \
             WHERE store = $4 AND dataset = $5 AND stage_key = $6 RETURNING key",
        )
        .bind(key)
        .bind(i64::from(stage.id.stage))
        .bind(int(stage.tasks))
        .bind(&set.store)
        .bind(&set.dataset)
        .bind(&set.stage_key.0[..])
        .fetch_one(&mut *desk.c)
        .await?;
        stages.insert(stage.id, stage_key);
    }
    let rows: Vec<_> = ranges.iter().map(|r| (stages[&r.stage], r)).collect();
    insert_ranges(desk, &rows, false).await?;
    insert_events(desk, events).await?;
    end_if_over(desk, job.id, job.submitted_ms).await?;
    Ok(true)
}

pub(super) async fn cancel(desk: &mut Desk<'_>, job: JobId, now_ms: i64) -> Result<bool> {
    let key = desk.job(job).await?;
    let cancelled =
        sqlx::query("UPDATE job SET state = $1, ended_ms = $2 WHERE key = $3 AND state = 0")
            .bind(sql::job_state_code(JobState::Cancelled))
            .bind(now_ms)
            .bind(key)
            .execute(&mut *desk.c)
            .await?
            .rows_affected()
            > 0;
    if cancelled {
        let event = NewEvent::of(job, now_ms, EventKind::Cancelled, String::new());
        insert_events(desk, &[event]).await?;
    }
    Ok(cancelled)
}

pub(super) async fn retry(desk: &mut Desk<'_>, job: JobId, now_ms: i64) -> Result<u64> {
    let key = desk.job(job).await?;
    // The job's row first, as whoever ends it does.
    sqlx::query("SELECT 1 FROM job WHERE key = $1 FOR UPDATE")
        .bind(key)
        .execute(&mut *desk.c)
        .await?;
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "DELETE FROM task_range WHERE state = 4 AND stage IN (SELECT key FROM stage WHERE job = $1) RETURNING {RANGE}"
    )))
    .bind(key)
    .fetch_all(&mut *desk.c)
    .await?;
    let mut retried = 0;
    for mut range in ranges(&rows)? {
        retried += range.len();
        range.crashes = 0;
        range.state = RangeState::Pending { not_before_ms: 0 };
        let stage = desk.keys(range.stage).await?.stage;
        give(desk, stage, &range).await?;
        sqlx::query("DELETE FROM exception WHERE stage = $1 AND task >= $2 AND task < $3")
            .bind(stage)
            .bind(int(range.lo))
            .bind(int(range.hi))
            .execute(&mut *desk.c)
            .await?;
    }
    if retried > 0 {
        sqlx::query("UPDATE job SET state = 0, ended_ms = NULL, tasks = NULL WHERE key = $1")
            .bind(key)
            .execute(&mut *desk.c)
            .await
            .map_err(|e| match e.as_database_error() {
                Some(e) if e.is_unique_violation() => WriteError::Conflict(sql::LATER_JOB.into()),
                _ => WriteError::Sql(e),
            })?;
        let message = format!("{retried} dead tasks are pending again");
        let event = NewEvent::of(job, now_ms, EventKind::Retried, message);
        insert_events(desk, &[event]).await?;
    }
    Ok(retried)
}
