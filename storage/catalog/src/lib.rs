//! The durable state of coordinators: jobs, ranges, outputs, failures and history, as plain data
//! behind the trait [`Catalog`]. Other crates implement the trait for each database; this crate
//! performs no input or output.
//!
//! # Instances
//! An *instance* is one life of a coordinator on a catalog. A pending or leased range is either
//! owned by one instance or unowned; only its owner may write it. An instance *claims* unowned
//! pending ranges ([`Catalog::claim`]), leases them from memory, and releases them when it no
//! longer needs them. Done and dead ranges are unowned and stay in the catalog.
//!
//! On Postgres, an instance is a row that its process renews ([`Catalog::beat`]). Every write
//! transaction first locks that row; an instance whose row has expired or is gone cannot write
//! ([`CatalogError::Fenced`]). Its ranges, with their leases, pass to the instance that detects the
//! loss. A worker that moves to another coordinator keeps its leases ([`Catalog::adopt`]); the
//! former owner learns this from its next beat, or from the [`CatalogError::Conflict`] of its next
//! write. Therefore no election is needed, and a stopped process that wakes up does no harm. SQLite
//! has a single instance, which locks the file.

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
mod usage;

use std::{fmt, sync::Arc};

use async_trait::async_trait;
use picofarm_proto::{
    ids::{JobId, StageRef, WorkerId},
    messages::{Event, JobState, TaskCounts, UsageRow},
};

pub use changes::Changes;
pub use error::CatalogError;
pub use event::{EventQuery, NewEvent};
pub use instance::{Claim, Free, JobEnd, News, Owned, Settled, Snapshot, Want, Worker};
pub use job::{FormerJob, Holdups, Job, JobRecord, ResultSet, StageCounts, StageRecord, Timing};
pub use listing::{Forgotten, JobQuery, Page};
pub use range::{LeaseState, Mark, Range, RangeState, Run};
pub use refused::{Culprit, Row, culprits, verdict};
pub use rights::{AuditQuery, NewAudit, OwnedPlace, Owner, Rights, Sight};
pub use submission::{Gone, Outcome, Recorded, Submission};
pub use task::{Exception, Output, TaskRecord};
pub use usage::{NewUsage, UsageQuery, day_of, published};

/// The location of a catalog that can be opened. Its text never shows a password.
#[async_trait]
pub trait CatalogSource: fmt::Display + fmt::Debug + Send + Sync {
    /// Opens the catalog, creating it if it is missing. `holder` describes this coordinator to
    /// people.
    ///
    /// # Errors
    /// A [`CatalogError`] with instructions for the user.
    async fn open(&self, holder: &str) -> Result<Arc<dyn Catalog>, CatalogError>;
}

