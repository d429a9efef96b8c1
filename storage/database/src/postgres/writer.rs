//! The write transaction of an instance, and the integer keys of stages in it.

use std::collections::HashMap;

use picofarm_catalog::Range;
use picofarm_proto::ids::{JobId, StageRef};
use sqlx::{PgConnection, postgres::PgRow};
use uuid::Uuid;

use super::query;

/// The columns of a range, with the names of its job and stage.
pub(super) const RANGE: &str = "task_range.*, (SELECT id FROM job JOIN stage ON stage.job = job.key WHERE stage.key = task_range.stage) AS job_id, \
                     (SELECT ordinal FROM stage WHERE stage.key = task_range.stage) AS ordinal";

/// The reason why nothing was written.
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

pub(super) type Result<T> = std::result::Result<T, WriteError>;
pub(super) type Sql<T> = std::result::Result<T, sqlx::Error>;

/// A cache of the integer keys of stages, which never change.
#[derive(Default)]
pub(super) struct Keys(HashMap<StageRef, StageKeys>);

#[derive(Clone, Copy)]
pub(super) struct StageKeys {
    pub stage: i64,
    pub job: i64,
    pub result_set: i64,
}

/// A write transaction of an instance that has passed the fence.
pub(super) struct Writer<'a> {
    pub c: &'a mut PgConnection,
    pub instance: Uuid,
    pub keys: &'a mut Keys,
}

impl Writer<'_> {
    pub(super) async fn keys(&mut self, stage: StageRef) -> Result<StageKeys> {
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

    pub(super) async fn job(&mut self, job: JobId) -> Result<i64> {
        Ok(self.keys(StageRef { job, stage: 0 }).await?.job)
    }
}

/// Parses rows of [`RANGE`] as ranges.
pub(super) fn ranges(rows: &[PgRow]) -> Sql<Vec<Range>> {
    rows.iter().map(query::range).collect()
}
