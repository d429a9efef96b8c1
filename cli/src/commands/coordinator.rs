//! `picofarm coordinator`.

pub(super) mod stored;

use std::{net::SocketAddr, sync::Arc, time::Duration};

use picofarm_coordinator::{
    Connections, CoordinatorConfig, CoordinatorError, MemoryBounds, ResultReader, Running,
    auth::{Access, OwnCode, Quotas, TlsFiles},
    serve,
};
use picofarm_database::CatalogPlace;
use picofarm_tasks::Memory;
use serde_json::json;
use tokio_util::sync::CancellationToken;

use self::stored::StoreReader;
use crate::{
    args,
    error::{CliError, Code, Result},
    output::Output,
    signals,
};

/// Access rules and limits of a coordinator.
#[derive(Default)]
pub struct Guarded {
    access: Access,
    quotas: Quotas,
    connections: Connections,
    own_code: OwnCode,
    /// Memory limit of the process, in MiB.
    memory_mib: Option<u64>,
    /// Number of days for which the audit log is retained.
    audit_days: Option<u32>,
}

impl Guarded {
    /// Creates the rules from the options.
    pub fn from_args(args: &args::Guard) -> Self {
        let pair = args.tls_cert.clone().zip(args.tls_key.clone());
        Self {
            access: Access {
                tls: pair.map(|(certificate, key)| TlsFiles {
                    certificate,
                    key,
                    client_ca: args.client_ca.clone(),
                }),
                tokens: args.tokens.clone(),
                visibility: args.visibility,
            },
            quotas: Quotas {
                jobs_per_user: args.max_jobs_per_user,
                cores_per_user: args.max_cores_per_user,
                bytes_per_user: args.max_bytes_per_user,
                tasks_per_job: args.max_tasks_per_job,
                sessions: args.max_sessions,
                max_priority: args.max_priority,
            },
            connections: Connections {
                all: args.max_connections,
                per_address: args.max_connections_per_address,
                ..Connections::default()
            },
            own_code: args.allow_python.clone().unwrap_or_default(),
            memory_mib: args.memory_mib,
            audit_days: Some(args.audit_days),
        }
    }

    /// Accepts jobs with Python code from everyone, unless the options say otherwise.
    pub fn allow_python(&mut self) {
        if self.own_code == OwnCode::Nobody {
            self.own_code = OwnCode::Everyone;
        }
    }

    /// Returns whether anyone who reaches the address has access, over plain HTTP.
    pub fn is_open(&self) -> bool {
        self.access.tls.is_none() && !self.access.authenticates()
    }
}

/// Rejects an unprotected address. On loopback, only `up` and `demo` need no tokens or client
/// certificates. Any other address needs them and TLS. `--allow-insecure` overrides both.
///
/// # Errors
/// Fails if the options leave the address unprotected.
pub fn refuse_unguarded(listen: SocketAddr, args: &args::Guard, up: bool) -> Result<()> {
    if args.allow_insecure {
        return Ok(());
    }
    let known = args.tokens.is_some() || args.client_ca.is_some();
    let loopback = listen.ip().is_loopback();
    let hint = |error: CliError| {
        error.hint(
            "make a token with `picofarm token create --name NAME --role submit,work` and give --tokens FILE; or say \
             --allow-insecure where everyone who reaches the address is trusted",
        )
    };
    if !known && loopback && !up {
        return Err(hint(CliError::input(format!(
            "--listen {listen}: every user of this machine could submit jobs, since neither --tokens nor --client-ca is given"
        ))));
    }
    if !known && !loopback {
        return Err(hint(CliError::input(format!(
            "--listen {listen}: anyone who reaches this address could submit jobs, since neither --tokens nor --client-ca is \
             given"
        ))));
    }
    if args.tls_cert.is_none() && !loopback {
        return Err(CliError::input(format!(
            "--listen {listen}: tokens would cross the network in the clear, since there is no TLS"
        ))
        .hint(
            "give --tls-cert and --tls-key, or listen on 127.0.0.1; or say --allow-insecure where something else encrypts",
        ));
    }
    Ok(())
}

/// Maximum memory of a coordinator if no limit is known.
const COORDINATOR_MIB: u64 = 4096;

