//! Connects to a Postgres catalog, and runs its reads and transactions.

use std::sync::Mutex;

use picofarm_proto::ids::InstanceId;
use sqlx::{
    ConnectOptions, Connection,
    pool::PoolConnection,
    postgres::{PgConnectOptions, PgPoolOptions},
};

use super::hints::Hints;
use super::{CONNECTIONS, PATIENCE, PostgresCatalog, errors, instance, migrate, writer};
use picofarm_catalog::CatalogError;

impl PostgresCatalog {
    /// Connects to the database at `url`
    /// (`postgres://user:password@host/database?sslmode=verify-full`; missing parts are taken from
    /// the usual PG variables) and upgrades its schema. `name` describes this coordinator to
    /// people.
    ///
    /// # Errors
    /// [`CatalogError::Server`] if it cannot be reached, [`CatalogError::Newer`] if a later version
    /// of the program wrote it.
    pub async fn open(url: &str, name: &str) -> Result<Self, CatalogError> {
        let options: PgConnectOptions = url.parse().map_err(|e| errors::bad_url(url, &e))?;
        let options = options
            .application_name("picofarm")
            .disable_statement_logging()
            .options([
                // A coordinator that hangs in a transaction must not block the others.
                ("idle_in_transaction_session_timeout", "30s"),
                ("lock_timeout", "20s"),
                // Keepalives detect a server that has disappeared.
                ("tcp_keepalives_idle", "10"),
            ]);
        let place = errors::place(&options);
        let failed = |e| errors::classify(&place, e);
        let pool = PgPoolOptions::new()
            .max_connections(CONNECTIONS)
            .acquire_timeout(PATIENCE)
            .connect_with(options.clone())
            .await;
        let pool = match pool {
            Ok(pool) => pool,
            Err(error) => return Err(errors::unconnected(&place, &options, error).await),
        };
        migrate::migrate(&place, &pool).await?;
        let hints = Hints::new(pool.clone()).await.map_err(failed)?;
        Ok(Self {
            name: name.to_owned(),
            pool,
            instance: Mutex::new(None),
            keys: tokio::sync::Mutex::default(),
            hints,
            place,
        })
    }

    pub(super) fn failed(&self, error: sqlx::Error) -> CatalogError {
        errors::classify(&self.place, error)
    }

    pub(super) async fn reader(&self) -> Result<PoolConnection<sqlx::Postgres>, CatalogError> {
        match self.pool.acquire().await {
            Ok(connection) => Ok(connection),
            Err(error) => {
                let options = self.pool.connect_options();
                Err(errors::unconnected(&self.place, &options, error).await)
            }
        }
    }

    pub(super) fn instance(&self) -> Result<InstanceId, CatalogError> {
        self.instance
            .lock()
            .expect("no panic while locked")
            .ok_or(CatalogError::Fenced)
    }

    /// Runs `work` in one transaction, for a live instance.
    pub(super) async fn write<T>(
        &self,
        work: impl AsyncFnOnce(&mut writer::Writer<'_>) -> Result<T, writer::WriteError>,
    ) -> Result<T, CatalogError> {
        self.transaction(true, work).await
    }

    /// Like [`Self::write`], but rolls back if `keep` is false.
    pub(super) async fn transaction<T>(
        &self,
        keep: bool,
        work: impl AsyncFnOnce(&mut writer::Writer<'_>) -> Result<T, writer::WriteError>,
    ) -> Result<T, CatalogError> {
        let instance = self.instance()?;
        let mut keys = self.keys.lock().await;
        let result = async {
            let mut connection = self.pool.acquire().await?;
            let mut tx = connection.begin().await?;
            instance::fence(&mut tx, instance).await?;
            let mut writer = writer::Writer {
                c: &mut tx,
                instance: instance.uuid(),
                keys: &mut keys,
            };
            // On an error, dropping the transaction rolls it back.
            let done = work(&mut writer).await?;
            match keep {
                true => tx.commit().await?,
                false => tx.rollback().await?,
            }
            Ok(done)
        };
        result.await.map_err(|e| match e {
            writer::WriteError::Fenced => CatalogError::Fenced,
            writer::WriteError::Conflict(what) => CatalogError::Conflict(what),
            writer::WriteError::Sql(e) => self.failed(e),
        })
    }
}
