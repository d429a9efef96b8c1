//! A worker's settings, its summary at the end, and why it may end early.

use std::{
    path::PathBuf,
    time::{Duration, SystemTime},
};

use picofarm_proto::{ids::WorkerId, model::check_label};
use picofarm_settings::Gpus;

use crate::{Access, AccessError};

/// Settings of one worker process.
#[derive(Debug, Clone)]
pub struct AgentConfig {
    /// URL of the coordinator, e.g. `http://127.0.0.1:7717`; of several on one catalog, with commas between them. The
    /// worker goes to the next one when it loses one.
    pub coordinator: String,
    /// Name, for people: host and process.
    pub name: String,
    /// Identity across restarts; `None` makes one for this process.
    pub worker_id: Option<WorkerId>,
    /// How the process of this worker before this one ended, where that is known; empty otherwise.
    pub ended: String,
    /// Threads of the render pool, at least 1.
    pub threads: usize,
    /// Memory that tasks may take, MiB; 0 = not known, which meets no stage that asks for any.
    pub memory_mib: u64,
    /// Where that number comes from, for the log.
    pub memory_from: String,
    /// Graphics processors that tasks may use.
    pub gpus: Gpus,
    /// Where other workers reach this one, which train a network together with it: an address of this machine, and a port
    /// where it must be a certain one.
    pub peers: String,
    /// Labels that stages may ask for.
    pub labels: Vec<String>,
    /// The worker ends when it has had nothing to do for so long, while connected; `None` = never.
    pub exit_idle: Option<Duration>,
    /// The worker stops work then, as at a signal; it tells the coordinator, which grants what it
    /// can finish by then. `None` = not known.
    pub ends_at: Option<SystemTime>,
    /// Folders to look in for furniture, besides the usual ones.
    pub asset_dirs: Vec<PathBuf>,
    /// What this worker has to show, and whom it trusts.
    pub access: Access,
    /// Paths or URLs that tasks' outputs and scene files must lie in; without any, they may lie anywhere.
    pub store_prefixes: Vec<String>,
}

impl AgentConfig {
    /// Every limit of the fields above.
    ///
    /// # Errors
    /// [`AgentError::Config`] names the first field that cannot be used.
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

/// What a worker did in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Summary {
    /// Tasks computed and published.
    pub computed: u64,
    /// Tasks whose output was already in the store.
    pub adopted: u64,
    /// Tasks that failed.
    pub failed: u64,
    /// Times the session was lost and opened again.
    pub reconnects: u64,
    /// Finished tasks that no coordinator acknowledged before the end. Their outputs are in the store, so
    /// whoever gets those tasks next adopts them.
    pub unacknowledged: u64,
}

/// Why a worker ended.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// A setting that cannot be used.
    #[error("{field}: {what}")]
    Config {
        /// The setting.
        field: &'static str,
        /// What was expected.
        what: String,
    },
    /// The coordinator's URL, or what is needed to reach it, cannot be used.
    #[error("coordinator: {0}")]
    Access(#[from] AccessError),
    /// The coordinator will not have this worker, and asking again would not help.
    #[error("the coordinator at {coordinator} refused this worker: {reason}")]
    Refused {
        /// Its URL.
        coordinator: String,
        /// Its words.
        reason: String,
    },
    /// The render threads could not be started.
    #[error(
        "cannot start {threads} render threads: {reason}; lower `threads` or raise the process limit"
    )]
    Threads {
        /// How many were asked for.
        threads: usize,
        /// Why.
        reason: String,
    },
}
