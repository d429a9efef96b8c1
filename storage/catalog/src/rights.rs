//! Whose jobs are, who may see them, and the record of who did what.

use async_trait::async_trait;
use picofarm_proto::{
    ids::JobId,
    model::{Act, AuditEntry, Outcome},
};

use crate::{CatalogError, Job, ResultSet};

/// Of whom a job is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Owner {
    /// Name of the caller that submitted it.
    pub user: String,
    /// Its project; empty = none.
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

/// A folder of a store into which jobs write, and whose it is: the first submitter's.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnedPlace {
    /// Its normal form (`picofarm_proto::model::Place`).
    pub place: String,
    /// It is a named record in a data set, which may be another user's; otherwise a folder with everything in it.
    pub record: bool,
    /// Whose it is.
    pub owner: Owner,
    /// The owner's latest job that writes there.
    pub job: JobId,
}

/// Whose jobs a reader may see.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Sight {
    /// Everybody's.
    #[default]
    All,
    /// One's own and those of some projects.
    Of {
        /// Name of the reader.
        user: String,
        /// Names of projects, none of which holds a comma.
        projects: Vec<String>,
    },
}

impl Sight {
    /// Whether a job of this owner may be seen.
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

/// A line for the audit log; its sequence number is given by the catalog.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewAudit {
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// Name of the caller, without NUL.
    pub who: String,
    /// What was done or attempted.
    pub act: Act,
    /// The job, where it concerns one.
    pub job: Option<JobId>,
    /// What became of it.
    pub outcome: Outcome,
    /// In words, without NUL.
    pub detail: String,
}

/// Which part of the audit log.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct AuditQuery {
    /// Only lines with smaller sequence numbers.
    pub before: Option<u64>,
    /// At most so many.
    pub limit: u32,
    /// Only acts of this caller.
    pub who: Option<String>,
    /// Only acts on this job.
    pub job: Option<JobId>,
}

/// Whose jobs are, and who did what. The log is independent of coordinators' lives and of forgotten jobs.
///
/// # Errors
/// All methods give a [`CatalogError`] when the database cannot be read or written; then nothing changed.
#[async_trait]
pub trait Rights: Send + Sync + 'static {
    /// Of whom a job is; `None` where there is no such job.
    async fn owner(&self, job: JobId) -> Result<Option<Owner>, CatalogError>;

    /// The owned places that are equal to this one, lie in it, or enclose it, by their normal form. Those of jobs that ended
    /// without any result are left out.
    async fn owned_near(&self, place: &str) -> Result<Vec<OwnedPlace>, CatalogError>;

    /// Number of tasks of a user's largest stage with these results; 0 = the user has none.
    async fn largest_stage(&self, set: &ResultSet, user: &str) -> Result<u64, CatalogError>;

    /// Appends lines to the audit log, all of them or none.
    async fn audit(&self, lines: &[NewAudit]) -> Result<(), CatalogError>;

    /// Lines of the audit log, newest first.
    async fn audited(&self, query: &AuditQuery) -> Result<Vec<AuditEntry>, CatalogError>;

    /// Removes lines older than this Unix time (milliseconds); returns how many.
    async fn forget_audit(&self, before_ms: i64) -> Result<u64, CatalogError>;
}