/// Selects the jobs for which to read specs.
#[derive(Debug, Clone, Copy)]
pub enum Specs<'a> {
    /// One job: [`Catalog::job`].
    Job(JobId),
    /// The latest job with a spec hash: [`Catalog::job_with`].
    With(&'a str),
    /// Jobs that write into a data set (store, name): [`Catalog::jobs_at`].
    At(&'a str, &'a str),
    /// The latest jobs that a reader may see: [`Catalog::recent`].
    Recent(u32, &'a Sight),
}

/// Durable storage for coordinators. All methods may be called concurrently; each is one
/// transaction.
///
/// # Errors
/// All methods return a [`CatalogError`] if the database cannot be read or written; in that case
/// nothing has changed.
#[async_trait]
pub trait Catalog: Rights {
    /// Starts a new instance, which takes over the ranges of this process's last instance and of
    /// lost instances.
    async fn load(&self) -> Result<Snapshot, CatalogError>;

    /// Renews the instance, reports its number of connected workers, and returns the changes made
    /// by others. It must be called about once a second. `now_ms` decides which tasks count as
    /// ready to run.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`] if the instance was considered lost; the caller must load a new
    /// one.
    async fn beat(&self, workers: u32, now_ms: i64) -> Result<News, CatalogError>;

    /// Returns when another instance may have changed something, as a hint to beat early.
    /// Cancel-safe.
    async fn changed(&self);

    /// Takes ownership of unowned pending ranges. For each request, it claims at most the requested
    /// number of tasks, in the order in which they may run. Ranges that another instance is
    /// claiming at the moment are skipped.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`].
    async fn claim(&self, wants: &[Want]) -> Result<Vec<Claim>, CatalogError>;

    /// Takes ownership of a worker's leases, regardless of their owner.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`].
    async fn adopt(&self, worker: WorkerId) -> Result<Owned, CatalogError>;

    /// Commits all of `changes` or none of them. It returns after the commit, with the stages that
    /// it opened and the jobs that it ended.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`]; [`CatalogError::Conflict`] if the database contains something
    /// unknown to the caller (another manifest for a task, or a range that another instance now
    /// owns); [`CatalogError::Refused`] if the content of a row cannot be written, see
    /// [`culprits`].
    async fn commit(&self, changes: &Changes) -> Result<Settled, CatalogError>;

    /// Writes the outputs, failed tasks, workers and history of `changes` and rolls back. Returns
    /// the database's objection to their content, if any.
    ///
    /// # Errors
    /// [`CatalogError::Fenced`].
    async fn trial(&self, changes: &Changes) -> Result<Option<String>, CatalogError>;

    /// Records a job with its unowned ranges and the first events of its history. Returns `false`
    /// and records nothing if a job with the same spec is active or done.
    ///
    /// # Errors
    /// [`CatalogError::Refused`] if part of the content cannot be written.
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

    /// Records a job, and deletes the records of outputs that are gone.
    async fn record(&self, submission: &Submission<'_>) -> Result<Outcome, CatalogError>;

    /// Returns the recorded outputs of `set` for tasks below `count`, in ascending order.
    async fn recorded(&self, set: &ResultSet, count: u64) -> Result<Vec<Recorded>, CatalogError>;

    /// Marks these outputs as found in the store. A record with another manifest is left unchanged.
    async fn mark_checked(&self, set: &ResultSet, outputs: &[Recorded])
    -> Result<(), CatalogError>;

    /// Deletes the record of an output that the store does not have. Returns `false` if there was
    /// no record with this manifest.
    async fn drop_output(&self, gone: &Gone) -> Result<bool, CatalogError>;

    /// Returns a job's state, or `None` if there is no such job. Unlike [`Self::job`], it does not
    /// read the spec.
    async fn state(&self, job: JobId) -> Result<Option<JobState>, CatalogError>;

    /// Cancels an active job. Returns `false` if it is not active. `why` goes into its history.
    async fn cancel(&self, job: JobId, why: &str, now_ms: i64) -> Result<bool, CatalogError>;

    /// Pauses or resumes an active job. Returns `false` if that changes nothing. `who` goes into
    /// its history.
    async fn pause(
        &self,
        job: JobId,
        paused: bool,
        who: &str,
        now_ms: i64,
    ) -> Result<bool, CatalogError>;

    /// Deletes some of the jobs that ended before this Unix time (milliseconds), with their
    /// history, and returns whether there is more to delete. Each call is one short transaction,
    /// because others wait for it. If no such job is left, it deletes outputs. Outputs allow other
    /// jobs to reuse a result, so they are only deleted with the last job of their result set, when
    /// the set has had no job for the same period. (The results themselves stay in their store, and
    /// are found there when they are needed again.)
    async fn forget(&self, before_ms: i64) -> Result<Forgotten, CatalogError>;

    /// Returns the number of a user's active jobs.
    async fn unfinished_jobs(&self, user: &str) -> Result<u64, CatalogError>;

    /// Makes the dead tasks of an active or failed job pending again, with full retry budgets.
    /// Returns their number.
    ///
    /// # Errors
    /// [`CatalogError::Conflict`] if another job with the same spec is active or done.
    async fn retry(&self, job: JobId, now_ms: i64) -> Result<u64, CatalogError>;

    /// Returns a job and its progress.
    async fn job(&self, id: JobId) -> Result<Option<JobRecord>, CatalogError>;

    /// Writes about ten pages, permanently or in a transaction with a rollback, to check for free
    /// space. On a full disk the smallest writes may still succeed while submissions and commits
    /// fail.
    ///
    /// # Errors
    /// The catalog cannot be written.
    async fn try_room(&self) -> Result<(), CatalogError>;

    /// Returns the stored size in bytes of the specs that a read would load into memory. The check
    /// is cheap, so that a caller can be refused before the specs are read.
    async fn spec_bytes(&self, specs: Specs<'_>) -> Result<u64, CatalogError>;

    /// Returns the number of tasks in each state over all active jobs, in one query.
    async fn active_tasks(&self) -> Result<TaskCounts, CatalogError>;

    /// Returns a page of the list of jobs, without their specs.
    async fn page(&self, query: &JobQuery) -> Result<Page, CatalogError>;

    /// Returns the latest job with this spec hash.
    async fn job_with(&self, spec_hash: &str) -> Result<Option<Job>, CatalogError>;

    /// Returns the latest jobs that this reader may see, newest first.
    async fn recent(&self, most: u32, sight: &Sight) -> Result<Vec<Job>, CatalogError>;

    /// Returns the jobs that write into a data set and are active or have written something, newest
    /// first.
    async fn jobs_at(&self, store: &str, dataset: &str) -> Result<Vec<Job>, CatalogError>;

    /// Returns the tasks below `count` with an existing output in `set`, as maximal runs in
    /// ascending order.
    async fn output_runs(&self, set: &ResultSet, count: u64) -> Result<Vec<Run>, CatalogError>;

    /// Returns the committed manifest hash of each given task, in the same order.
    async fn manifests(
        &self,
        tasks: &[(StageRef, u64)],
    ) -> Result<Vec<Option<[u8; 32]>>, CatalogError>;

    /// Returns the number, duration and size of the computed (not adopted) outputs of `set`.
    async fn timing(&self, set: &ResultSet) -> Result<Timing, CatalogError>;

    /// Returns the reasons why a job's tasks wait at this time.
    async fn holdups(&self, job: JobId, now_ms: i64) -> Result<Holdups, CatalogError>;

    /// Returns the record of one task.
    async fn task(&self, stage: StageRef, task: u64) -> Result<TaskRecord, CatalogError>;

    /// Returns what jobs consumed, by the name of what it is summed by.
    async fn usage(&self, query: &UsageQuery) -> Result<Vec<UsageRow>, CatalogError>;

    /// Returns history events, oldest first.
    async fn events(&self, query: &EventQuery) -> Result<Vec<Event>, CatalogError>;

    /// Releases the instance's ranges as far as possible, and closes the database.
    async fn close(&self);
}
