//! A coordinator and workers in this process, for `demo` and `up`.

use std::{net::SocketAddr, path::Path, time::Duration};

use picofarm_agent::{Access, AgentConfig, AgentError, Summary};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::{
    error::{CliError, Code, Result},
    roles,
    settings::Settings,
};

/// Life of a lease: short, since after a `kill -9` of this one process the next run waits for it to end, and no network
/// can delay a heartbeat.
const LEASE: Duration = Duration::from_secs(20);

/// A farm on this machine.
pub struct Local {
    pub url: String,
    /// Where its health and metrics are served.
    pub http: Option<String>,
    coordinator: roles::Coordinator,
    workers: JoinSet<Result<Summary, AgentError>>,
    stop_workers: CancellationToken,
}

impl Local {
    /// Starts a coordinator on `catalog` and `workers` workers that share the cores.
    ///
    /// # Errors
    /// The catalog is in use or unreadable, or the address is taken.
    pub async fn start(
        catalog: &Path,
        listen: SocketAddr,
        workers: usize,
        settings: &Settings,
        guarded: roles::Guarded,
        http: Option<SocketAddr>,
    ) -> Result<Self> {
        let access = if guarded.is_open() {
            Access::default()
        } else {
            settings.access()?
        };
        let coordinator = roles::Coordinator::start(
            catalog.to_owned().into(),
            listen,
            LEASE,
            guarded,
            http,
            None,
        )
        .await?;
        let (url, http) = (coordinator.url(), coordinator.http());
        let mut local = Self {
            url: url.clone(),
            http,
            coordinator,
            workers: JoinSet::new(),
            stop_workers: CancellationToken::new(),
        };
        let cores = roles::cores();
        for i in 0..workers {
            let threads = (cores / workers + usize::from(i < cores % workers)).max(1);
            let config = AgentConfig {
                coordinator: url.clone(),
                name: format!("local-{}", i + 1),
                worker_id: None,
                threads,
                memory_mib: picofarm_agent::memory_mib() / workers.max(1) as u64,
                gpus: 0,
                labels: Vec::new(),
                asset_dirs: vec![settings.assets.clone()],
                access: access.clone(),
                store_prefixes: Vec::new(),
            };
            local
                .workers
                .spawn(picofarm_agent::run(config, local.stop_workers.clone()));
        }
        Ok(local)
    }

    /// Resolves when a worker ends, which none should while the farm runs.
    pub async fn worker_lost(&mut self) -> CliError {
        loop {
            match self.workers.join_next().await {
                // It was drained: the others go on, and without any the farm waits for some from elsewhere.
                Some(Ok(Ok(_))) => tracing::info!("a worker has ended"),
                Some(Ok(Err(e))) => return roles::agent_error(&e),
                Some(Err(e)) => {
                    return CliError::new(Code::Failed, format!("a worker broke: {e}"));
                }
                None => std::future::pending::<()>().await,
            }
        }
    }

    /// Stops the workers, which hand back or finish their work, then the coordinator.
    ///
    /// # Errors
    /// The coordinator ended with an error.
    pub async fn stop(mut self) -> Result<()> {
        self.stop_workers.cancel();
        while let Some(ended) = self.workers.join_next().await {
            if let Ok(Err(e)) = ended {
                tracing::warn!("worker: {e}");
            }
        }
        self.coordinator.stop().await
    }
}
