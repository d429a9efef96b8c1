//! The complete worker.

use std::sync::Arc;

use picofarm_session::{AgentConfig, AgentError, StorePrefixes, Summary, opener, run_with};
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;

use crate::executor::TaskExecutor;

/// Runs a worker for every kind of task, until `shutdown` or until the coordinator refuses it.
///
/// # Errors
/// [`AgentError`] if a setting cannot be used, or the coordinator refuses this worker. An
/// unreachable coordinator is not an error: the worker retries for ever.
pub async fn run(config: AgentConfig, shutdown: CancellationToken) -> Result<Summary, AgentError> {
    config.check()?;
    let files = opener(&StorePrefixes::new(&config.store_prefixes)?);
    let executor = TaskExecutor::new(&config.asset_dirs, Handle::current(), files)
        .with_memory(config.memory_mib)
        .reached_at(&config.peers)
        .with_gpus(&config.gpus)?
        .with_python(
            config.python.as_deref(),
            config.python_environments.as_deref(),
        )?;
    run_with(config, Arc::new(executor), shutdown).await
}
