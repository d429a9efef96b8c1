//! The catalog in one SQLite file, for one coordinator. All writes go through one connection, one
//! transaction at a time. The coordinator's actor collects all changes that arrive in the meantime
//! into the next transaction, so one fsync serves many messages. Reads have their own connections.

mod backup;
mod errors;
mod files;
mod jobs;
mod open;
mod rights;
mod rows;
mod write;
mod writer;

use std::{collections::BTreeMap, path::PathBuf};

use async_trait::async_trait;
use picofarm_proto::{
    ids::{InstanceId, JobId, StageRef, WorkerId},
    messages::{Event, JobState, TaskCounts, UsageRow},
};
use sqlx::{Connection, SqlitePool, sqlite::SqliteRow};
use tokio::sync::Mutex;
use uuid::Uuid;

use crate::lock::CatalogLock;
pub use backup::{Backup, BackupError, backup, restore};
use picofarm_catalog::{
    Catalog, CatalogError, Changes, Claim, EventQuery, Forgotten, Gone, Holdups, Job, JobQuery,
    JobRecord, News, Outcome, Owned, Page, Recorded, ResultSet, Run, Settled, Sight, Snapshot,
    Specs, Submission, TaskRecord, Timing, UsageQuery, Want,
};

crate::sql::queries!(sqlx::SqliteConnection, super::SqliteRow);
crate::sql_listing::listing_queries!(sqlx::Sqlite, sqlx::SqliteConnection, super::SqliteRow, "");
crate::sql_stages::stage_queries!(sqlx::SqliteConnection, super::SqliteRow);
crate::sql_jobs::job_queries!(sqlx::SqliteConnection, super::SqliteRow);
crate::sql_rights::rights_queries!(sqlx::SqliteConnection, super::SqliteRow);
crate::sql_usage::usage_queries!(sqlx::SqliteConnection, super::SqliteRow);

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

#[async_trait]
impl Catalog for SqliteCatalog {
    async fn load(&self) -> Result<Snapshot, CatalogError> {
        let instance = InstanceId::from_uuid(Uuid::now_v7());
        // A life begins with a write, so that on a full disk the coordinator does not start, make
        // promises and then fail.
        self.write(async |c, _| Ok(write::record_instance(c, instance).await?))
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

    async fn usage(&self, query: &UsageQuery) -> Result<Vec<UsageRow>, CatalogError> {
        let mut c = self.reader().await?;
        usage_query::usage(&mut c, query)
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
