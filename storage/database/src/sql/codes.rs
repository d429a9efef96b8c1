//! The codes in columns that SQLite and Postgres share.

use picofarm_proto::messages::{EventKind, JobState, StageState};

use picofarm_catalog::Mark;

/// Returns the error for a column with a value that no version of this program writes.
pub(crate) fn bad(column: &'static str, what: impl std::fmt::Display) -> sqlx::Error {
    sqlx::Error::ColumnDecode {
        index: column.into(),
        source: what.to_string().into(),
    }
}

/// Converts a number to the databases' signed integers. Written numbers are below 2^63, see
/// [`writable`]. A larger number in a query becomes the maximum, which no row has.
pub(crate) fn int(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

/// Checks that all numbers of the outputs can be written exactly.
///
/// # Errors
/// The error that the database would return.
pub(crate) fn writable(outputs: &[picofarm_catalog::Output]) -> Result<(), sqlx::Error> {
    for output in outputs {
        let most = i64::MAX as u64;
        if output.bytes > most || output.task > most || output.epoch.0 > most {
            let what = format!("task {}: {} bytes are too many", output.task, output.bytes);
            return Err(sqlx::Error::Encode(what.into()));
        }
    }
    Ok(())
}

const JOB_STATES: [JobState; 4] = [
    JobState::Active,
    JobState::Done,
    JobState::Failed,
    JobState::Cancelled,
];

pub(crate) fn job_state_code(state: JobState) -> i64 {
    code(&JOB_STATES, state)
}

pub(crate) fn job_state(code: i64) -> Result<JobState, sqlx::Error> {
    usize::try_from(code)
        .ok()
        .and_then(|i| JOB_STATES.get(i).copied())
        .ok_or_else(|| bad("state", code))
}

const STAGE_STATES: [StageState; 4] = [
    StageState::Blocked,
    StageState::Open,
    StageState::Done,
    StageState::Failed,
];

pub(crate) fn stage_state_code(state: StageState) -> i64 {
    code(&STAGE_STATES, state)
}

pub(crate) fn stage_state(code: i64) -> Result<StageState, sqlx::Error> {
    usize::try_from(code)
        .ok()
        .and_then(|i| STAGE_STATES.get(i).copied())
        .ok_or_else(|| bad("state", code))
}

/// Returns the stored form of the stages that a stage needs: ordinals separated by commas.
pub(crate) fn needs_text(needs: &[u32]) -> String {
    let needs: Vec<String> = needs.iter().map(u32::to_string).collect();
    needs.join(",")
}

pub(crate) fn needs(text: &str) -> Result<Vec<u32>, sqlx::Error> {
    let parts = text.split(',').filter(|part| !part.is_empty());
    parts
        .map(|part| part.parse().map_err(|e| bad("needs", e)))
        .collect()
}

const EVENT_KINDS: [EventKind; 17] = [
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
    EventKind::Opened,
    EventKind::Paused,
    EventKind::Resumed,
    EventKind::Log,
];

pub(crate) fn event_kind_code(kind: EventKind) -> i64 {
    code(&EVENT_KINDS, kind)
}

fn code<T: Copy + PartialEq>(all: &[T], one: T) -> i64 {
    all.iter()
        .position(|x| *x == one)
        .expect("every one is listed") as i64
}

pub(crate) fn event_kind(code: i64) -> Result<EventKind, sqlx::Error> {
    usize::try_from(code)
        .ok()
        .and_then(|i| EVENT_KINDS.get(i).copied())
        .ok_or_else(|| bad("kind", code))
}

pub(crate) const PENDING: i64 = 0;
pub(crate) const LEASED: i64 = 1;
pub(crate) const DONE: i64 = 2;
pub(crate) const DONE_REUSED: i64 = 3;
pub(crate) const DEAD: i64 = 4;

pub(crate) fn mark(byte: u8) -> Result<Mark, sqlx::Error> {
    Ok(match byte {
        0 => Mark::Todo,
        1 => Mark::Done,
        2 => Mark::Reused,
        3 => Mark::Left,
        other => return Err(bad("marks", other)),
    })
}

/// The columns of a range except id, stage, lo, hi, epoch and crashes.
pub(crate) struct StateColumns {
    pub state: i64,
    pub not_before_ms: Option<i64>,
    pub worker: Option<uuid::Uuid>,
    pub incarnation: Option<uuid::Uuid>,
    pub lease_until_ms: Option<i64>,
    pub marks: Option<Vec<u8>>,
}

impl From<&picofarm_catalog::RangeState> for StateColumns {
    fn from(state: &picofarm_catalog::RangeState) -> Self {
        use picofarm_catalog::RangeState;
        let empty = Self {
            state: PENDING,
            not_before_ms: None,
            worker: None,
            incarnation: None,
            lease_until_ms: None,
            marks: None,
        };
        match state {
            RangeState::Pending { not_before_ms } => Self {
                not_before_ms: Some(*not_before_ms),
                ..empty
            },
            RangeState::Leased(lease) => Self {
                state: LEASED,
                worker: Some(lease.worker.uuid()),
                incarnation: Some(lease.incarnation.uuid()),
                lease_until_ms: Some(lease.until_ms),
                marks: Some(lease.marks.iter().map(|m| *m as u8).collect()),
                ..empty
            },
            RangeState::Done { reused } => Self {
                state: if *reused { DONE_REUSED } else { DONE },
                ..empty
            },
            RangeState::Dead => Self {
                state: DEAD,
                ..empty
            },
        }
    }
}

/// Checks that outputs that already existed have the same manifests.
///
/// # Errors
/// A description of the difference.
pub(crate) fn equal_manifests(
    outputs: &[picofarm_catalog::Output],
    there: &[Option<[u8; 32]>],
) -> Result<(), String> {
    for (output, there) in outputs.iter().zip(there) {
        if *there != Some(output.manifest) {
            return Err(format!(
                "task {} of stage {} has another result already",
                output.task, output.stage
            ));
        }
    }
    Ok(())
}

/// The message for a job that cannot become active again.
pub(crate) const LATER_JOB: &str = "another job with the same spec is active or done";
