//! `picofarm coordinator` and `picofarm worker`: one role in one process.

use std::{net::SocketAddr, path::Path, time::Duration};

use picofarm_agent::{AgentConfig, AgentError};
use picofarm_coordinator::{CoordinatorConfig, CoordinatorError, Running, serve};
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

/// There is no authentication yet: beyond loopback only on request.
///
/// # Errors
/// The address is not loopback and `allowed` is false.
pub fn refuse_beyond_loopback(listen: SocketAddr, allowed: bool) -> Result<()> {
    if listen.ip().is_loopback() || allowed {
        return Ok(());
    }
    Err(CliError::input(format!(
        "--listen {listen}: anyone who reaches this address could submit jobs, since there is no authentication yet"
    ))
    .hint("listen on 127.0.0.1, or run `picofarm coordinator --allow-insecure` on a private network"))
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
            ended.hint("compare `picofarm --version` on both machines and install the same one")
        }
        _ => ended,
    }
}

/// A running coordinator.
pub struct Coordinator {
    running: Running,
    stop: CancellationToken,
}

impl Coordinator {
    /// Starts one on `catalog`, creating it if there is none. A worker reports every sixth of a lease.
    ///
    /// # Errors
    /// The catalog is in use, unreadable or of a newer version, or the address is taken.
    pub async fn start(catalog: &Path, listen: SocketAddr, lease: Duration) -> Result<Self> {
        let mut config = CoordinatorConfig::new(catalog.to_owned(), listen);
        config.lease_ms = u32::try_from(lease.as_millis()).unwrap_or(u32::MAX);
        config.heartbeat_ms = (config.lease_ms / 6).max(1);
        config.tick = config.tick.min(lease / 6);
        let stop = CancellationToken::new();
        let running = serve(config, stop.clone())
            .await
            .map_err(|e| coordinator_error(&e))?;
        Ok(Self { running, stop })
    }

    pub fn address(&self) -> SocketAddr {
        self.running.address
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
        CoordinatorError::Config(_) => Code::Input,
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
    refuse_beyond_loopback(args.listen, args.allow_insecure)?;
    if !(args.lease_s >= 0.1 && args.lease_s <= 86_400.0) {
        return Err(CliError::input(format!(
            "--lease-s {}: expected 0.1 to 86400 seconds",
            args.lease_s
        )));
    }
    let stop = signals::stop_on_signal()?;
    let lease = Duration::from_secs_f64(args.lease_s);
    let coordinator = Coordinator::start(&args.catalog, args.listen, lease).await?;
    let url = format!("http://{}", coordinator.address());
    output.result(
        &json!({"coordinator": url, "catalog": args.catalog}),
        || format!("coordinator at {url} on {}", args.catalog.display()),
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
        asset_dirs: vec![settings.assets.clone()],
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
