//! Opens a SQLite catalog, and runs its reads and transactions.

use std::{path::Path, time::Duration};

use sqlx::{
    ConnectOptions, Connection, SqliteConnection,
    pool::PoolConnection,
    sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous},
};
use tokio::sync::Mutex;

use super::{READERS, SqliteCatalog, errors, files, writer};
use crate::{lock::CatalogLock, migrations};
use picofarm_catalog::CatalogError;

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
            files::Files::open_at(path).map_err(|what| CatalogError::Lost {
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

    pub(super) fn failed(&self, error: sqlx::Error) -> CatalogError {
        errors::classify(&self.path, error)
    }

    pub(super) async fn reader(&self) -> Result<PoolConnection<sqlx::Sqlite>, CatalogError> {
        self.files.check().map_err(|what| CatalogError::Lost {
            path: self.path.clone(),
            what,
        })?;
        self.readers.acquire().await.map_err(|e| self.failed(e))
    }

    pub(super) fn refused(&self, error: writer::WriteError) -> CatalogError {
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
    pub(super) async fn write<T>(
        &self,
        work: impl AsyncFnOnce(
            &mut SqliteConnection,
            &mut writer::Keys,
        ) -> Result<T, writer::WriteError>,
    ) -> Result<T, CatalogError> {
        self.transaction(true, work).await
    }

    /// Like [`Self::write`], but rolls back if `keep` is false.
    pub(super) async fn transaction<T>(
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