/// Returns the memory bound of a coordinator's process: the requested amount or the default, but at
/// most the system's limit, because the system would kill a process that exceeds it.
fn memory(asked_mib: Option<u64>) -> MemoryBounds {
    let here = Memory::here().map_or(u64::MAX, |memory| memory.bytes);
    let most = asked_mib.unwrap_or(COORDINATOR_MIB) << 20;
    MemoryBounds {
        process: most.min(here),
    }
}

/// A running coordinator.
pub struct Coordinator {
    running: Running,
    secure: bool,
    stop: CancellationToken,
}

impl Coordinator {
    /// Starts a coordinator on `catalog`, creating the catalog if needed. A worker sends a
    /// heartbeat every sixth of a lease.
    ///
    /// # Errors
    /// Fails if the catalog is in use, unreadable or of a newer version, or if the address is in
    /// use.
    pub async fn start(
        catalog: CatalogPlace,
        listen: SocketAddr,
        lease: Duration,
        guarded: Guarded,
        http: Option<SocketAddr>,
        forget_after: Option<Duration>,
        stored: Option<StoreReader>,
    ) -> Result<Self> {
        let mut config = CoordinatorConfig::new(catalog, listen);
        config.lease_ms = u32::try_from(lease.as_millis()).unwrap_or(u32::MAX);
        config.heartbeat_ms = (config.lease_ms / 6).max(1);
        config.tick = config.tick.min(lease / 6);
        let secure = guarded.access.tls.is_some();
        config.access = guarded.access;
        config.quotas = guarded.quotas;
        config.own_code = guarded.own_code;
        config.connections = guarded.connections;
        config.memory = memory(guarded.memory_mib);
        if let Some(days) = guarded.audit_days {
            config.audit_for = Duration::from_secs(u64::from(days) * 86_400);
        }
        config.http = http;
        config.forget_after = forget_after;
        config.result_reader = stored.map(|reader| Arc::new(reader) as Arc<dyn ResultReader>);
        let stop = CancellationToken::new();
        let running = serve(config, stop.clone())
            .await
            .map_err(|e| coordinator_error(&e))?;
        Ok(Self {
            running,
            secure,
            stop,
        })
    }

    /// Returns the URL for clients on this machine. With TLS this is localhost, because
    /// certificates are for names.
    pub fn url(&self) -> String {
        let address = self.running.address;
        match self.secure {
            true => format!("https://localhost:{}", address.port()),
            false => format!("http://{address}"),
        }
    }

    /// Returns the URL of its health and metrics.
    pub fn http(&self) -> Option<String> {
        self.running.http.map(|address| format!("http://{address}"))
    }

    /// Stops the coordinator and waits until the catalog is closed.
    ///
    /// # Errors
    /// Fails if an error had already ended the coordinator.
    pub async fn stop(self) -> Result<()> {
        self.stop.cancel();
        self.running.wait().await.map_err(|e| coordinator_error(&e))
    }
}

fn coordinator_error(error: &CoordinatorError) -> CliError {
    let code = match error {
        CoordinatorError::Config(_)
        | CoordinatorError::Credentials(_)
        | CoordinatorError::Tokens(_) => Code::Input,
        CoordinatorError::Server(_) => Code::Failed,
        _ => Code::Resource,
    };
    CliError::new(code, error)
}

/// Runs a coordinator until a signal.
///
/// # Errors
/// See [`Coordinator::start`].
pub async fn run(args: args::Coordinator, output: Output) -> Result<()> {
    refuse_unguarded(args.listen, &args.guard, false)?;
    let forget_after = args
        .forget_after_days
        .map(|days| Duration::from_secs_f64(days * 86_400.0));
    let stored = StoreReader::asked_for(&args.check_stores)?;
    let stop = signals::stop_on_signal()?;
    let lease = Duration::from_secs_f64(args.lease_s);
    let guarded = Guarded::from_args(&args.guard);
    let coordinator = Coordinator::start(
        args.catalog.clone(),
        args.listen,
        lease,
        guarded,
        args.http.http,
        forget_after,
        stored,
    )
    .await?;
    let (url, http) = (coordinator.url(), coordinator.http());
    output.result(
        &json!({"coordinator": url, "catalog": args.catalog.to_string(), "http": http}),
        || {
            let metrics = http
                .as_ref()
                .map_or_else(String::new, |at| format!(", metrics at {at}/metrics"));
            format!("coordinator at {url} on {}{metrics}", args.catalog)
        },
    );
    stop.cancelled().await;
    coordinator.stop().await
}
