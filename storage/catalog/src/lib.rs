//! What a coordinator must remember: jobs, ranges, outputs, failures and history. One trait, [`Catalog`];
//! behind it a backend and its SQL. Rows never leave this crate.

mod changes;
mod error;
mod lock;
mod record;
mod sqlite;

use async_trait::async_trait;
use picofarm_proto::{ids::JobId, model::Event};

pub use changes::Changes;
pub use error::CatalogError;
pub use record::{
    EventQuery, Exception, Job, LeaseState, Mark, NewEvent, Output, Range, RangeState, ResultSet,
    Run, Snapshot, Timing, Worker,
};
pub use sqlite::SqliteCatalog;

/// Durable memory of a coordinator. All methods may be called concurrently.
#[async_trait]
pub trait Catalog: Send + Sync + 'static {
    /// Everything a coordinator needs to go on after a restart.
    ///
    /// # Errors
    /// [`CatalogError`] when the database cannot be read.
    async fn load(&self) -> Result<Snapshot, CatalogError>;

    /// Makes all of `changes` durable, or none of them; returns after the commit.
    ///
    /// # Errors
    /// [`CatalogError::Conflict`] when the database holds something the caller did not know of (an output that is
    /// there already, a range with a later epoch); other errors when it cannot be written. Then nothing changed.
    async fn commit(&self, changes: Changes) -> Result<(), CatalogError>;

    /// The tasks below `count` whose outputs exist in `set`, as maximal runs in ascending order.
    ///
    /// # Errors
    /// [`CatalogError`] when the database cannot be read.
    async fn output_runs(&self, set: &ResultSet, count: u64) -> Result<Vec<Run>, CatalogError>;

    /// The manifest hash committed for each (job, task) asked for, in the same order.
    ///
    /// # Errors
    /// [`CatalogError`] when the database cannot be read.
    async fn manifests(
        &self,
        tasks: &[(JobId, u64)],
    ) -> Result<Vec<Option<[u8; 32]>>, CatalogError>;

    /// How long the computed (not adopted) outputs of `set` took.
    ///
    /// # Errors
    /// [`CatalogError`] when the database cannot be read.
    async fn timing(&self, set: &ResultSet) -> Result<Timing, CatalogError>;

    /// History of a job, oldest first.
    ///
    /// # Errors
    /// [`CatalogError`] when the database cannot be read.
    async fn events(&self, query: &EventQuery) -> Result<Vec<Event>, CatalogError>;

    /// Writes out what is still in memory and releases the database.
    async fn close(&self);
}
