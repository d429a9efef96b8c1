//! The catalog in one SQLite file, for one coordinator. All writes go through one connection, one transaction at a time:
//! the coordinator's actor puts whatever has arrived meanwhile into the next one, so one fsync serves many messages.
//! Reads have connections of their own.

mod errors;
mod jobs;
mod write;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    time::Duration,
};

use async_trait::async_trait;
use picofarm_proto::{
    ids::{HouseId, JobId, StageRef, WorkerId},
    model::Event,
};
use sqlx::{
    ConnectOptions, Connection, SqliteConnection, SqlitePool,
    migrate::{MigrateError, Migrator},
    pool::PoolConnection,
    sqlite::{
        SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteRow, SqliteSynchronous,
    },
};
use tokio::sync::Mutex;
use uuid::Uuid;

use crate::{
    Catalog, CatalogError, Changes, Claim, Job, JobRecord, NewEvent, News, Owned, Range, Settled,
    Snapshot, Want,
    lock::CatalogLock,
    record::{EventQuery, Holdups, ResultSet, Run, TaskRecord, Timing},
};

crate::sql::queries!(sqlx::SqliteConnection, super::SqliteRow);
crate::sql_jobs::job_queries!(sqlx::SqliteConnection, super::SqliteRow);

static MIGRATIONS: Migrator = sqlx::migrate!("migrations/sqlite");

/// Read-only connections. Reads are few and short.
const READERS: u32 = 3;

/// A catalog in one SQLite file, for exactly one coordinator.
pub struct SqliteCatalog {
    path: PathBuf,
    /// `None` once closed.
    writer: Mutex<Option<write::Writer>>,
    readers: SqlitePool,
    // Last, so that it is dropped after the connections.
    _lock: CatalogLock,
}

impl SqliteCatalog {
    /// Opens the catalog at `path`, creating the file and its folder, and brings its schema up to date.
    /// `holder` tells people who has it, e.g. `pid 17, 127.0.0.1:7070`.
    ///
    /// # Errors
    /// [`CatalogError::Held`] when another coordinator uses it, [`CatalogError::Newer`] when a later program
    /// wrote it, others when the file cannot be used.
    pub async fn open(path: &Path, holder: &str) -> Result<Self, CatalogError> {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)
                .map_err(|e| CatalogError::file(path, "creating its folder", e))?;
        }
        let lock = CatalogLock::take(path, holder)?;
        let options = SqliteConnectOptions::new()
            .filename(path)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(Duration::from_secs(10))
            .disable_statement_logging();
        let failed = |e| errors::classify(path, e);
        let mut connection =
            SqliteConnection::connect_with(&options.clone().create_if_missing(true))
                .await
                .map_err(failed)?;
        migrate(path, &mut connection).await?;
        let readers = SqlitePoolOptions::new()
            .max_connections(READERS)
            .connect_with(options.read_only(true))
            .await
            .map_err(failed)?;
        Ok(Self {
            path: path.to_owned(),
            writer: Mutex::new(Some(write::Writer::new(connection))),
            readers,
            _lock: lock,
        })
    }

    fn failed(&self, error: sqlx::Error) -> CatalogError {
        errors::classify(&self.path, error)
    }

    async fn reader(&self) -> Result<PoolConnection<sqlx::Sqlite>, CatalogError> {
        self.readers.acquire().await.map_err(|e| self.failed(e))
    }

    /// Runs `work` in one transaction.
    async fn write<T>(
        &self,
        work: impl AsyncFnOnce(&mut SqliteConnection, &mut write::Keys) -> Result<T, write::WriteError>,
    ) -> Result<T, CatalogError> {
        let mut writer = self.writer.lock().await;
        let writer = writer.as_mut().ok_or(CatalogError::Closed)?;
        writer.transaction(work).await.map_err(|e| match e {
            write::WriteError::Conflict(what) => CatalogError::Conflict(what),
            write::WriteError::Sql(e) => self.failed(e),
        })
    }
}

async fn migrate(path: &Path, connection: &mut SqliteConnection) -> Result<(), CatalogError> {
    let known = MIGRATIONS.iter().map(|m| m.version).max().unwrap_or(0);
    MIGRATIONS
        .run_direct(None, connection, false)
        .await
        .map_err(|error| match error {
            MigrateError::VersionMissing(found) | MigrateError::VersionTooNew(found, _) => {
                CatalogError::Newer {
                    place: path.display().to_string(),
                    found,
                    known,
                }
            }
            MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => {
                errors::classify(path, e)
            }
            other => CatalogError::Unusable {
                place: path.display().to_string(),
                what: format!("its schema is not this program's ({other})"),
            },
        })
}

