//! The catalog in one SQLite file, for one coordinator. All writes go through one connection, one
//! transaction at a time. The coordinator's actor collects all changes that arrive in the meantime
//! into the next transaction, so one fsync serves many messages. Reads have their own connections.

mod errors;
mod files;
mod jobs;
mod rights;
mod rows;
mod write;
mod writer;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    time::Duration,
};

use async_trait::async_trait;
use picofarm_proto::{
    ids::{InstanceId, JobId, StageRef, WorkerId},
    model::{Event, JobState, TaskCounts},
};
use sqlx::{
    ConnectOptions, Connection, SqliteConnection, SqlitePool,
    pool::PoolConnection,
    sqlite::{
        SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteRow, SqliteSynchronous,
    },
};
use tokio::sync::Mutex;
use uuid::Uuid;

use crate::{lock::CatalogLock, migrations};
use picofarm_catalog::{
    Catalog, CatalogError, Changes, Claim, EventQuery, Forgotten, Gone, Holdups, Job, JobQuery,
    JobRecord, News, Outcome, Owned, Page, Recorded, ResultSet, Run, Settled, Sight, Snapshot,
    Specs, Submission, TaskRecord, Timing, Want,
};

crate::sql::queries!(sqlx::SqliteConnection, super::SqliteRow);
crate::sql_listing::listing_queries!(sqlx::Sqlite, sqlx::SqliteConnection, super::SqliteRow, "");
crate::sql_jobs::job_queries!(sqlx::SqliteConnection, super::SqliteRow);
crate::sql_rights::rights_queries!(sqlx::SqliteConnection, super::SqliteRow);

/// The number of read-only connections. It exceeds the coordinator's concurrent heavy reads, so
/// that short reads need not wait.
const READERS: u32 = 8;

/// A catalog in one SQLite file, for exactly one coordinator.
pub struct SqliteCatalog {
    path: PathBuf,
    /// `None` once closed.
    writer: Mutex<Option<writer::Writer>>,
    readers: SqlitePool,
    /// Checked by each reader, because it opens the file by its path and must not open another
    /// file.
    files: files::Files,
    /// Held until the catalog is closed, even if others still have a reference to it. It is the
    /// last field, so that it is dropped after the connections.
    lock: std::sync::Mutex<Option<CatalogLock>>,
}

impl SqliteCatalog {
    /// Opens the catalog at `path`, creating the file and its folder, and upgrades its schema.
    /// `holder` describes this process to people, e.g. `pid 17, 127.0.0.1:7070`.
    ///
    /// # Errors
    /// [`CatalogError::Held`] if another coordinator uses it, [`CatalogError::Newer`] if a later
    /// version of the program wrote it, and other errors if the file cannot be used.
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
            // A full temporary folder must not cause failures, and the sorted data is small.
            .pragma("temp_store", "MEMORY")
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
            .connect_with(options.clone().read_only(true))
            .await
            .map_err(failed)?;
        let files = || {
            files::Files::of(path).map_err(|what| CatalogError::Lost {
                path: path.to_owned(),
                what,
            })
        };
        Ok(Self {
            path: path.to_owned(),
            writer: Mutex::new(Some(writer::Writer::new(connection, options, files()?))),
            readers,
            files: files()?,
            lock: std::sync::Mutex::new(Some(lock)),
        })
    }

    fn failed(&self, error: sqlx::Error) -> CatalogError {
        errors::classify(&self.path, error)
    }

    async fn reader(&self) -> Result<PoolConnection<sqlx::Sqlite>, CatalogError> {
        self.files.check().map_err(|what| CatalogError::Lost {
            path: self.path.clone(),
            what,
        })?;
        self.readers.acquire().await.map_err(|e| self.failed(e))
    }

    fn refused(&self, error: writer::WriteError) -> CatalogError {
        match error {
            writer::WriteError::Conflict(what) => CatalogError::Conflict(what),
            writer::WriteError::Lost(what) => CatalogError::Lost {
                path: self.path.clone(),
                what,
            },
            writer::WriteError::Sql(e) => self.failed(e),
        }
    }

    /// Runs `work` in one transaction.
    async fn write<T>(
        &self,
        work: impl AsyncFnOnce(
            &mut SqliteConnection,
            &mut writer::Keys,
        ) -> Result<T, writer::WriteError>,
    ) -> Result<T, CatalogError> {
        self.transaction(true, work).await
    }

    /// Like [`Self::write`], but rolls back if `keep` is false.
    async fn transaction<T>(
        &self,
        keep: bool,
        work: impl AsyncFnOnce(
            &mut SqliteConnection,
            &mut writer::Keys,
        ) -> Result<T, writer::WriteError>,
    ) -> Result<T, CatalogError> {
        let mut writer = self.writer.lock().await;
        let writer = writer.as_mut().ok_or(CatalogError::Closed)?;
        let done = writer.transaction(keep, work).await;
        done.map_err(|e| self.refused(e))
    }
}

