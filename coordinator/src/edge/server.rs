//! Starts and stops a coordinator.

use std::{io, net::SocketAddr, sync::Arc, time::Duration};

use futures::{FutureExt, future::BoxFuture};
use picofarm_catalog::{CatalogError, CatalogSource};
use picofarm_credentials::CredentialError;
use picofarm_proto::wire::{farm_server::FarmServer, jobs_server::JobsServer};
use tokio::{
    net::TcpListener,
    runtime::Handle,
    sync::{mpsc, watch},
    task::JoinHandle,
};
use tokio_util::sync::CancellationToken;
use tonic::transport::Server;

use super::{
    charged::{Charging, MAX_MESSAGE_BYTES},
    connections::{Connections, Streams, accept, follow_certificates, raise_open_files},
    guard::Guard,
    http::{self, GaugeCache, Pages},
    rpc::{FarmService, JobsService, Link},
    timed::Timed,
};
use crate::{
    actor::{Actor, Lanes, forget},
    auth::{Access, Gate, METHODS, OwnCode, Quotas, TokenError},
    core::{Backoff, Bound, Clock, Settings, UserQuotas},
    memory::{Memory, MemoryBounds},
    observe::{
        audit::Audit,
        health::{self, Health},
        metrics::Metrics,
    },
    submission::{ResultReader, Submissions},
};

/// Largest message of a worker: a heartbeat or hello that names some ten thousand leases.
const MAX_WORKER_MESSAGE_BYTES: usize = 1 << 20;
/// Most open requests of one connection. Further requests wait in the client.
const MAX_STREAMS: u32 = 100;
/// Bytes that a client may send ahead of reading, for one request and for one connection.
const STREAM_WINDOW: u32 = 64 << 10;
const CONNECTION_WINDOW: u32 = 256 << 10;
/// Largest headers of a request.
const MAX_HEADERS_BYTES: u32 = 16 << 10;
/// Commands that may wait for the actor. Further senders wait for room.
const QUEUE: usize = 8192;
/// Time limit for the last lines of the audit log.
const LAST_LINES: Duration = Duration::from_secs(5);
/// Interval between probes of an idle connection, and time limit of the answer.
const KEEPALIVE: Duration = Duration::from_secs(20);

/// Configuration of a coordinator.
#[derive(Debug, Clone)]
pub struct CoordinatorConfig {
    /// The catalog, which is created if missing.
    pub catalog: Arc<dyn CatalogSource>,
    /// Address to listen on; port 0 means any free port.
    pub listen: SocketAddr,
    /// Duration of a lease without a heartbeat, milliseconds (default 60,000).
    pub lease_ms: u32,
    /// Interval between workers' reports, milliseconds (default a sixth of a lease).
    pub heartbeat_ms: u32,
    /// Time in which a disconnected worker may reconnect, milliseconds (default 1,500).
    pub reconnect_ms: u32,
    /// Interval between checks for expired leases (default 250 ms).
    pub tick: Duration,
    /// Delays after failures.
    pub backoff: Backoff,
    /// The rest of a lease is shared with an idle worker if it takes at least this long,
    /// milliseconds (default 2,000).
    pub worth_ms: u32,
    /// Shortest run time after which an idle worker runs a task a second time, milliseconds
    /// (default 10,000). The task must also have taken three times the mean of its stage.
    pub slow_ms: u32,
    /// The clock of the leases.
    pub clock: Clock,
    /// Who may connect; by default anyone who reaches the address.
    pub access: Access,
    /// Quotas.
    pub quotas: Quotas,
    /// Whose jobs may bring Python code; by default nobody's.
    pub own_code: OwnCode,
    /// Bounds on connections.
    pub connections: Connections,
    /// Memory for requests and jobs.
    pub memory: MemoryBounds,
    /// Address of `/healthz`, `/readyz` and `/metrics`, which need no credentials; port 0 means any
    /// free port. By default they are not served.
    pub http: Option<SocketAddr>,
    /// Time after which ended jobs are forgotten with their history; by default never.
    pub forget_after: Option<Duration>,
    /// Time for which lines of the audit log are kept (default a year).
    pub audit_for: Duration,
    /// Reads stores to check recorded results. By default nothing does, and workers look for them.
    pub result_reader: Option<Arc<dyn ResultReader>>,
}

impl CoordinatorConfig {
    /// Returns the defaults for this catalog and address.
    pub fn new(catalog: impl CatalogSource + 'static, listen: SocketAddr) -> Self {
        Self {
            catalog: Arc::new(catalog),
            listen,
            lease_ms: 60_000,
            heartbeat_ms: 10_000,
            reconnect_ms: 1_500,
            tick: Duration::from_millis(250),
            backoff: Backoff::default(),
            worth_ms: 2_000,
            slow_ms: 10_000,
            clock: Clock::system(),
            access: Access::default(),
            quotas: Quotas::default(),
            own_code: OwnCode::default(),
            connections: Connections::default(),
            memory: MemoryBounds::default(),
            http: None,
            forget_after: None,
            audit_for: Duration::from_secs(365 * 86_400),
            result_reader: None,
        }
    }
}

