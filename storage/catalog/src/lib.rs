//! What coordinators must remember: jobs, ranges, outputs, failures and history, as plain data and one trait, [`Catalog`].
//! The databases that keep it are behind the trait, in crates of their own; nothing here reads or writes anything.
//!
//! # Instances
//! A *instance* is one life of a coordinator on a catalog. Each range that is pending or leased is some instance's or nobody's;
//! only its instance may write it. An instance *claims* pending ranges of nobody's ([`Catalog::claim`]), leases them out from
//! memory, and gives them back when it has no use for them. What is done or dead is nobody's and stays in the catalog.
//!
//! On Postgres an instance is a row that its process renews ([`Catalog::beat`]). Every transaction that writes locks that row
//! first; an instance whose row has run out or is gone writes nothing ([`CatalogError::Fenced`]). Its ranges pass to whoever
//! finds it lost, leases and all. A worker that comes to another coordinator brings its leases along
//! ([`Catalog::adopt`]); the former owner finds out when it beats, or when it tries to write them
//! ([`CatalogError::Conflict`]). So nobody needs to be elected, and a process that was stopped and wakes up does no harm.
//! SQLite has one instance, which holds a lock on the file.

mod changes;
mod error;
mod event;
mod instance;
mod job;
mod listing;
mod range;
mod refused;
mod rights;
mod submission;
mod task;

use std::{fmt, sync::Arc};

use async_trait::async_trait;
use picofarm_proto::{
    ids::{JobId, StageRef, WorkerId},
    model::{Event, JobState, TaskCounts},
};

pub use changes::Changes;
pub use error::CatalogError;
pub use event::{EventQuery, NewEvent};
pub use instance::{Claim, Free, JobEnd, News, Owned, Settled, Snapshot, Want, Worker};
pub use job::{Holdups, Job, JobRecord, ResultSet, StageCounts, StageRecord, Timing};
pub use listing::{Forgotten, JobQuery, Page};
pub use range::{LeaseState, Mark, Range, RangeState, Run};
pub use refused::{Culprit, Row, culprits, verdict};
pub use rights::{AuditQuery, NewAudit, OwnedPlace, Owner, Rights, Sight};
pub use submission::{Gone, Outcome, Recorded, Submission};
pub use task::{Exception, Output, TaskRecord};

/// A catalog that can be opened: where it lies. Its text never shows a password.
#[async_trait]
pub trait CatalogSource: fmt::Display + fmt::Debug + Send + Sync {
    /// Opens the catalog, creating what is missing. `holder` tells people who has it.
    ///
    /// # Errors
    /// A [`CatalogError`] that says what to do.
    async fn open(&self, holder: &str) -> Result<Arc<dyn Catalog>, CatalogError>;
}