async fn migrate(path: &Path, connection: &mut SqliteConnection) -> Result<(), CatalogError> {
    upgrade_former(connection)
        .await
        .map_err(|e| errors::classify(path, e))?;
    migrations::SQLITE
        .run_direct(None, connection, false)
        .await
        .map_err(|error| {
            let place = path.display().to_string();
            migrations::failed(place, &migrations::SQLITE, error, |e| {
                errors::classify(path, e)
            })
        })
}

/// Upgrades a catalog with a first step from before steps were append-only.
async fn upgrade_former(connection: &mut SqliteConnection) -> Result<(), sqlx::Error> {
    let mut tx = connection.begin().await?;
    let tables: i64 =
        sqlx::query_scalar("SELECT count(*) FROM sqlite_master WHERE name = '_sqlx_migrations'")
            .fetch_one(&mut *tx)
            .await?;
    if tables == 0 {
        return tx.rollback().await;
    }
    let checksum: Option<Vec<u8>> =
        sqlx::query_scalar("SELECT checksum FROM _sqlx_migrations WHERE version = 1")
            .fetch_optional(&mut *tx)
            .await?;
    let former = &migrations::SQLITE_FORMER;
    if !checksum.is_some_and(|checksum| former.matches(&checksum)) {
        return tx.rollback().await;
    }
    sqlx::raw_sql(former.upgrade).execute(&mut *tx).await?;
    sqlx::query("UPDATE _sqlx_migrations SET checksum = ? WHERE version = 1")
        .bind(migrations::first_checksum(&migrations::SQLITE))
        .execute(&mut *tx)
        .await?;
    tx.commit().await
}

#[async_trait]
impl Catalog for SqliteCatalog {
    async fn load(&self) -> Result<Snapshot, CatalogError> {
        let instance = InstanceId::from_uuid(Uuid::now_v7());
        // A life begins with a write, so that on a full disk the coordinator does not start, make
        // promises and then fail.
        self.write(async |c, _| Ok(write::found(c, instance).await?))
            .await?;
        let mut c = self.reader().await?;
        let read = async {
            // One transaction gives a consistent state of all tables.
            let mut tx = c.begin().await?;
            let jobs = job_query::active_jobs(&mut tx).await?;
            let ranges = write::owned(&mut tx).await?;
            let exceptions = query::exceptions(&mut tx, &ranges).await?;
            let workers = query::workers(&mut tx).await?;
            tx.rollback().await?;
            Ok(Snapshot {
                instance,
                jobs,
                owned: Owned { ranges, exceptions },
                workers,
            })
        };
        read.await.map_err(|e| self.failed(e))
    }