#[async_trait]
impl Catalog for SqliteCatalog {
    async fn load(&self) -> Result<Snapshot, CatalogError> {
        let mut c = self.reader().await?;
        let read = async {
            // One transaction, so that all tables are of one moment.
            let mut tx = c.begin().await?;
            let jobs = job_query::active_jobs(&mut tx).await?;
            let ranges = write::owned(&mut tx).await?;
            let exceptions = query::exceptions(&mut tx, &ranges).await?;
            let workers = query::workers(&mut tx).await?;
            tx.rollback().await?;
            Ok(Snapshot {
                house: HouseId::from_uuid(Uuid::now_v7()),
                jobs,
                owned: Owned { ranges, exceptions },
                workers,
            })
        };
        read.await.map_err(|e| self.failed(e))
    }

    async fn beat(&self, workers: u32) -> Result<News, CatalogError> {
        let mut c = self.reader().await?;
        let read = async {
            Ok(News {
                active: job_query::active(&mut c).await?,
                busy: BTreeMap::new(),
                free: job_query::free(&mut c).await?,
                taken: Owned::default(),
                leased: None,
                houses: 1,
                workers,
            })
        };
        read.await.map_err(|e| self.failed(e))
    }

    async fn changed(&self) {
        std::future::pending().await
    }

    async fn claim(&self, wants: &[Want]) -> Result<Vec<Claim>, CatalogError> {
        self.write(async |c, keys| write::claim(c, keys, wants).await)
            .await
    }

    async fn adopt(&self, _: WorkerId) -> Result<Owned, CatalogError> {
        // Every lease is this house's already.
        Ok(Owned::default())
    }

    async fn commit(&self, changes: Changes) -> Result<Settled, CatalogError> {
        if changes.is_empty() {
            return Ok(Settled::default());
        }
        self.write(async |c, keys| write::changes(c, keys, &changes).await)
            .await
    }

    async fn submit(
        &self,
        job: &Job,
        ranges: &[Range],
        events: &[NewEvent],
    ) -> Result<bool, CatalogError> {
        self.write(async |c, keys| jobs::submit(c, keys, job, ranges, events).await)
            .await
    }

    async fn cancel(&self, job: JobId, why: &str, now_ms: i64) -> Result<bool, CatalogError> {
        self.write(async |c, keys| jobs::cancel(c, keys, job, why, now_ms).await)
            .await
    }

    async fn pause(
        &self,
        job: JobId,
        paused: bool,
        who: &str,
        now_ms: i64,
    ) -> Result<bool, CatalogError> {
        self.write(async |c, keys| jobs::pause(c, keys, job, paused, who, now_ms).await)
            .await
    }

    async fn forget(&self, before_ms: i64, most: u32) -> Result<u32, CatalogError> {
        let mut forgotten = 0;
        // One transaction each: they may be long.
        while forgotten < most
            && self
                .write(async |c, _| Ok(job_query::forget(c, before_ms).await?))
                .await?
        {
            forgotten += 1;
        }
        Ok(forgotten)
    }

    async fn jobs_of(&self, user: &str) -> Result<u64, CatalogError> {
        let mut c = self.reader().await?;
        job_query::jobs_of(&mut c, user)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn retry(&self, job: JobId, now_ms: i64) -> Result<u64, CatalogError> {
        self.write(async |c, keys| jobs::retry(c, keys, job, now_ms).await)
            .await
    }

    async fn job(&self, id: JobId) -> Result<Option<JobRecord>, CatalogError> {
        let mut c = self.reader().await?;
        let mut found = job_query::jobs(&mut c, Some(id))
            .await
            .map_err(|e| self.failed(e))?;
        Ok(found.pop())
    }

    async fn jobs(&self) -> Result<Vec<JobRecord>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::jobs(&mut c, None)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn job_with(&self, spec_hash: &str) -> Result<Option<Job>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::job_with(&mut c, spec_hash)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn recent(&self, most: u32) -> Result<Vec<Job>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::recent(&mut c, most)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn jobs_at(&self, store: &str, dataset: &str) -> Result<Vec<Job>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::jobs_at(&mut c, store, dataset)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn output_runs(&self, set: &ResultSet, count: u64) -> Result<Vec<Run>, CatalogError> {
        let mut c = self.reader().await?;
        query::output_runs(&mut c, set, count)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn manifests(
        &self,
        tasks: &[(StageRef, u64)],
    ) -> Result<Vec<Option<[u8; 32]>>, CatalogError> {
        let mut c = self.reader().await?;
        write::manifests(&mut c, tasks)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn timing(&self, set: &ResultSet) -> Result<Timing, CatalogError> {
        let mut c = self.reader().await?;
        job_query::timing(&mut c, set)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn holdups(&self, job: JobId, now_ms: i64) -> Result<Holdups, CatalogError> {
        let mut c = self.reader().await?;
        job_query::holdups(&mut c, job, now_ms)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn task(&self, stage: StageRef, task: u64) -> Result<TaskRecord, CatalogError> {
        let mut c = self.reader().await?;
        query::task(&mut c, stage, task)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn events(&self, query: &EventQuery) -> Result<Vec<Event>, CatalogError> {
        let mut c = self.reader().await?;
        query::events(&mut c, query)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn close(&self) {
        self.readers.close().await;
        if let Some(writer) = self.writer.lock().await.take() {
            writer.close().await;
        }
    }
}
