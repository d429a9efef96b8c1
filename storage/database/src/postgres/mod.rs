//! The catalog in Postgres, for several concurrent coordinators; see the crate's documentation for
//! instances.
//!
//! Transactions are short and touch few rows, because a lease is one row for many tasks. Unowned
//! rows are taken with `SKIP LOCKED`, so that instances do not wait for each other. Instances that
//! wait for changes are woken by NOTIFY, and also poll once a second. NOTIFY is sent outside of
//! transactions and at most a few times a second, because a NOTIFY in each transaction would put
//! all of them into one queue.

mod errors;
mod hints;
mod instance;
mod jobs;
mod migrate;
mod open;
mod rights;
mod rows;
mod write;
mod writer;

use std::{sync::Mutex, time::Duration};

use async_trait::async_trait;
use picofarm_proto::{
    ids::{InstanceId, JobId, StageRef, WorkerId},
    messages::{Event, JobState, TaskCounts, UsageRow},
};
use sqlx::{Connection, PgPool, postgres::PgRow};
use uuid::Uuid;

use picofarm_catalog::{
    Catalog, CatalogError, Changes, Claim, EventQuery, Forgotten, Gone, Holdups, Job, JobQuery,
    JobRecord, News, Outcome, Owned, Page, Range, RangeState, Recorded, ResultSet, Run, Settled,
    Sight, Snapshot, Specs, Submission, TaskRecord, Timing, UsageQuery, Want,
};

use hints::Hints;

crate::sql::queries!(sqlx::PgConnection, super::PgRow);
crate::sql_listing::listing_queries!(
    sqlx::Postgres,
    sqlx::PgConnection,
    super::PgRow,
    " FOR UPDATE OF result_set SKIP LOCKED"
);
crate::sql_stages::stage_queries!(sqlx::PgConnection, super::PgRow);
crate::sql_jobs::job_queries!(sqlx::PgConnection, super::PgRow);
crate::sql_rights::rights_queries!(sqlx::PgConnection, super::PgRow);
crate::sql_usage::usage_queries!(sqlx::PgConnection, super::PgRow);

/// Connections of one coordinator: one receives hints, two write, and the others read. Their number
/// exceeds the coordinator's concurrent heavy reads.
const CONNECTIONS: u32 = 10;
/// Timeout for establishing a connection.
const PATIENCE: Duration = Duration::from_secs(10);
/// An instance that has not beaten for this time is lost.
const INSTANCE_SECONDS: f64 = 5.0;

/// A catalog in a Postgres database.
pub struct PostgresCatalog {
    /// The database, without its password.
    place: String,
    /// The name of this coordinator, for people.
    name: String,
    pool: PgPool,
    /// The current instance.
    instance: Mutex<Option<InstanceId>>,
    keys: tokio::sync::Mutex<writer::Keys>,
    hints: Hints,
}

#[async_trait]
impl Catalog for PostgresCatalog {
    async fn load(&self) -> Result<Snapshot, CatalogError> {
        let former = self.instance.lock().expect("no panic while locked").take();
        let instance = InstanceId::from_uuid(Uuid::now_v7());
        let snapshot = async {
            let mut connection = self.pool.acquire().await?;
            let mut tx = connection.begin().await?;
            instance::try_room(&mut tx).await?;
            instance::create_instance(&mut tx, instance, former, &self.name, INSTANCE_SECONDS)
                .await?;
            let ranges = instance::take_lost(&mut tx, instance).await?;
            let snapshot = Snapshot {
                instance,
                jobs: job_query::active_jobs(&mut tx).await?,
                owned: Owned {
                    exceptions: query::exceptions(&mut tx, &ranges).await?,
                    ranges,
                },
                workers: query::workers(&mut tx).await?,
            };
            tx.commit().await?;
            Ok(snapshot)
        };
        let snapshot = snapshot.await.map_err(|e| self.failed(e))?;
        *self.instance.lock().expect("no panic while locked") = Some(instance);
        Ok(snapshot)
    }

    async fn beat(&self, workers: u32, now_ms: i64) -> Result<News, CatalogError> {
        let instance = self.instance()?;
        let news = async {
            let mut connection = self.pool.acquire().await?;
            let mut tx = connection.begin().await?;
            if !instance::renew(&mut tx, instance, workers, INSTANCE_SECONDS).await? {
                return Ok(None);
            }
            let taken = instance::take_lost(&mut tx, instance).await?;
            let (instances, workers) = instance::count_instances(&mut tx).await?;
            let news = News {
                active: job_query::active(&mut tx).await?,
                busy: instance::busy(&mut tx, instance).await?,
                shared: instance::shared(&mut tx, instance).await?,
                free: job_query::free(&mut tx, now_ms).await?,
                taken: Owned {
                    exceptions: query::exceptions(&mut tx, &taken).await?,
                    ranges: taken,
                },
                leased: Some(instance::leased(&mut tx, instance).await?),
                instances,
                workers,
            };
            tx.commit().await?;
            Ok(Some(news))
        };
        news.await
            .map_err(|e| self.failed(e))?
            .ok_or(CatalogError::Fenced)
    }

