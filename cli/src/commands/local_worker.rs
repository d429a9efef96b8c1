//! A worker process with `demo` or `up` as its parent. It reads one line with its settings. Then it
//! reads until the line `stop`, which asks for an orderly end, or until the end of its input: then
//! the parent has died, and the process ends at once.

use std::io::{BufRead, Write};

use picofarm_proto::ids::WorkerId;
use picofarm_settings::Gpus;
use picofarm_tasks::{Access, AgentConfig};
use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use super::worker;
use crate::{
    args::OwnPython,
    error::{CliError, Code, Result, io},
    settings::Settings,
    signals,
};

/// Name of the hidden command.
pub(crate) const COMMAND: &str = "local-worker";
/// The line that asks for an orderly end.
pub(crate) const STOP: &str = "stop";
/// The kernel's OOM score adjustment (−1000 to 1000), so that a worker is killed before the
/// coordinator or another process when memory runs out.
const OOM_SCORE: &str = "800";

/// Arguments of a worker process.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Order {
    /// The parent's settings.
    pub settings: Settings,
    /// URL of the coordinator.
    pub coordinator: String,
    /// Whether the coordinator requires no authentication.
    pub open: bool,
    /// Name of the worker, for display.
    pub name: String,
    /// Id of the worker, the same for all its processes.
    pub worker_id: WorkerId,
    /// Number of threads for tasks.
    pub threads: usize,
    /// Memory that tasks may use, in MiB.
    pub memory_mib: u64,
    /// Source of that limit.
    pub memory_from: String,
    /// GPUs, by name.
    pub gpus: Vec<String>,
    /// The Python that runs code of jobs, and its environments.
    pub own: OwnPython,
    /// URL of the trace collector.
    pub otlp: Option<String>,
    /// How the previous process ended; empty for the first.
    pub ended: String,
}

/// The last line that a worker process writes: how it ended.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Verdict {
    /// Exit code of an error; 0 = it was asked to end.
    code: u8,
    message: String,
    hint: Option<String>,
}

impl From<Verdict> for Result<()> {
    fn from(verdict: Verdict) -> Self {
        let code = match verdict.code {
            0 => return Ok(()),
            3 => Code::Input,
            4 => Code::Coordinator,
            7 => Code::Resource,
            _ => Code::Failed,
        };
        let mut error = CliError::new(code, verdict.message);
        error.hint = verdict.hint;
        Err(error)
    }
}

/// Reads the parent's order.
///
/// # Errors
/// Fails if there is none, because a user has called the command.
pub fn received() -> Result<Order> {
    let mut line = String::new();
    let read = std::io::stdin().lock().read_line(&mut line);
    read.map_err(|e| io("standard input", &e))?;
    serde_json::from_str(&line).map_err(|e| {
        CliError::input(format!("{COMMAND}: standard input holds no order ({e})"))
            .hint("this command is for `picofarm up` and `picofarm demo`; use `picofarm worker`")
    })
}

/// Runs the worker until its parent ends it.
///
/// # Errors
/// Does not fail: errors are written for the parent.
pub async fn serve(order: Order) -> Result<()> {
    let verdict = match work(order).await {
        Ok(()) => Verdict {
            code: 0,
            message: String::new(),
            hint: None,
        },
        Err(e) => Verdict {
            code: e.code as u8,
            message: e.message,
            hint: e.hint,
        },
    };
    let text = serde_json::to_string(&verdict).expect("a verdict is plain data");
    // Without a parent, nobody reads the line.
    let _ = writeln!(std::io::stdout(), "{text}");
    Ok(())
}

async fn work(order: Order) -> Result<()> {
    // In addition to the end of the input, which a frozen process does not notice. On systems
    // without this signal, the end of the input must suffice.
    let _ = set_parent_process_death_signal(Some(Signal::KILL));
    // Raising the score needs no rights. A system without this file chooses in another way.
    let _ = std::fs::write("/proc/self/oom_score_adj", OOM_SCORE);
    let stop = CancellationToken::new();
    listen(stop.clone())?;
    heed_signals(stop.clone())?;
    let access = match order.open {
        true => Access::default(),
        false => order.settings.access()?,
    };
    let config = AgentConfig {
        coordinator: order.coordinator,
        name: order.name,
        worker_id: Some(order.worker_id),
        ended: order.ended,
        threads: order.threads,
        memory_mib: order.memory_mib,
        memory_from: order.memory_from,
        gpus: Gpus::named(order.gpus),
        peers: "127.0.0.1".into(),
        labels: Vec::new(),
        exit_idle: None,
        ends_at: crate::args::end_time::ends_at(None, std::time::SystemTime::now())?,
        asset_dirs: vec![order.settings.assets],
        python: order.own.python,
        python_environments: order.own.python_environments,
        access,
        store_prefixes: Vec::new(),
    };
    let summary = picofarm_tasks::run(config, stop).await;
    summary.map(|_| ()).map_err(|e| worker::agent_error(&e))
}

/// Listens to the parent, on a thread of its own so that nothing delays it.
fn listen(stop: CancellationToken) -> Result<()> {
    let listener = move || {
        for line in std::io::stdin().lock().lines() {
            match line {
                Ok(line) if line.trim() == STOP => stop.cancel(),
                Ok(_) => {}
                Err(_) => break,
            }
        }
        // There is no parent left to assign work or receive results.
        std::process::exit(Code::Failed as i32);
    };
    std::thread::Builder::new()
        .name("parent".into())
        .spawn(listener)
        .map_err(|e| CliError::new(Code::Resource, format!("cannot start a thread: {e}")))?;
    Ok(())
}

/// Ignores Ctrl-C in a terminal and the closing of the terminal, because the parent receives them
/// too and decides. A SIGTERM may be meant for this process alone.
fn heed_signals(stop: CancellationToken) -> Result<()> {
    let refused =
        |e: std::io::Error| CliError::new(Code::Failed, format!("cannot listen for signals: {e}"));
    let mut interrupt = signal(SignalKind::interrupt()).map_err(refused)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(refused)?;
    let mut hangup = signals::hangups().map_err(refused)?;
    tokio::spawn(async move {
        loop {
            tokio::select! {
                _ = interrupt.recv() => {}
                () = hangup.next() => {}
                _ = terminate.recv() => stop.cancel(),
            }
        }
    });
    Ok(())
}
