//! The catalog in Postgres, for several coordinators at once; see the crate's documentation for houses.
//!
//! Transactions are short and touch few rows: a lease is a row, not a task. Rows of nobody's are taken with
//! `SKIP LOCKED`, so that houses do not wait for each other. Who waits for news is woken by NOTIFY, which is sent outside
//! of transactions and at most a few times a second (a NOTIFY in each transaction would put all of them in one queue),
//! and asks once a second anyway.

mod errors;
mod house;
mod jobs;
mod write;

use std::{
    sync::Mutex,
    time::{Duration, Instant},
};

use async_trait::async_trait;
use picofarm_proto::{
    ids::{HouseId, JobId, StageRef, WorkerId},
    model::Event,
};
use sqlx::{
    ConnectOptions, Connection, PgPool,
    migrate::{MigrateError, Migrator},
    pool::PoolConnection,
    postgres::{PgConnectOptions, PgListener, PgPoolOptions, PgRow},
};
use uuid::Uuid;

use crate::{
    Catalog, CatalogError, Changes, Claim, Job, JobRecord, NewEvent, News, Owned, Range,
    RangeState, Settled, Snapshot, Want,
    record::{EventQuery, Holdups, ResultSet, Run, TaskRecord, Timing},
};

crate::sql::queries!(sqlx::PgConnection, super::PgRow);
crate::sql_jobs::job_queries!(sqlx::PgConnection, super::PgRow);

static MIGRATIONS: Migrator = sqlx::migrate!("migrations/postgres");

/// Connections of one coordinator: one writes, the others read.
const CONNECTIONS: u32 = 6;
/// How long a connection may take to come about.
const PATIENCE: Duration = Duration::from_secs(10);
/// A house that has not beaten for so long is lost.
const HOUSE_SECONDS: f64 = 5.0;
/// At most one hint to the others in this time.
const HINTS: Duration = Duration::from_millis(100);
/// The channel of the hints.
const CHANNEL: &str = "picofarm";

/// A catalog in a Postgres database.
pub struct PostgresCatalog {
    /// The database, without its password.
    place: String,
    /// Who we are, for people.
    name: String,
    pool: PgPool,
    /// The present life.
    house: Mutex<Option<HouseId>>,
    keys: tokio::sync::Mutex<write::Keys>,
    hints: tokio::sync::Mutex<Option<PgListener>>,
    hinted: Mutex<Option<Instant>>,
}

impl PostgresCatalog {
    /// Connects to the database at `url` (`postgres://user:password@host/database?sslmode=verify-full`; what it leaves
    /// out is taken from the usual PG variables) and brings its schema up to date. `name` tells people who this is.
    ///
    /// # Errors
    /// [`CatalogError::Server`] when it cannot be reached, [`CatalogError::Newer`] when a later program wrote it.
    pub async fn open(url: &str, name: &str) -> Result<Self, CatalogError> {
        let options: PgConnectOptions = url.parse().map_err(|e| errors::bad_url(url, &e))?;
        let options = options
            .application_name("picofarm")
            .disable_statement_logging()
            .options([
                // A coordinator that hangs in a transaction must not hold up the others.
                ("idle_in_transaction_session_timeout", "30s"),
                ("lock_timeout", "20s"),
                // A server that is gone shall be noticed.
                ("tcp_keepalives_idle", "10"),
            ]);
        let place = errors::place(&options);
        let failed = |e| errors::classify(&place, e);
        let pool = PgPoolOptions::new()
            .max_connections(CONNECTIONS)
            .acquire_timeout(PATIENCE)
            .connect_with(options)
            .await
            .map_err(failed)?;
        migrate(&place, &pool).await?;
        let listener = listen(&pool).await.map_err(failed)?;
        Ok(Self {
            name: name.to_owned(),
            pool,
            house: Mutex::new(None),
            keys: tokio::sync::Mutex::default(),
            hints: tokio::sync::Mutex::new(Some(listener)),
            hinted: Mutex::new(None),
            place,
        })
    }

