//! Brings a database's schema up to date.

use picofarm_catalog::CatalogError;
use sqlx::{PgPool, migrate::MigrateError};

use super::errors;
use crate::migrations;

/// Runs what migrations are missing.
///
/// # Errors
/// [`CatalogError::Newer`] where a later program wrote it.
pub(super) async fn migrate(place: &str, pool: &PgPool) -> Result<(), CatalogError> {
    let known = migrations::latest(&migrations::POSTGRES);
    // Several coordinators may start at once: the migrator takes an advisory lock.
    migrations::POSTGRES
        .run(pool)
        .await
        .map_err(|error| match error {
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