/// The reason why a coordinator does not run.
#[derive(Debug, thiserror::Error)]
pub enum CoordinatorError {
    /// The address is in use.
    #[error(
        "cannot listen on {address}: the port is in use; is a coordinator running already? Choose another port, or 0 for any free one"
    )]
    AddressInUse {
        /// The address.
        address: SocketAddr,
    },
    /// The address cannot be used.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's error.
        source: io::Error,
    },
    /// A time in the configuration is invalid.
    #[error("{0}")]
    Config(String),
    /// A certificate or key cannot be used.
    #[error(transparent)]
    Credentials(#[from] CredentialError),
    /// The token file cannot be used.
    #[error(transparent)]
    Tokens(#[from] TokenError),
    /// The catalog cannot be used.
    #[error(transparent)]
    Catalog(#[from] CatalogError),
    /// The server failed.
    #[error("the server stopped: {0}")]
    Server(#[from] tonic::transport::Error),
}

/// A running coordinator.
#[derive(Debug)]
pub struct Running {
    /// The listening address, with the actual port.
    pub address: SocketAddr,
    /// The listening address of the HTTP endpoint.
    pub http: Option<SocketAddr>,
    /// Ends after a shutdown, when the catalog is closed.
    pub task: JoinHandle<Result<(), CoordinatorError>>,
}

impl Running {
    /// Waits until the coordinator has stopped.
    ///
    /// # Errors
    /// Returns the error that stopped it, if `shutdown` did not.
    ///
    /// # Panics
    /// Panics if its task panicked.
    pub async fn wait(self) -> Result<(), CoordinatorError> {
        self.task.await.expect("the server task does not panic")
    }
}

async fn listen(address: SocketAddr) -> Result<(TcpListener, SocketAddr), CoordinatorError> {
    let failed = |source: io::Error| match source.kind() {
        io::ErrorKind::AddrInUse => CoordinatorError::AddressInUse { address },
        _ => CoordinatorError::Listen { address, source },
    };
    let listener = TcpListener::bind(address).await.map_err(failed)?;
    let address = listener.local_addr().map_err(failed)?;
    Ok((listener, address))
}

/// Starts a coordinator. It runs until `shutdown` is cancelled, and cancels `shutdown` if it ends
/// by itself. Clients may connect when this returns.
///
/// # Errors
/// Returns [`CoordinatorError`] if the address or the catalog cannot be used.
pub fn serve(
    config: CoordinatorConfig,
    shutdown: CancellationToken,
) -> BoxFuture<'static, Result<Running, CoordinatorError>> {
    // Boxed, so that crates that await it do not compile the server again.
    start(config, shutdown).boxed()
}

async fn start(
    config: CoordinatorConfig,
    shutdown: CancellationToken,
) -> Result<Running, CoordinatorError> {
    if config.heartbeat_ms == 0 || config.lease_ms < 2 * config.heartbeat_ms {
        return Err(CoordinatorError::Config(format!(
            "heartbeat_ms {} must be at least 1 and at most half of lease_ms {}",
            config.heartbeat_ms, config.lease_ms
        )));
    }
    let tls = match &config.access.tls {
        None => None,
        Some(files) => {
            let loaded = files.read()?;
            files.tell(&loaded);
            Some((files.clone(), loaded))
        }
    };
    let slots = config.connections.slots(raise_open_files(), config.memory);
    let slots = Arc::new(slots);
    let counted = Arc::clone(&slots);
    let memory = Memory::new(config.memory, move || counted.counts().open);
    let memory = Arc::new(memory);
    let (all, per_address) = slots.bounds();
    let mib = config.memory.process >> 20;
    tracing::info!(mib, all, per_address, "memory and connections at most");
    let (audit, writer) = Audit::new(config.clock.clone());
    let metrics = Metrics::new(METHODS.iter().map(|(method, _)| *method));
    let (metrics, health) = (Arc::new(metrics), Arc::new(Health::default()));
    let (gate, judge) = Gate::new(
        &config.access,
        &audit,
        Arc::clone(&health),
        shutdown.clone(),
    )?;
    let (listener, address) = listen(config.listen).await?;
    let endpoint = match config.http {
        Some(address) => Some(listen(address).await?),
        None => None,
    };
    let http = endpoint.as_ref().map(|(_, address)| *address);
    let holder = format!("process {}, listening on {address}", std::process::id());
    let catalog = config.catalog.open(&holder).await?;

    let writer = writer.run(Arc::clone(&catalog), config.audit_for, config.clock.clone());
    let writer = tokio::spawn(writer);
    let (commands, queue) = mpsc::channel(QUEUE);
    let (revision, seen) = watch::channel(0);
    let writes = health::try_writes(Arc::clone(&health), Arc::clone(&catalog), shutdown.clone());
    tokio::spawn(writes);
    let lanes = Lanes::new(shutdown.clone());
    let submissions = Submissions::new(
        Arc::clone(&catalog),
        lanes.clone(),
        config.result_reader,
        commands.clone(),
        config.clock.clone(),
        config.access.visibility,
        Arc::clone(&memory),
    );
    let actor = Actor {
        catalog: Arc::clone(&catalog),
        settings: Settings {
            lease_ms: config.lease_ms,
            reconnect_ms: config.reconnect_ms,
            backoff: config.backoff,
            worth_ms: config.worth_ms,
            slow_ms: config.slow_ms,
        },
        tick: config.tick,
        clock: config.clock.clone(),
        revision,
        metrics: Arc::clone(&metrics),
        health: Arc::clone(&health),
        stop: shutdown.clone(),
        memory: Arc::clone(&memory),
        quotas: {
            let (gate, every) = (gate.clone(), config.quotas);
            Box::new(move || UserQuotas {
                cores: Bound {
                    every: every.cores_per_user,
                    of: gate.bounds(|entry| entry.max_cores),
                },
                bytes: Bound {
                    every: every.bytes_per_user,
                    of: gate.bounds(|entry| entry.max_bytes),
                },
            })
        },
        slow_work: Arc::new(submissions.clone()),
    };
    let link = Link {
        commands,
        revision: seen,
        catalog: Arc::clone(&catalog),
        visibility: config.access.visibility,
        audit: audit.clone(),
        stop: shutdown.clone(),
        name: holder.into(),
        clock: config.clock,
        lease_ms: config.lease_ms,
        heartbeat_ms: config.heartbeat_ms,
        lanes,
        submissions,
        examinations: Arc::default(),
    };
    if let Some((listener, address)) = endpoint {
        let pages = Pages {
            link: link.clone(),
            metrics: Arc::clone(&metrics),
            health,
            memory: Arc::clone(&memory),
            slots: Arc::clone(&slots),
            gauges: GaugeCache::default(),
            main: Handle::current(),
        };
        tracing::info!(%address, "health and metrics over HTTP");
        let failed = |source| CoordinatorError::Listen { address, source };
        let listener = listener.into_std().map_err(failed)?;
        http::start(listener, Arc::new(pages), shutdown.clone()).map_err(failed)?;
    }
    if let Some(age) = config.forget_after {
        let (catalog, clock) = (Arc::clone(&link.catalog), link.clock.clone());
        tokio::spawn(forget::run(catalog, clock, age, shutdown.clone()));
    }
    let actor = tokio::spawn(actor.run(queue));
    let tls = tls.map(|(files, loaded)| {
        follow_certificates(files, loaded, judge, audit.clone(), shutdown.clone())
    });
    let connections = accept(listener, slots, config.connections, tls, shutdown.clone());
    let server = Server::builder()
        .http2_max_header_list_size(Some(MAX_HEADERS_BYTES))
        .max_concurrent_streams(MAX_STREAMS)
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .layer(Timed(metrics))
        .layer(Guard::new(gate, audit))
        .layer(Charging(Arc::clone(&memory)))
        .layer(Streams)
        .http2_keepalive_interval(Some(KEEPALIVE))
        .http2_keepalive_timeout(Some(KEEPALIVE))
        .add_service(
            JobsServer::new(JobsService::new(
                link.clone(),
                config.quotas,
                config.own_code,
            ))
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES),
        )
        .add_service(
            FarmServer::new(FarmService::new(link, config.quotas))
                .max_decoding_message_size(MAX_WORKER_MESSAGE_BYTES)
                .max_encoding_message_size(MAX_MESSAGE_BYTES),
        )
        .serve_with_incoming_shutdown(connections, shutdown.clone().cancelled_owned());
    let task = tokio::spawn(async move {
        let served = server.await;
        // A failed server also ends the actor.
        shutdown.cancel();
        actor.await.expect("the actor catches panics");
        // Waits for pending lines. A handler that hangs keeps its sender open, and must not keep
        // the catalog open.
        let _ = tokio::time::timeout(LAST_LINES, writer).await;
        catalog.close().await;
        Ok(served?)
    });
    tracing::info!(%address, catalog = %config.catalog, "coordinator listens");
    Ok(Running {
        address,
        http,
        task,
    })
}