/// Whose specs are to be read.
#[derive(Debug, Clone, Copy)]
pub enum Specs<'a> {
    /// One job's: [`Catalog::job`].
    Job(JobId),
    /// That of the latest job with a spec hash: [`Catalog::job_with`].
    With(&'a str),
    /// Those of jobs that write into a data set (store, name): [`Catalog::jobs_at`].
    At(&'a str, &'a str),
    /// Those of the latest jobs that a reader may see: [`Catalog::recent`].
    Recent(u32, &'a Sight),
}

/// Durable memory of coordinators. All methods may be called concurrently; each is one transaction.
///
/// # Errors
/// All methods give a [`CatalogError`] when the database cannot be read or written; then nothing changed.
#[async_trait]
pub trait Catalog: Rights {
    /// Begins a life: founds an instance, which takes over what the last life of this process owned and what instances left
    /// that are lost.
    async fn load(&self) -> Result<Snapshot, CatalogError>;

    /// Says that the instance lives and has this many workers connected; to be called about once a
    /// second. What may run is told of `now_ms`.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`] when it was thought lost; a new life must begin.
    async fn beat(&self, workers: u32, now_ms: i64) -> Result<News, CatalogError>;

    /// Returns when another instance may have changed something: a hint to beat early. Safe to cancel.
    async fn changed(&self);

    /// Makes pending ranges of nobody's the instance's: for each wish up to as many tasks as it names, in the order in
    /// which they may run. Ranges that another instance is just claiming are passed over.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`].
    async fn claim(&self, wants: &[Want]) -> Result<Vec<Claim>, CatalogError>;

    /// Makes a worker's leases the instance's, whosever they were.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`].
    async fn adopt(&self, worker: WorkerId) -> Result<Owned, CatalogError>;

    /// Makes all of `changes` durable, or none of them; returns after the commit, with the stages that opened and the
    /// jobs that ended by it.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`]; [`CatalogError::Conflict`] when the database holds something the caller did not know
    /// of (another manifest for a task, a range that is another instance's now); [`CatalogError::Refused`] when something of it
    /// cannot be written by its content, see [`culprits`].
    async fn commit(&self, changes: &Changes) -> Result<Settled, CatalogError>;

    /// Writes the outputs, failed tasks, workers and history of `changes` and undoes that: says what the database has
    /// against their content, if anything.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`].
    async fn trial(&self, changes: &Changes) -> Result<Option<String>, CatalogError>;

    /// Records a job with its ranges, which are nobody's, and the first lines of its history. `false` where a job with
    /// the same spec is active or done: then nothing is recorded.
    ///
    /// # Errors
    /// [`CatalogError::Refused`] when something of it cannot be written by its content.
    async fn submit(
        &self,
        job: &Job,
        ranges: &[Range],
        events: &[NewEvent],
    ) -> Result<bool, CatalogError> {
        let stages = job.stages();
        let submission = Submission::new(job, &stages, ranges, events);
        Ok(self.record(&submission).await? == Outcome::New)
    }

    /// Records a job, and drops the records of outputs that are gone.
    async fn record(&self, submission: &Submission<'_>) -> Result<Outcome, CatalogError>;

    /// The outputs of tasks below `count` that are recorded in `set`, ascending.
    async fn recorded(&self, set: &ResultSet, count: u64) -> Result<Vec<Recorded>, CatalogError>;

    /// Notes that the store holds these outputs as they are recorded; a record of another manifest is left alone.
    async fn mark_checked(&self, set: &ResultSet, outputs: &[Recorded])
    -> Result<(), CatalogError>;

    /// Drops the record of an output that the store does not hold; `false` where there was none with this manifest.
    async fn drop_output(&self, gone: &Gone) -> Result<bool, CatalogError>;

    /// Where a job stands; `None` where there is none. Unlike [`Self::job`] it does not read the spec.
    async fn state(&self, job: JobId) -> Result<Option<JobState>, CatalogError>;

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

    /// Removes some of the jobs that ended before this Unix time (milliseconds) with their history, and says whether there is
    /// more to do: one short transaction, since others wait for it. When no such job is left, it removes outputs: they let
    /// others reuse a result, so they leave only with the last job of their result set, that is when the set has had no job
    /// for the same age. (The results themselves stay in their store, and are found there when they are wanted again.)
    async fn forget(&self, before_ms: i64) -> Result<Forgotten, CatalogError>;

    /// Active jobs of a user.
    async fn jobs_of(&self, user: &str) -> Result<u64, CatalogError>;

    /// Makes the given-up tasks of a job that is active or failed pending again, with fresh budgets; returns how many.
    ///
    /// # Errors
    /// [`CatalogError::Conflict`] where another job with the same spec is active or done.
    async fn retry(&self, job: JobId, now_ms: i64) -> Result<u64, CatalogError>;

    /// A job and how far it is.
    async fn job(&self, id: JobId) -> Result<Option<JobRecord>, CatalogError>;

    /// Writes some ten pages for good or takes them back, to see that there is room: on a full disk the smallest writes may
    /// still succeed, and those of a submission or a commit do not.
    ///
    /// # Errors
    /// The catalog cannot be written.
    async fn try_room(&self) -> Result<(), CatalogError>;

    /// Bytes of the specs that a read would bring into memory, as they are stored: cheap, so that a reader can be refused
    /// before they are read.
    async fn spec_bytes(&self, specs: Specs<'_>) -> Result<u64, CatalogError>;

    /// Tasks of all active jobs by state, in one go.
    async fn active_tasks(&self) -> Result<TaskCounts, CatalogError>;

    /// A page of the list of jobs, without their specs.
    async fn page(&self, query: &JobQuery) -> Result<Page, CatalogError>;

    /// The latest job with this spec hash.
    async fn job_with(&self, spec_hash: &str) -> Result<Option<Job>, CatalogError>;

    /// The latest jobs that this reader may see, the last first.
    async fn recent(&self, most: u32, sight: &Sight) -> Result<Vec<Job>, CatalogError>;

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

    /// Lets go of what the instance owns, as far as that is possible, and of the database.
    async fn close(&self);
}