    async fn changed(&self) {
        self.hints.heard().await;
    }

    async fn claim(&self, wants: &[Want]) -> Result<Vec<Claim>, CatalogError> {
        self.write(async |writer| write::claim(writer, wants).await)
            .await
    }

    async fn adopt(&self, worker: WorkerId) -> Result<Owned, CatalogError> {
        self.write(async |writer| {
            let ranges = instance::adopt(writer, worker).await?;
            Ok(Owned {
                exceptions: query::exceptions(writer.c, &ranges).await?,
                ranges,
            })
        })
        .await
    }

    async fn commit(&self, changes: &Changes) -> Result<Settled, CatalogError> {
        if changes.is_empty() {
            return Ok(Settled::default());
        }
        let settled = self
            .write(async |writer| write::changes(writer, changes).await)
            .await?;
        let pending = |r: &Range| matches!(r.state, RangeState::Pending { .. });
        if settled != Settled::default() || changes.free.values().any(pending) {
            self.hints.give().await;
        }
        Ok(settled)
    }

    async fn trial(&self, changes: &Changes) -> Result<Option<String>, CatalogError> {
        picofarm_catalog::verdict(
            self.transaction(false, async |writer| {
                rows::write_rows(writer, changes).await
            })
            .await,
        )
    }

    async fn record(&self, submission: &Submission<'_>) -> Result<Outcome, CatalogError> {
        // This happens before the transaction, because a large spec takes a while.
        let spec = serde_json::to_string(&*submission.job.spec).expect("a spec is plain data");
        let outcome = self
            .write(async |writer| jobs::record(writer, submission, &spec).await)
            .await?;
        self.hints.give().await;
        Ok(outcome)
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
            self.write(async |writer| {
                for output in some {
                    query::mark_checked(writer.c, set, output).await?;
                }
                Ok(())
            })
            .await?;
        }
        Ok(())
    }

    async fn drop_output(&self, gone: &Gone) -> Result<bool, CatalogError> {
        self.write(async |writer| Ok(query::drop_output(writer.c, gone).await?))
            .await
    }

    async fn state(&self, job: JobId) -> Result<Option<JobState>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::state(&mut c, job)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn cancel(&self, job: JobId, why: &str, now_ms: i64) -> Result<bool, CatalogError> {
        let cancelled = self
            .write(async |writer| jobs::cancel(writer, job, why, now_ms).await)
            .await?;
        self.hints.give().await;
        Ok(cancelled)
    }

    async fn pause(
        &self,
        job: JobId,
        paused: bool,
        who: &str,
        now_ms: i64,
    ) -> Result<bool, CatalogError> {
        let changed = self
            .write(async |writer| jobs::pause(writer, job, paused, who, now_ms).await)
            .await?;
        self.hints.give().await;
        Ok(changed)
    }

    async fn forget(&self, before_ms: i64) -> Result<Forgotten, CatalogError> {
        self.write(async |writer| {
            *writer.keys = writer::Keys::default();
            Ok(listing_query::forget(writer.c, before_ms).await?)
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
        let retried = self
            .write(async |writer| jobs::retry(writer, job, now_ms).await)
            .await?;
        self.hints.give().await;
        Ok(retried)
    }

    async fn job(&self, id: JobId) -> Result<Option<JobRecord>, CatalogError> {
        let mut c = self.reader().await?;
        job_query::record(&mut c, id)
            .await
            .map_err(|e| self.failed(e))
    }

    async fn try_room(&self) -> Result<(), CatalogError> {
        let mut connection = self.reader().await?;
        let tried = async {
            let mut tx = connection.begin().await?;
            instance::try_room(&mut tx).await?;
            tx.rollback().await
        };
        tried.await.map_err(|e| self.failed(e))
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
        if tasks.is_empty() {
            return Ok(Vec::new());
        }
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
        let instance = self.instance.lock().expect("no panic while locked").take();
        if let Some(instance) = instance {
            // If a range is not released now, others take it when the instance is lost.
            if let Ok(mut c) = self.pool.acquire().await
                && let Err(error) = instance::leave(&mut c, instance).await
            {
                tracing::debug!(%error, "the instance was not given up in order");
            }
        }
        // The pool waits for every connection, including the listener's.
        self.hints.end();
        self.pool.close().await;
    }
}
