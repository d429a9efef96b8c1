//! Upgrades a database's schema.

use picofarm_catalog::CatalogError;
use sqlx::PgPool;

use super::errors;
use crate::migrations;

/// Runs the missing migrations.
///
/// # Errors
/// [`CatalogError::Newer`] if a later version of the program wrote the database.
pub(super) async fn migrate(place: &str, pool: &PgPool) -> Result<(), CatalogError> {
    upgrade_former(pool)
        .await
        .map_err(|e| errors::classify(place, e))?;
    // Several coordinators may start at the same time, so the migrator takes an advisory lock.
    migrations::POSTGRES.run(pool).await.map_err(|error| {
        migrations::failed(place.to_owned(), &migrations::POSTGRES, error, |e| {
            errors::classify(place, e)
        })
    })
}

/// Upgrades a catalog with a first step from before steps were append-only.
async fn upgrade_former(pool: &PgPool) -> Result<(), sqlx::Error> {
    let mut tx = pool.begin().await?;
    let exists: bool = sqlx::query_scalar("SELECT to_regclass('_sqlx_migrations') IS NOT NULL")
        .fetch_one(&mut *tx)
        .await?;
    if !exists {
        return tx.rollback().await;
    }
    let former = &migrations::POSTGRES_FORMER;
    let query = "SELECT checksum FROM _sqlx_migrations WHERE version = 1";
    let checksum: Option<Vec<u8>> = sqlx::query_scalar(query).fetch_optional(&mut *tx).await?;
    if !checksum.is_some_and(|checksum| former.matches(&checksum)) {
        return tx.rollback().await;
    }
    // Another coordinator may be doing the same.
    sqlx::query("LOCK TABLE _sqlx_migrations IN EXCLUSIVE MODE")
        .execute(&mut *tx)
        .await?;
    let checksum: Option<Vec<u8>> = sqlx::query_scalar(query).fetch_optional(&mut *tx).await?;
    if !checksum.is_some_and(|checksum| former.matches(&checksum)) {
        return tx.rollback().await;
    }
    sqlx::raw_sql(former.upgrade).execute(&mut *tx).await?;
    sqlx::query("UPDATE _sqlx_migrations SET checksum = $1 WHERE version = 1")
        .bind(migrations::first_checksum(&migrations::POSTGRES))
        .execute(&mut *tx)
        .await?;
    tx.commit().await
}
