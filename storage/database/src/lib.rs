//! Implementations of [`picofarm_catalog::Catalog`]: SQLite for one coordinator and, with the
//! feature `postgres`, Postgres for several. Rows never leave this crate.

mod graph;
mod listing;
mod lock;
mod migrations;
mod place;
#[cfg(feature = "postgres")]
mod postgres;
mod seen;
mod sql;
mod sql_jobs;
mod sql_listing;
mod sql_rights;
mod sql_stages;
mod sql_usage;
mod sqlite;
#[cfg(feature = "testing")]
pub mod testing;

pub use place::CatalogPlace;
#[cfg(feature = "postgres")]
pub use postgres::PostgresCatalog;
pub use sqlite::{Backup, BackupError, SqliteCatalog, backup, restore};
