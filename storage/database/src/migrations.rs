//! The steps that upgrade a database's schema. They are listed here, because sqlx's macro that
//! reads a folder of steps links all of sqlx into the compiler, which is most of sqlx's share of
//! the build time.

use std::sync::LazyLock;

use picofarm_catalog::CatalogError;
use sqlx::{
    SqlSafeStr,
    migrate::{MigrateError, Migration, MigrationType, Migrator},
};

/// A step's version, its name and its statements.
type Step = (i64, &'static str, &'static str);

macro_rules! steps {
    ($engine:literal: $($version:literal $name:literal,)*) => {
        &[$((
            $version,
            $name,
            include_str!(concat!("../migrations/", $engine, "/", $name, ".sql")),
        ),)*]
    };
}

// This list is append-only, because a database stores the checksum of every step it has run.
const SQLITE_STEPS: &[Step] = steps!("sqlite":
    1 "0001_init",
    2 "0002_stages",
    3 "0003_listing",
    4 "0004_rights",
    5 "0005_places",
    6 "0006_unchecked",
    8 "0008_interruptions",
    9 "0009_usage",
    10 "0010_after",
);
#[cfg(feature = "postgres")]
const POSTGRES_STEPS: &[Step] = steps!("postgres":
    1 "0001_init",
    2 "0002_stages",
    3 "0003_listing",
    4 "0004_rights",
    5 "0005_places",
    6 "0006_unchecked",
    8 "0008_interruptions",
    9 "0009_usage",
    10 "0010_after",
);

/// The migrations for SQLite.
pub(crate) static SQLITE: LazyLock<Migrator> = LazyLock::new(|| migrator(SQLITE_STEPS));
/// The migrations for Postgres.
#[cfg(feature = "postgres")]
pub(crate) static POSTGRES: LazyLock<Migrator> = LazyLock::new(|| migrator(POSTGRES_STEPS));

/// Returns a migrator that runs each step in its own transaction.
fn migrator(steps: &[Step]) -> Migrator {
    let steps = steps.iter().map(|&(version, name, statements)| {
        let statements = statements.into_sql_str();
        Migration::new(
            version,
            // sqlx stores the name without its number.
            name.trim_start_matches(|c: char| c.is_ascii_digit() || c == '_')
                .into(),
            MigrationType::Simple,
            statements,
            false,
        )
    });
    Migrator::with_migrations(steps.collect())
}

/// Returns the latest version that a program knows.
pub(crate) fn latest(migrator: &Migrator) -> i64 {
    migrator.iter().map(|m| m.version).max().unwrap_or(0)
}

/// A first step that was committed before steps were append-only.
pub(crate) struct FormerStep {
    /// SHA-384 of its text, as stored in the database.
    pub checksum: &'static str,
    /// The statements that upgrade from its schema to the current first step.
    pub upgrade: &'static str,
}

impl FormerStep {
    /// Returns whether a database with this checksum began with the former step.
    pub(crate) fn matches(&self, checksum: &[u8]) -> bool {
        let hex: String = checksum.iter().map(|b| format!("{b:02x}")).collect();
        hex == self.checksum
    }
}

/// SQLite's first step from 2026-11-21 to 2026-11-23.
pub(crate) const SQLITE_FORMER: FormerStep = FormerStep {
    checksum: "fd97ccc6a63d384b6f25a036178ea94d141da56f2a9aa38d0dbdb07d912de7042b7582aacb2274f0665cc57da2a31598",
    upgrade: include_str!("../migrations/former/sqlite_upgrade.sql"),
};
/// Postgres' first step in the same period.
#[cfg(feature = "postgres")]
pub(crate) const POSTGRES_FORMER: FormerStep = FormerStep {
    checksum: "29293c1424666f89f845bc2915996943590bc31d5e31e3052da3b239efe5d7b6957ade6534cf81d74883f8186e417d66",
    upgrade: include_str!("../migrations/former/postgres_upgrade.sql"),
};

/// Returns the checksum of the first step, which replaces the former one after the upgrade.
pub(crate) fn first_checksum(migrator: &Migrator) -> &[u8] {
    migrator.iter().next().map_or(&[], |first| &first.checksum)
}

/// Returns the error for a failed migration. `classify` converts the database's own errors.
pub(crate) fn failed(
    place: String,
    migrator: &Migrator,
    error: MigrateError,
    classify: impl FnOnce(sqlx::Error) -> CatalogError,
) -> CatalogError {
    let known = latest(migrator);
    match error {
        MigrateError::VersionMissing(found) | MigrateError::VersionTooNew(found, _) => {
            CatalogError::Newer {
                place,
                found,
                known,
            }
        }
        MigrateError::VersionMismatch(step) => CatalogError::OtherSchema { place, step },
        MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => classify(e),
        other => CatalogError::Unusable {
            place,
            what: format!("its schema cannot be brought up to date ({other})"),
        },
    }
}

#[cfg(test)]
mod tests;
