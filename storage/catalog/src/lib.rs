//! What coordinators must remember: jobs, ranges, outputs, failures and history. One trait, [`Catalog`]; behind it
//! SQLite for one coordinator and Postgres for several. Rows never leave this crate.
//!
//! # Houses
//! A *house* is one life of a coordinator on a catalog. Each range that is pending or leased is some house's or nobody's;
//! only its house may write it. A house *claims* pending ranges of nobody's ([`Catalog::claim`]), leases them out from
//! memory, and gives them back when it has no use for them. What is done or dead is nobody's and stays in the catalog.
//!
//! On Postgres a house is a row that its process renews ([`Catalog::beat`]). Every transaction that writes locks that row
//! first; a house whose row has run out or is gone writes nothing ([`CatalogError::Fenced`]). Its ranges pass to whoever
//! finds it lost, leases and all. A worker that comes to another coordinator brings its leases along
//! ([`Catalog::adopt`]); the former owner finds out when it beats, or when it tries to write them
//! ([`CatalogError::Conflict`]). So nobody needs to be elected, and a process that was stopped and wakes up does no harm.
//! SQLite has one house, which holds a lock on the file.

mod changes;
mod error;
mod graph;
mod lock;
mod place;
mod postgres;
mod raw;
mod record;
mod sql;
mod sql_jobs;
mod sqlite;
#[cfg(feature = "testing")]
pub mod testing;

use async_trait::async_trait;
use picofarm_proto::{
    ids::{JobId, StageRef, WorkerId},
    model::Event,
};

pub use changes::Changes;
pub use error::CatalogError;
pub use place::CatalogPlace;
pub use postgres::PostgresCatalog;
pub use record::{
    Claim, EventQuery, Exception, Holdups, Job, JobEnd, JobRecord, LeaseState, Mark, NewEvent,
    News, Output, Owned, Range, RangeState, ResultSet, Run, Settled, Snapshot, StageCounts,
    StageRecord, TaskRecord, Timing, Want, Worker,
};
pub use sqlite::SqliteCatalog;

/// Durable memory of coordinators. All methods may be called concurrently; each is one transaction.
///
/// # Errors
/// All methods give a [`CatalogError`] when the database cannot be read or written; then nothing changed.
#[async_trait]
pub trait Catalog: Send + Sync + 'static {
    /// Begins a life: founds a house, which takes over what the last life of this process owned and what houses left
    /// that are lost.
    async fn load(&self) -> Result<Snapshot, CatalogError>;

    /// Says that the house lives and has this many workers connected; to be called about once a second.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`] when it was thought lost; a new life must begin.
    async fn beat(&self, workers: u32) -> Result<News, CatalogError>;

    /// Returns when another house may have changed something: a hint to beat early. Safe to cancel.
    async fn changed(&self);

    /// Makes pending ranges of nobody's the house's: for each wish up to as many tasks as it names, in the order in
    /// which they may run. Ranges that another house is just claiming are passed over.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`].
    async fn claim(&self, wants: &[Want]) -> Result<Vec<Claim>, CatalogError>;

    /// Makes a worker's leases the house's, whosever they were.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`].
    async fn adopt(&self, worker: WorkerId) -> Result<Owned, CatalogError>;

    /// Makes all of `changes` durable, or none of them; returns after the commit, with the stages that opened and the
    /// jobs that ended by it.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`]; [`CatalogError::Conflict`] when the database holds something the caller did not know
    /// of (another manifest for a task, a range that is another house's now).
    async fn commit(&self, changes: Changes) -> Result<Settled, CatalogError>;

    /// Records a job with its ranges, which are nobody's, and the first lines of its history. `false` where a job with
    /// the same spec is active or done: then nothing is recorded.
    async fn submit(
        &self,
        job: &Job,
        ranges: &[Range],
        events: &[NewEvent],
    ) -> Result<bool, CatalogError>;

    /// Stops an active job; `false` where it is not active. `why` goes into its history.
    async fn cancel(&self, job: JobId, why: &str, now_ms: i64) -> Result<bool, CatalogError>;

    /// Holds an active job, or lets it go on; `false` where that changes nothing. `who` goes into its history.
    async fn pause(
        &self,
        job: JobId,
        paused: bool,
        who: &str,
        now_ms: i64,
    ) -> Result<bool, CatalogError>;

    /// Removes up to `most` jobs that ended before this Unix time (milliseconds) with their history; returns how many.
    /// Outputs stay: they are reused.
    async fn forget(&self, before_ms: i64, most: u32) -> Result<u32, CatalogError>;

    /// Active jobs of a user.
    async fn jobs_of(&self, user: &str) -> Result<u64, CatalogError>;

    /// Makes the given-up tasks of a job that is active or failed pending again, with fresh budgets; returns how many.
    ///
    /// # Errors
    /// [`CatalogError::Conflict`] where another job with the same spec is active or done.
    async fn retry(&self, job: JobId, now_ms: i64) -> Result<u64, CatalogError>;

    /// A job and how far it is.
    async fn job(&self, id: JobId) -> Result<Option<JobRecord>, CatalogError>;

    /// All jobs, in order of submission.
    async fn jobs(&self) -> Result<Vec<JobRecord>, CatalogError>;

    /// The latest job with this spec hash.
    async fn job_with(&self, spec_hash: &str) -> Result<Option<Job>, CatalogError>;

    /// The latest jobs, the last first.
    async fn recent(&self, most: u32) -> Result<Vec<Job>, CatalogError>;

    /// Jobs that write into a data set and are active or have written something, the latest first.
    async fn jobs_at(&self, store: &str, dataset: &str) -> Result<Vec<Job>, CatalogError>;

    /// The tasks below `count` whose outputs exist in `set`, as maximal runs in ascending order.
    async fn output_runs(&self, set: &ResultSet, count: u64) -> Result<Vec<Run>, CatalogError>;

    /// The manifest hash committed for each task asked for, in the same order.
    async fn manifests(
        &self,
        tasks: &[(StageRef, u64)],
    ) -> Result<Vec<Option<[u8; 32]>>, CatalogError>;

    /// How long the computed (not adopted) outputs of `set` took.
    async fn timing(&self, set: &ResultSet) -> Result<Timing, CatalogError>;

    /// What the tasks of a job wait for at this time.
    async fn holdups(&self, job: JobId, now_ms: i64) -> Result<Holdups, CatalogError>;

    /// What is known of one task.
    async fn task(&self, stage: StageRef, task: u64) -> Result<TaskRecord, CatalogError>;

    /// History, oldest first.
    async fn events(&self, query: &EventQuery) -> Result<Vec<Event>, CatalogError>;

    /// Lets go of what the house owns, as far as that is possible, and of the database.
    async fn close(&self);
}
