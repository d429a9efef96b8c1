//! `picofarm coordinator` and `picofarm worker`: one role in one process.

use std::{net::SocketAddr, time::Duration};

use picofarm_agent::{AgentConfig, AgentError};
use picofarm_coordinator::{
    CatalogPlace, CoordinatorConfig, CoordinatorError, Running,
    auth::{Access, Quotas, TlsFiles},
    serve,
};
use serde_json::json;
use tokio_util::sync::CancellationToken;

use crate::{
    args,
    error::{CliError, Code, Result},
    output::Output,
    settings::Settings,
    signals,
};

/// Cores of this machine.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Whom a coordinator lets in, and how much they may ask of it.
#[derive(Default)]
pub struct Guarded {
    access: Access,
    quotas: Quotas,
}

impl Guarded {
    /// As the options say.
    pub fn of(args: &args::Guard) -> Self {
        let pair = args.tls_cert.clone().zip(args.tls_key.clone());
        Self {
            access: Access {
                tls: pair.map(|(certificate, key)| TlsFiles {
                    certificate,
                    key,
                    client_ca: args.client_ca.clone(),
                }),
                tokens: args.tokens.clone(),
            },
            quotas: Quotas {
                jobs_per_user: args.max_jobs_per_user,
                tasks_per_job: args.max_tasks_per_job,
                sessions: args.max_sessions,
            },
        }
    }

    /// Whether whoever reaches the address may come in, over plain HTTP.
    pub fn is_open(&self) -> bool {
        self.access.tls.is_none() && !self.access.authenticates()
    }
}

/// On loopback, only `up` (and `demo`) do without tokens or client certificates; beyond it, all need them and TLS;
/// unless asked for with --allow-insecure.
///
/// # Errors
/// The options leave open what they must not.
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

/// What a worker's end means for the exit code.
pub fn agent_error(error: &AgentError) -> CliError {
    let code = match error {
        AgentError::Refused { .. } => Code::Coordinator,
        AgentError::Threads { .. } => Code::Resource,
        _ => Code::Input,
    };
    let ended = CliError::new(code, error);
    match error {
        AgentError::Refused { .. } => {
            // Others are about tokens and certificates, and say themselves what to do.
            let text = error.to_string();
            if ["version", "protocol"]
                .iter()
                .any(|word| text.contains(word))
            {
                ended.hint("compare `picofarm --version` on both machines and install the same one")
            } else {
                ended
            }
        }
        _ => ended,
    }
}

/// A running coordinator.
pub struct Coordinator {
    running: Running,
    secure: bool,
    stop: CancellationToken,
}

impl Coordinator {
    /// Starts one on `catalog`, creating it if there is none. A worker reports every sixth of a lease.
    ///
    /// # Errors
    /// The catalog is in use, unreadable or of a newer version, or the address is taken.
    pub async fn start(
        catalog: CatalogPlace,
        listen: SocketAddr,
        lease: Duration,
        guarded: Guarded,
        http: Option<SocketAddr>,
        forget_after: Option<Duration>,
    ) -> Result<Self> {
        let mut config = CoordinatorConfig::new(catalog, listen);
        config.lease_ms = u32::try_from(lease.as_millis()).unwrap_or(u32::MAX);
        config.heartbeat_ms = (config.lease_ms / 6).max(1);
        config.tick = config.tick.min(lease / 6);
        let secure = guarded.access.tls.is_some();
        config.access = guarded.access;
        config.quotas = guarded.quotas;
        config.http = http;
        config.forget_after = forget_after;
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

    /// Where clients on this machine reach it. Certificates are for names, so with TLS this is localhost.
    pub fn url(&self) -> String {
        let address = self.running.address;
        match self.secure {
            true => format!("https://localhost:{}", address.port()),
            false => format!("http://{address}"),
        }
    }

    /// Where its health and metrics are served.
    pub fn http(&self) -> Option<String> {
        self.running.http.map(|address| format!("http://{address}"))
    }

    /// Stops it and waits until the catalog is closed.
    ///
    /// # Errors
    /// What had ended it before.
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

/// `picofarm coordinator`.
///
/// # Errors
/// See [`Coordinator::start`].
pub async fn coordinator(args: args::Coordinator, output: Output) -> Result<()> {
    refuse_unguarded(args.listen, &args.guard, false)?;
    if !(args.lease_s >= 0.1 && args.lease_s <= 86_400.0) {
        return Err(CliError::input(format!(
            "--lease-s {}: expected 0.1 to 86400 seconds",
            args.lease_s
        )));
    }
    let forget_after = match args.forget_after_days {
        None => None,
        Some(days) if (0.0..=36_500.0).contains(&days) => {
            Some(Duration::from_secs_f64(days * 86_400.0))
        }
        Some(days) => {
            return Err(CliError::input(format!(
                "--forget-after-days {days}: expected 0 to 36500 days"
            )));
        }
    };
    let stop = signals::stop_on_signal()?;
    let lease = Duration::from_secs_f64(args.lease_s);
    let guarded = Guarded::of(&args.guard);
    let coordinator = Coordinator::start(
        args.catalog.clone(),
        args.listen,
        lease,
        guarded,
        args.http.http,
        forget_after,
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

/// `picofarm worker`.
///
/// # Errors
/// A setting out of range, or a coordinator that refuses this worker.
pub async fn worker(args: args::Worker, settings: &Settings, output: Output) -> Result<()> {
    let stop = signals::stop_on_signal()?;
    let config = AgentConfig {
        coordinator: settings.coordinator.clone(),
        name: args.name.unwrap_or_else(default_name),
        worker_id: None,
        threads: args.threads.unwrap_or_else(cores),
        memory_mib: args
            .memory_gib
            .map_or_else(picofarm_agent::memory_mib, |gib| (gib * 1024.0) as u64),
        gpus: args.gpus,
        labels: args.label,
        exit_idle: args.exit_idle_s.map(Duration::from_secs),
        asset_dirs: vec![settings.assets.clone()],
        access: settings.access()?,
        store_prefixes: args.store_prefix,
    };
    output.say(format!("worker {} for {}", config.name, config.coordinator));
    let summary = picofarm_agent::run(config, stop)
        .await
        .map_err(|e| agent_error(&e))?;
    output.result(
        &json!({"computed": summary.computed, "adopted": summary.adopted, "failed": summary.failed,
                "reconnects": summary.reconnects, "unacknowledged": summary.unacknowledged}),
        || {
            format!(
                "{} computed, {} adopted, {} failed",
                summary.computed, summary.adopted, summary.failed
            )
        },
    );
    Ok(())
}

fn default_name() -> String {
    let host = std::fs::read_to_string("/etc/hostname").unwrap_or_default();
    let host = match host.trim() {
        "" => "worker",
        name => name,
    };
    format!("{host}-{}", std::process::id())
}