    fn failed(&self, error: sqlx::Error) -> CatalogError {
        errors::classify(&self.place, error)
    }

    async fn reader(&self) -> Result<PoolConnection<sqlx::Postgres>, CatalogError> {
        self.pool.acquire().await.map_err(|e| self.failed(e))
    }

    fn house(&self) -> Result<HouseId, CatalogError> {
        self.house
            .lock()
            .expect("no panic while locked")
            .ok_or(CatalogError::Fenced)
    }

    /// Runs `work` in one transaction, on behalf of a house that is alive.
    async fn write<T>(
        &self,
        work: impl AsyncFnOnce(&mut write::Desk<'_>) -> Result<T, write::WriteError>,
    ) -> Result<T, CatalogError> {
        let house = self.house()?;
        let mut keys = self.keys.lock().await;
        let result = async {
            let mut connection = self.pool.acquire().await?;
            let mut tx = connection.begin().await?;
            house::fence(&mut tx, house).await?;
            let mut desk = write::Desk {
                c: &mut tx,
                house: house.uuid(),
                keys: &mut keys,
            };
            // Dropping the transaction undoes it.
            let done = work(&mut desk).await?;
            tx.commit().await?;
            Ok(done)
        };
        result.await.map_err(|e| match e {
            write::WriteError::Fenced => CatalogError::Fenced,
            write::WriteError::Conflict(what) => CatalogError::Conflict(what),
            write::WriteError::Sql(e) => self.failed(e),
        })
    }

    /// Wakes the others, unless they have just been woken.
    async fn hint(&self) {
        {
            let mut hinted = self.hinted.lock().expect("no panic while locked");
            if hinted.is_some_and(|at| at.elapsed() < HINTS) {
                return;
            }
            *hinted = Some(Instant::now());
        }
        let sent = sqlx::query("SELECT pg_notify($1, '')")
            .bind(CHANNEL)
            .execute(&self.pool)
            .await;
        if let Err(error) = sent {
            tracing::debug!(%error, "no hint sent; the others ask by themselves");
        }
    }
}

async fn listen(pool: &PgPool) -> Result<PgListener, sqlx::Error> {
    let mut listener = PgListener::connect_with(pool).await?;
    listener.listen(CHANNEL).await?;
    Ok(listener)
}

async fn migrate(place: &str, pool: &PgPool) -> Result<(), CatalogError> {
    let known = MIGRATIONS.iter().map(|m| m.version).max().unwrap_or(0);
    // Several coordinators may start at once: the migrator takes an advisory lock.
    MIGRATIONS.run(pool).await.map_err(|error| match error {
        MigrateError::VersionMissing(found) | MigrateError::VersionTooNew(found, _) => {
            CatalogError::Newer {
                place: place.to_owned(),
                found,
                known,
            }
        }
        MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => {
            errors::classify(place, e)
        }
        other => CatalogError::Unusable {
            place: place.to_owned(),
            what: format!("its schema is not this program's ({other})"),
        },
    })
}

#[async_trait]
impl Catalog for PostgresCatalog {
    async fn load(&self) -> Result<Snapshot, CatalogError> {
        let former = self.house.lock().expect("no panic while locked").take();
        let house = HouseId::from_uuid(Uuid::now_v7());
        let snapshot = async {
            let mut connection = self.pool.acquire().await?;
            let mut tx = connection.begin().await?;
            house::found(&mut tx, house, former, &self.name, HOUSE_SECONDS).await?;
            let ranges = house::take_lost(&mut tx, house).await?;
            let snapshot = Snapshot {
                house,
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
        *self.house.lock().expect("no panic while locked") = Some(house);
        Ok(snapshot)
    }

    async fn beat(&self, workers: u32) -> Result<News, CatalogError> {
        let house = self.house()?;
        let news = async {
            let mut connection = self.pool.acquire().await?;
            let mut tx = connection.begin().await?;
            if !house::renew(&mut tx, house, workers, HOUSE_SECONDS).await? {
                return Ok(None);
            }
            let taken = house::take_lost(&mut tx, house).await?;
            let (houses, workers) = house::count_houses(&mut tx).await?;
            let news = News {
                active: job_query::active(&mut tx).await?,
                busy: house::busy(&mut tx, house).await?,
                free: job_query::free(&mut tx).await?,
                taken: Owned {
                    exceptions: query::exceptions(&mut tx, &taken).await?,
                    ranges: taken,
                },
                leased: Some(house::leased(&mut tx, house).await?),
                houses,
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
        let mut hints = self.hints.lock().await;
        loop {
            if let Some(listener) = hints.as_mut() {
                match listener.recv().await {
                    Ok(_) => return,
                    Err(error) => tracing::debug!(%error, "no more hints; trying again"),
                }
                *hints = None;
            }
            tokio::time::sleep(Duration::from_secs(2)).await;
            *hints = listen(&self.pool).await.ok();
        }
    }

    async fn claim(&self, wants: &[Want]) -> Result<Vec<Claim>, CatalogError> {
        self.write(async |desk| write::claim(desk, wants).await)
            .await
    }

    async fn adopt(&self, worker: WorkerId) -> Result<Owned, CatalogError> {
        self.write(async |desk| {
            let ranges = house::adopt(desk, worker).await?;
            Ok(Owned {
                exceptions: query::exceptions(desk.c, &ranges).await?,
                ranges,
            })
        })
        .await
    }

    async fn commit(&self, changes: Changes) -> Result<Settled, CatalogError> {
        if changes.is_empty() {
            return Ok(Settled::default());
        }
        let settled = self
            .write(async |desk| write::changes(desk, &changes).await)
            .await?;
        let pending = |r: &Range| matches!(r.state, RangeState::Pending { .. });
        if settled != Settled::default() || changes.free.values().any(pending) {
            self.hint().await;
        }
        Ok(settled)
    }

    async fn submit(
        &self,
        job: &Job,
        ranges: &[Range],
        events: &[NewEvent],
    ) -> Result<bool, CatalogError> {
        let new = self
            .write(async |desk| jobs::submit(desk, job, ranges, events).await)
            .await?;
        self.hint().await;
        Ok(new)
    }

    async fn cancel(&self, job: JobId, why: &str, now_ms: i64) -> Result<bool, CatalogError> {
        let cancelled = self
            .write(async |desk| jobs::cancel(desk, job, why, now_ms).await)
            .await?;
        self.hint().await;
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
            .write(async |desk| jobs::pause(desk, job, paused, who, now_ms).await)
            .await?;
        self.hint().await;
        Ok(changed)
    }

    async fn forget(&self, before_ms: i64, most: u32) -> Result<u32, CatalogError> {
        let mut forgotten = 0;
        // One transaction each: they may be long.
        while forgotten < most
            && self
                .write(async |desk| Ok(job_query::forget(desk.c, before_ms).await?))
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
        let retried = self
            .write(async |desk| jobs::retry(desk, job, now_ms).await)
            .await?;
        self.hint().await;
        Ok(retried)
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
        if tasks.is_empty() {
            return Ok(Vec::new());
        }
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
        let house = self.house.lock().expect("no panic while locked").take();
        if let Some(house) = house {
            // What is not given back now, others find when the house is lost.
            if let Ok(mut c) = self.pool.acquire().await
                && let Err(error) = house::leave(&mut c, house).await
            {
                tracing::debug!(%error, "the house was not given up in order");
            }
        }
        // The pool waits for every connection, the listener's too.
        if let Ok(mut hints) = self.hints.try_lock() {
            hints.take();
        }
        self.pool.close().await;
    }
}
