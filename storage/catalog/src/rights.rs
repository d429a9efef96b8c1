//! Job owners, visibility of jobs, and the audit log.

use async_trait::async_trait;
use picofarm_proto::{
    ids::JobId,
    messages::{Act, AuditEntry, Outcome},
};

use crate::{CatalogError, Job, ResultSet};

/// The owner of a job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Owner {
    /// Name of the caller that submitted it.
    pub user: String,
    /// The owner's project; empty if there is none.
    pub project: String,
}

impl From<&Job> for Owner {
    fn from(job: &Job) -> Self {
        Self {
            user: job.user.clone(),
            project: job.spec.project.clone(),
        }
    }
}

/// A folder of a store into which jobs write. It is owned by the first submitter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnedPlace {
    /// Its normal form (`picofarm_proto::spec::Place`).
    pub place: String,
    /// Whether the place is a named record in a data set, which may have another owner; otherwise
    /// it is a folder with all of its content.
    pub record: bool,
    /// The owner.
    pub owner: Owner,
    /// The owner's latest job that writes there.
    pub job: JobId,
}

/// The jobs that a reader may see.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Sight {
    /// All jobs.
    #[default]
    All,
    /// The reader's own jobs and those of some projects.
    Of {
        /// Name of the reader.
        user: String,
        /// Names of projects; none contains a comma.
        projects: Vec<String>,
    },
}

impl Sight {
    /// Returns whether a job of this owner is visible.
    pub fn sees(&self, owner: &Owner) -> bool {
        match self {
            Self::All => true,
            Self::Of { user, projects } => {
                owner.user == *user
                    || (!owner.project.is_empty() && projects.contains(&owner.project))
            }
        }
    }
}

/// A new entry of the audit log; the catalog assigns its sequence number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewAudit {
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// Name of the caller, without NUL.
    pub who: String,
    /// The action that was taken or attempted.
    pub act: Act,
    /// The job concerned, if any.
    pub job: Option<JobId>,
    /// The outcome of the action.
    pub outcome: Outcome,
    /// A message for people, without NUL.
    pub detail: String,
}

/// A query of the audit log.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct AuditQuery {
    /// Only entries with smaller sequence numbers.
    pub before: Option<u64>,
    /// The maximum number of entries.
    pub limit: u32,
    /// Only actions of this caller.
    pub who: Option<String>,
    /// Only actions on this job.
    pub job: Option<JobId>,
}

/// Owners of jobs, and the audit log. The log does not depend on the lives of coordinators, and it
/// outlives deleted jobs.
///
/// # Errors
/// All methods return a [`CatalogError`] if the database cannot be read or written; in that case
/// nothing has changed.
#[async_trait]
pub trait Rights: Send + Sync + 'static {
    /// Returns the owner of a job, or `None` if there is no such job.
    async fn owner(&self, job: JobId) -> Result<Option<Owner>, CatalogError>;

    /// Returns the owned places that are equal to this one, inside it, or around it, compared in
    /// normal form. Places of jobs that ended without any result are omitted.
    async fn owned_near(&self, place: &str) -> Result<Vec<OwnedPlace>, CatalogError>;

    /// Returns the number of tasks of the user's largest stage with these results, or 0 if there is
    /// none.
    async fn largest_stage(&self, set: &ResultSet, user: &str) -> Result<u64, CatalogError>;

    /// Appends entries to the audit log, all of them or none.
    async fn audit(&self, lines: &[NewAudit]) -> Result<(), CatalogError>;

    /// Returns entries of the audit log, newest first.
    async fn audited(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, CatalogError>;

    /// Deletes entries older than this Unix time (milliseconds). Returns their number.
    async fn forget_audit(&self, before_ms: i64) -> Result<u64, CatalogError>;
}