    async fn beat(&self, workers: u32, now_ms: i64) -> Result<News, CatalogError> {
        {
            let writer = self.writer.lock().await;
            let writer = writer.as_ref().ok_or(CatalogError::Closed)?;
            writer.check().map_err(|e| self.refused(e))?;
        }
        let mut c = self.reader().await?;
        let read = async {
            Ok(News {
                active: job_query::active(&mut c).await?,
                busy: BTreeMap::new(),
                shared: BTreeMap::new(),
                free: job_query::free(&mut c, now_ms).await?,
                taken: Owned::default(),
                leased: None,
                instances: 1,
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
        // This instance already owns every lease.
        Ok(Owned::default())
    }

    async fn commit(&self, changes: &Changes) -> Result<Settled, CatalogError> {
        if changes.is_empty() {
            return Ok(Settled::default());
        }
        self.write(async |c, keys| write::changes(c, keys, changes).await)
            .await
    }

    async fn trial(&self, changes: &Changes) -> Result<Option<String>, CatalogError> {
        picofarm_catalog::verdict(
            self.transaction(false, async |c, keys| {
                rows::write_rows(c, keys, changes).await
            })
            .await,
        )
    }

    async fn record(&self, submission: &Submission<'_>) -> Result<Outcome, CatalogError> {
        // This happens before the transaction, because a large spec takes a while.
        let spec = serde_json::to_string(&*submission.job.spec).expect("a spec is plain data");
        self.write(async |c, keys| jobs::record(c, keys, submission, &spec).await)
            .await
    }

    async fn recorded(&self, set: &ResultSet, count: u64) -> Result<Vec<Recorded>, CatalogError> {
        let mut c = self.reader().await?;
        query::recorded(&mut c, set, count)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn mark_checked(
        &self,
        set: &ResultSet,
        outputs: &[Recorded],
    ) -> Result<(), CatalogError> {
        // The transactions are short, because others wait for them.
        for some in outputs.chunks(1_000) {
            self.write(async |c, _| {
                for output in some {
                    query::mark_checked(c, set, output).await?;
                }
                Ok(())
            })
            .await?;
        }
        Ok(())
    }

    async fn drop_output(&self, gone: &Gone) -> Result<bool, CatalogError> {
        self.write(async |c, _| Ok(query::drop_output(c, gone).await?))
            .await
    }

    async fn state(&self, job: JobId) -> Result<Option<JobState>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::state(&mut c, job)
            .await
            .map_err(|e| self.failed(e))
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

    async fn forget(&self, before_ms: i64) -> Result<Forgotten, CatalogError> {
        self.write(async |c, keys| {
            // The database may reuse the keys of deleted rows.
            *keys = writer::Keys::default();
            Ok(listing_query::forget(c, before_ms).await?)
        })
        .await
    }

    async fn unfinished_jobs(&self, user: &str) -> Result<u64, CatalogError> {
        let mut c = self.reader().await?;
        job_query::unfinished_jobs(&mut c, user)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn retry(&self, job: JobId, now_ms: i64) -> Result<u64, CatalogError> {
        self.write(async |c, keys| jobs::retry(c, keys, job, now_ms).await)
            .await
    }

    async fn job(&self, id: JobId) -> Result<Option<JobRecord>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::record(&mut c, id)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn try_room(&self) -> Result<(), CatalogError> {
        self.write(async |c, _| Ok(write::try_room(c).await?)).await
    }

    async fn spec_bytes(&self, specs: Specs<'_>) -> Result<u64, CatalogError> {
        let mut c = self.reader().await?;
        job_query::spec_bytes(&mut c, specs)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn active_tasks(&self) -> Result<TaskCounts, CatalogError> {
        let mut c = self.reader().await?;
        listing_query::active_tasks(&mut c)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn page(&self, query: &JobQuery) -> Result<Page, CatalogError> {
        let mut c = self.reader().await?;
        listing_query::page(&mut c, query)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn job_with(&self, spec_hash: &str) -> Result<Option<Job>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::job_with(&mut c, spec_hash)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn recent(&self, most: u32, sight: &Sight) -> Result<Vec<Job>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::recent(&mut c, most, sight)
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
        rows::manifests(&mut c, tasks)
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
        self.lock.lock().expect("no panic while locked").take();
    }
}
