//! A worker's settings, its final summary, and the reasons for an early end.

use std::{
    path::PathBuf,
    time::{Duration, SystemTime},
};

use picofarm_proto::{ids::WorkerId, spec::check_label};
use picofarm_settings::Gpus;

use crate::{Access, AccessError};

/// Settings of one worker process.
#[derive(Debug, Clone)]
pub struct AgentConfig {
    /// URL of the coordinator, e.g. `http://127.0.0.1:7717`, or a comma-separated list of
    /// coordinators on one catalog. If the worker loses one, it connects to the next.
    pub coordinator: String,
    /// Name for display: host and process.
    pub name: String,
    /// Identity across restarts; `None` generates one for this process.
    pub worker_id: Option<WorkerId>,
    /// How this worker's previous process ended, if known; otherwise empty.
    pub ended: String,
    /// Number of threads in the render pool, at least 1.
    pub threads: usize,
    /// Memory for tasks in MiB; 0 = unknown, which satisfies no stage with a memory requirement.
    pub memory_mib: u64,
    /// Source of that number, for the log.
    pub memory_from: String,
    /// GPUs that tasks may use.
    pub gpus: Gpus,
    /// Address at which other workers reach this one to train a network together: an address of
    /// this machine, optionally with a port.
    pub peers: String,
    /// Labels that stages may require.
    pub labels: Vec<String>,
    /// The worker ends after being idle for this time while connected; `None` = never.
    pub exit_idle: Option<Duration>,
    /// The worker stops at this time, as on a signal. It reports the time to the coordinator, which
    /// grants only tasks that can finish by then. `None` = unknown.
    pub ends_at: Option<SystemTime>,
    /// Additional folders with furniture.
    pub asset_dirs: Vec<PathBuf>,
    /// The Python that runs code of jobs; `None` = the worker runs none.
    pub python: Option<PathBuf>,
    /// Folder of virtual environments for that code; `None` = nothing is installed.
    pub python_environments: Option<PathBuf>,
    /// The worker's credentials, and the certificate authorities it trusts.
    pub access: Access,
    /// Paths or URLs that must contain tasks' outputs and scene files; without any, all places are
    /// allowed.
    pub store_prefixes: Vec<String>,
}

impl AgentConfig {
    /// Checks the limits of all fields.
    ///
    /// # Errors
    /// [`AgentError::Config`] names the first unusable field.
    pub fn check(&self) -> Result<(), AgentError> {
        let fail = |field, what: &str| {
            Err(AgentError::Config {
                field,
                what: what.to_owned(),
            })
        };
        if self.threads == 0 {
            return fail("threads", "is 0; give the worker at least 1 thread");
        }
        for label in &self.labels {
            if let Err(what) = check_label(label) {
                return fail("label", &what);
            }
        }
        if self.name.trim().is_empty() {
            return fail("name", "is empty; give the worker a name");
        }
        Ok(())
    }
}

/// Statistics of a worker's life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Summary {
    /// Number of tasks computed and published.
    pub computed: u64,
    /// Number of tasks with an output already in the store.
    pub adopted: u64,
    /// Number of failed tasks.
    pub failed: u64,
    /// Number of times the session was lost and opened again.
    pub reconnects: u64,
    /// Number of finished tasks that no coordinator acknowledged before the end. Their outputs are
    /// in the store, so the next workers with these tasks adopt them.
    pub unacknowledged: u64,
}

/// A reason why a worker ended.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// An unusable setting.
    #[error("{field}: {what}")]
    Config {
        /// The setting.
        field: &'static str,
        /// The expected value.
        what: String,
    },
    /// The coordinator's URL, or a setting for connecting to it, is unusable.
    #[error("coordinator: {0}")]
    Access(#[from] AccessError),
    /// The coordinator refuses this worker, and retrying would not help.
    #[error("the coordinator at {coordinator} refused this worker: {reason}")]
    Refused {
        /// The coordinator's URL.
        coordinator: String,
        /// The coordinator's message.
        reason: String,
    },
    /// The render threads could not be started.
    #[error(
        "cannot start {threads} render threads: {reason}; lower `threads` or raise the process limit"
    )]
    Threads {
        /// The requested number of threads.
        threads: usize,
        /// The reason.
        reason: String,
    },
}
