//! The catalog in one SQLite file: one writer behind an actor with group commit, reads on their own connections.

mod apply;
mod errors;
mod read;
mod rows;
mod writer;

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use async_trait::async_trait;
use picofarm_proto::{ids::JobId, model::Event};
use sqlx::{
    ConnectOptions, Connection, SqliteConnection, SqlitePool,
    migrate::{MigrateError, Migrator},
    sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous},
};

use crate::{
    Catalog, CatalogError, Changes,
    lock::CatalogLock,
    record::{EventQuery, ResultSet, Run, Snapshot, Timing},
};

static MIGRATIONS: Migrator = sqlx::migrate!();

/// Read-only connections. Reads are few and short.
const READERS: u32 = 3;

/// A catalog in one SQLite file, for exactly one coordinator.
pub struct SqliteCatalog {
    path: PathBuf,
    writer: writer::Writer,
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
            writer: writer::Writer::start(path.to_owned(), connection),
            readers,
            _lock: lock,
        })
    }

    fn failed(&self) -> impl Fn(sqlx::Error) -> CatalogError + '_ {
        |e| errors::classify(&self.path, e)
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
                    path: path.to_owned(),
                    found,
                    known,
                }
            }
            MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => {
                errors::classify(path, e)
            }
            other => CatalogError::Unusable {
                path: path.to_owned(),
                what: format!("its schema is not this program's ({other})"),
            },
        })
}

#[async_trait]
impl Catalog for SqliteCatalog {
    async fn load(&self) -> Result<Snapshot, CatalogError> {
        read::load(&self.path, &self.readers).await
    }

    async fn commit(&self, changes: Changes) -> Result<(), CatalogError> {
        if changes.is_empty() {
            return Ok(());
        }
        self.writer.commit(changes).await
    }

    async fn output_runs(&self, set: &ResultSet, count: u64) -> Result<Vec<Run>, CatalogError> {
        read::output_runs(&self.readers, set, count)
            .await
            .map_err(self.failed())
    }

    async fn manifests(
        &self,
        tasks: &[(JobId, u64)],
    ) -> Result<Vec<Option<[u8; 32]>>, CatalogError> {
        read::manifests(&self.readers, tasks)
            .await
            .map_err(self.failed())
    }

    async fn timing(&self, set: &ResultSet) -> Result<Timing, CatalogError> {
        read::timing(&self.readers, set)
            .await
            .map_err(self.failed())
    }

    async fn events(&self, query: &EventQuery) -> Result<Vec<Event>, CatalogError> {
        read::events(&self.path, &self.readers, query).await
    }

    async fn close(&self) {
        self.readers.close().await;
        self.writer.close().await;
    }
}
