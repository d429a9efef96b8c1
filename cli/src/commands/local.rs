//! A coordinator in this process and workers in processes of their own, for `demo` and `up`.

mod keeper;

use std::{net::SocketAddr, path::Path, time::Duration};

use picofarm_proto::ids::WorkerId;
use picofarm_tasks::Memory;
use tokio::task::JoinSet;
use uuid::Uuid;

use self::keeper::Keeper;
use crate::{
    args::OwnPython,
    commands::{
        coordinator::{Coordinator, Guarded, stored::StoreReader},
        local_worker::Order,
    },
    error::{CliError, Code, Result},
    settings::Settings,
};

/// Duration of a lease. It is short because after a `kill -9` of this process the next run waits
/// for it to expire, and because no network delays heartbeats.
const LEASE: Duration = Duration::from_secs(20);

/// A farm on this machine.
pub struct Local {
    pub url: String,
    /// URL of its health and metrics.
    pub http: Option<String>,
    coordinator: Coordinator,
    keepers: Vec<Keeper>,
    workers: JoinSet<Result<()>>,
}

impl Local {
    /// Starts a coordinator on `catalog` and `workers` workers that share the cores and GPUs. Each
    /// worker has a process of its own, so that its death affects neither the coordinator nor the
    /// other workers.
    ///
    /// # Errors
    /// Fails if the catalog is in use or unreadable, the address is in use, or a process cannot be
    /// started.
    pub async fn start(
        catalog: &Path,
        listen: SocketAddr,
        (workers, gpus, own): (usize, &[String], &OwnPython),
        settings: &Settings,
        mut guarded: Guarded,
        http: Option<SocketAddr>,
        otlp: Option<String>,
    ) -> Result<Self> {
        if own.python.is_some() {
            guarded.allow_python();
        }
        let open = guarded.is_open();
        if !open {
            // Errors in the settings are reported here once, and not by each worker.
            settings.access()?;
        }
        let coordinator = Coordinator::start(
            catalog.to_owned().into(),
            listen,
            LEASE,
            guarded,
            http,
            None,
            // The workers run on this machine as the same user, and access whatever stores a job
            // names.
            Some(StoreReader::anywhere()?),
        )
        .await?;
        let (url, http) = (coordinator.url(), coordinator.http());
        let mut local = Self {
            url: url.clone(),
            http,
            coordinator,
            keepers: Vec::new(),
            workers: JoinSet::new(),
        };
        let cores = picofarm_tasks::cores();
        let memory = Memory::here();
        for i in 0..workers {
            let order = Order {
                settings: settings.clone(),
                coordinator: url.clone(),
                open,
                name: format!("local-{}", i + 1),
                worker_id: WorkerId::from_uuid(Uuid::new_v4()),
                threads: (cores / workers + usize::from(i < cores % workers)).max(1),
                memory_mib: memory.as_ref().map_or(0, Memory::for_tasks_mib)
                    / workers.max(1) as u64,
                memory_from: match &memory {
                    Some(memory) => format!("{memory}, shared by {workers} worker(s)"),
                    None => String::new(),
                },
                gpus: gpus.iter().skip(i).step_by(workers).cloned().collect(),
                own: own.clone(),
                otlp: otlp.clone(),
                ended: String::new(),
            };
            let (keeper, ended) = Keeper::start(order)?;
            local.keepers.push(keeper);
            local.workers.spawn(async move {
                let broke = |_| CliError::new(Code::Failed, "the thread of a worker broke");
                ended.await.map_err(broke)?
            });
        }
        Ok(local)
    }

    /// Resolves when a worker is refused or cannot be started, which does not happen in a healthy
    /// farm.
    pub async fn worker_lost(&mut self) -> CliError {
        loop {
            match self.workers.join_next().await {
                // The worker was drained. The others continue, and without any, the farm waits for
                // workers from elsewhere.
                Some(Ok(Ok(()))) => tracing::info!("a worker has ended"),
                Some(Ok(Err(e))) => return e,
                Some(Err(e)) => {
                    return CliError::new(Code::Failed, format!("a worker broke: {e}"));
                }
                None => std::future::pending::<()>().await,
            }
        }
    }

    /// Stops the workers, which hand back or finish their work, and then the coordinator.
    ///
    /// # Errors
    /// Fails if the coordinator ended with an error.
    pub async fn stop(mut self) -> Result<()> {
        for keeper in &self.keepers {
            keeper.stop();
        }
        while let Some(ended) = self.workers.join_next().await {
            if let Ok(Err(e)) = ended {
                tracing::warn!("worker: {}", e.message);
            }
        }
        self.coordinator.stop().await
    }
}
