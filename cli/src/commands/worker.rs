//! `picofarm worker`.

use std::time::{Duration, SystemTime};

use picofarm_tasks::{AgentConfig, AgentError, Memory};
use serde_json::json;

use crate::{
    args::{Worker, end_time},
    error::{CliError, Code, Result},
    output::Output,
    settings::Settings,
    signals,
};

/// Runs a worker until a signal, its end time, or until it has been idle for too long.
///
/// # Errors
/// Fails if a setting is out of range, or the coordinator refuses this worker.
pub async fn run(args: Worker, settings: &Settings, output: Output) -> Result<()> {
    if let Some(gib) = args.memory_gib.filter(|gib| !(0.001..=1e6).contains(gib)) {
        return Err(CliError::input(format!(
            "--memory-gib {gib}: expected 0.001 to 1000000 GiB"
        )));
    }
    let memory = Memory::for_tasks(args.memory_gib);
    let stop = signals::stop_on_signal()?;
    let config = AgentConfig {
        coordinator: settings.coordinator.clone(),
        name: args.name.unwrap_or_else(default_name),
        worker_id: None,
        ended: String::new(),
        threads: args.threads.unwrap_or_else(picofarm_tasks::cores),
        memory_mib: memory.as_ref().map_or(0, Memory::for_tasks_mib),
        memory_from: memory.map_or_else(String::new, |memory| memory.to_string()),
        gpus: args.gpus,
        peers: args.peers,
        labels: args.label,
        exit_idle: args.exit_idle_s.map(Duration::from_secs),
        ends_at: end_time::ends_at(args.end_at, SystemTime::now())?,
        asset_dirs: vec![settings.assets.clone()],
        python: args.own.python,
        python_environments: args.own.python_environments,
        access: settings.access()?,
        store_prefixes: args.store_prefix,
    };
    output.say(format!("worker {} for {}", config.name, config.coordinator));
    let summary = picofarm_tasks::run(config, stop)
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

/// Converts a worker's end into an exit code.
pub fn agent_error(error: &AgentError) -> CliError {
    let code = match error {
        AgentError::Refused { .. } => Code::Coordinator,
        AgentError::Threads { .. } => Code::Resource,
        _ => Code::Input,
    };
    let ended = CliError::new(code, error);
    match error {
        AgentError::Refused { .. } => {
            // Other messages concern tokens and certificates, and include their own remedy.
            let text = error.to_string();
            if ["version", "protocol"]
                .iter()
                .any(|word| text.contains(word))
            {
                ended.hint("compare `picofarm --version` on both machines; upgrade coordinators first, then their workers")
            } else {
                ended
            }
        }
        _ => ended,
    }
}
