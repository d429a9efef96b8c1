//! The write connection, its transactions, and the integer keys of stages.

use std::collections::HashMap;

use picofarm_proto::ids::{JobId, StageRef};
use sqlx::{Connection, SqliteConnection, sqlite::SqliteConnectOptions};

use super::files::Files;

/// The reason why nothing was written.
pub(super) enum WriteError {
    Conflict(String),
    /// The open files are no longer the database at the path.
    Lost(String),
    Sql(sqlx::Error),
}

impl From<sqlx::Error> for WriteError {
    fn from(e: sqlx::Error) -> Self {
        Self::Sql(e)
    }
}

pub(super) type Result<T> = std::result::Result<T, WriteError>;

/// The write connection.
pub(super) struct Writer {
    options: SqliteConnectOptions,
    /// `None` after a transaction that did not end properly.
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

    /// Checks that the open files are still those at the path.
    pub(super) fn check(&self) -> Result<()> {
        self.files.check().map_err(WriteError::Lost)
    }

    /// Runs `work` in a transaction, which is committed if `keep` is set and otherwise rolled back.
    ///
    /// If a transaction does not end properly (no space for the commit, nor for the rollback), its
    /// connection considers it open forever. In that case the connection is dropped, and the next
    /// transaction opens a new one.
    pub(super) async fn transaction<T>(
        &mut self,
        keep: bool,
        work: impl AsyncFnOnce(&mut SqliteConnection, &mut Keys) -> Result<T>,
    ) -> Result<T> {
        self.check()?;
        // The connection is taken out, so that a cancelled call leaves no open transaction.
        let mut connection = match self.connection.take() {
            Some(connection) => connection,
            None => SqliteConnection::connect_with(&self.options).await?,
        };
        let (done, ended) = run(&mut connection, &mut self.keys, keep, work).await;
        if done.is_err() {
            // The cache may contain keys of rows that no longer exist.
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
        // A write into a file that has left its path does not count.
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

/// Returns the result of the work, and the result of ending its transaction.
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

/// A cache of the integer keys of stages, which never change.
#[derive(Default)]
pub(super) struct Keys(HashMap<StageRef, StageKeys>);

#[derive(Clone, Copy)]
pub(super) struct StageKeys {
    pub stage: i64,
    pub job: i64,
    pub result_set: i64,
}

impl Keys {
    pub(super) async fn stage(
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
        Ok(self.stage(c, StageRef { job, stage: 0 }).await?.job)
    }
}
