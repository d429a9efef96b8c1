//! Between records and columns.

use picofarm_proto::{
    ids::{Epoch, Incarnation, JobId, RangeId, WorkerId},
    model::{EventKind, JobState},
};
use sqlx::{Row, sqlite::SqliteRow};
use uuid::Uuid;

use crate::record::{LeaseState, Mark, Range, RangeState};

/// A column that holds what no version of this program wrote.
pub(super) fn bad(column: &'static str, what: impl std::fmt::Display) -> sqlx::Error {
    sqlx::Error::ColumnDecode {
        index: column.into(),
        source: what.to_string().into(),
    }
}

pub(super) fn uuid(row: &SqliteRow, column: &'static str) -> Result<Uuid, sqlx::Error> {
    Uuid::from_slice(row.try_get(column)?).map_err(|e| bad(column, e))
}

/// SQLite's integers are signed; ours never reach the sign bit.
pub(super) fn int(value: u64) -> i64 {
    i64::try_from(value).expect("counts, indices and sizes are below 2^63")
}

pub(super) fn uint(row: &SqliteRow, column: &'static str) -> Result<u64, sqlx::Error> {
    u64::try_from(row.try_get::<i64, _>(column)?).map_err(|e| bad(column, e))
}

const JOB_STATES: [JobState; 4] = [
    JobState::Active,
    JobState::Done,
    JobState::Failed,
    JobState::Cancelled,
];

pub(super) fn job_state_code(state: JobState) -> i64 {
    match state {
        JobState::Active => 0,
        JobState::Done => 1,
        JobState::Failed => 2,
        JobState::Cancelled => 3,
    }
}

pub(super) fn job_state(code: i64) -> Result<JobState, sqlx::Error> {
    usize::try_from(code)
        .ok()
        .and_then(|i| JOB_STATES.get(i).copied())
        .ok_or_else(|| bad("state", code))
}

const EVENT_KINDS: [EventKind; 13] = [
    EventKind::Submitted,
    EventKind::Leased,
    EventKind::Committed,
    EventKind::Reused,
    EventKind::Failed,
    EventKind::Dead,
    EventKind::Expired,
    EventKind::Released,
    EventKind::Cancelled,
    EventKind::Retried,
    EventKind::Ended,
    EventKind::Waiting,
    EventKind::Alarm,
];

pub(super) fn event_kind_code(kind: EventKind) -> i64 {
    EVENT_KINDS
        .iter()
        .position(|k| *k == kind)
        .expect("every kind is listed") as i64
}

pub(super) fn event_kind(code: i64) -> Result<EventKind, sqlx::Error> {
    usize::try_from(code)
        .ok()
        .and_then(|i| EVENT_KINDS.get(i).copied())
        .ok_or_else(|| bad("kind", code))
}

pub(super) const PENDING: i64 = 0;
pub(super) const LEASED: i64 = 1;
pub(super) const DONE: i64 = 2;
pub(super) const DONE_REUSED: i64 = 3;
pub(super) const DEAD: i64 = 4;

fn mark(byte: u8) -> Result<Mark, sqlx::Error> {
    Ok(match byte {
        0 => Mark::Todo,
        1 => Mark::Done,
        2 => Mark::Reused,
        3 => Mark::Left,
        other => return Err(bad("marks", other)),
    })
}

pub(super) fn range(row: &SqliteRow) -> Result<Range, sqlx::Error> {
    let state = match row.try_get::<i64, _>("state")? {
        PENDING => RangeState::Pending {
            not_before_ms: row.try_get("not_before_ms")?,
        },
        LEASED => RangeState::Leased(LeaseState {
            worker: WorkerId::from_uuid(uuid(row, "worker")?),
            incarnation: Incarnation::from_uuid(uuid(row, "incarnation")?),
            until_ms: row.try_get("lease_until_ms")?,
            marks: row
                .try_get::<&[u8], _>("marks")?
                .iter()
                .map(|b| mark(*b))
                .collect::<Result<_, _>>()?,
        }),
        DONE => RangeState::Done { reused: false },
        DONE_REUSED => RangeState::Done { reused: true },
        DEAD => RangeState::Dead,
        other => return Err(bad("state", other)),
    };
    Ok(Range {
        id: RangeId::from_uuid(uuid(row, "id")?),
        job: JobId::from_uuid(uuid(row, "job_id")?),
        lo: uint(row, "lo")?,
        hi: uint(row, "hi")?,
        epoch: Epoch(uint(row, "epoch")?),
        crashes: u32::try_from(uint(row, "crashes")?).map_err(|e| bad("crashes", e))?,
        state,
    })
}
