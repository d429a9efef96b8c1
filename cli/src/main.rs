//! The `picofarm` binary: every role and command of the farm.

mod args;
mod assets;
mod bench;
mod choices;
mod client;
mod dataset;
mod demo;
mod doctor;
mod error;
mod explain;
mod follow;
mod groups;
mod jobfile;
mod jobs;
mod local;
mod model;
mod output;
mod picture;
mod render;
mod roles;
mod scene;
mod sense;
mod settings;
mod signals;
mod sweep;
mod tail;
mod template;
mod token;
mod traces;

use std::{
    io::{IsTerminal, Write},
    process::ExitCode,
};

use clap::{CommandFactory, Parser};
use tracing_subscriber::{Layer, prelude::*};

use crate::{
    args::{Cli, Command},
    error::Result,
    output::{Output, table},
    settings::{Resolved, resolve},
    traces::Traces,
};

fn main() -> ExitCode {
    // One provider of cryptography for everything in this program that speaks TLS.
    rustls::crypto::aws_lc_rs::default_provider()
        .install_default()
        .expect("nothing has chosen one before main");
    let cli = Cli::parse();
    let json = cli.global.json;
    match start(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => ExitCode::from(e.report(json)),
    }
}

fn start(cli: Cli) -> Result<()> {
    let resolved = resolve(&cli.global)?;
    let output = Output {
        json: cli.global.json,
    };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|e| error::io("cannot start the runtime", &e))?;
    let traces = {
        let _in = runtime.enter();
        let traces = cli.command.traces();
        traces
            .map(|(url, service)| Traces::start(url, service))
            .transpose()?
    };
    log(&resolved.settings.log, traces.as_ref())?;
    let ended = runtime.block_on(run(cli.command, &resolved, output));
    if let Some(traces) = traces {
        traces.end();
    }
    ended
}

async fn run(command: Command, resolved: &Resolved, output: Output) -> Result<()> {
    let settings = &resolved.settings;
    picofarm_dataset::limit_bandwidth(settings.bandwidth()?);
    match command {
        Command::Demo(args) => demo::demo(args, settings, output).await,
        Command::Up(args) => demo::up(args, settings, output).await,
        Command::Coordinator(args) => roles::coordinator(args, output).await,
        Command::Worker(args) => roles::worker(args, settings, output).await,
        Command::Job(command) => jobs::run(command, settings, output).await,
        Command::Workers { what } => explain::workers(what, settings, output).await,
        Command::Events {
            follow,
            last,
            verbose,
        } => tail::events(follow, last, verbose, settings, output).await,
        Command::Dataset(command) => dataset::run(command, settings, output).await,
        Command::Model(command) => model::run(command, output).await,
        Command::Sweep(command) => sweep::run(command, output).await,
        Command::Scene(command) => scene::run(command, settings, output).await,
        Command::Token(command) => token::run(command, output),
        Command::Assets(command) => assets::run(command, settings, output).await,
        Command::Bench(command) => bench::run(command, settings, output).await,
        Command::Config => {
            show_settings(resolved, output);
            Ok(())
        }
        Command::Doctor(args) => doctor::run(args, settings, output).await,
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "picofarm", &mut script);
            // A closed pipe (`| head`) is not an error worth a message.
            let _ = std::io::stdout().write_all(&script);
            Ok(())
        }
    }
}

fn show_settings(resolved: &Resolved, output: Output) {
    let values = serde_json::to_value(&resolved.settings).expect("settings are plain data");
    let mut rows: Vec<_> = resolved
        .sources
        .iter()
        .map(|(name, source)| {
            let value = match &values[name] {
                serde_json::Value::Null => String::new(),
                serde_json::Value::String(text) => text.clone(),
                other => other.to_string(),
            };
            vec![(*name).to_owned(), value, source.clone()]
        })
        .collect();
    if resolved.token {
        let source = "environment PICOFARM_TOKEN".to_owned();
        rows.push(vec!["token".into(), "(a secret)".into(), source]);
    }
    let document: serde_json::Map<_, _> = rows
        .iter()
        .map(|r| {
            (
                r[0].clone(),
                serde_json::json!({"value": r[1], "source": r[2]}),
            )
        })
        .collect();
    output.result(&document, || table(&rows));
}

/// Log lines go to stderr, those of tasks also to their coordinator, and spans to a collector, if one is named.
fn log(filter: &str, traces: Option<&Traces>) -> Result<()> {
    let filter = tracing_subscriber::EnvFilter::try_new(filter).map_err(|e| {
        error::CliError::input(format!("log filter {filter:?}: {e}"))
            .hint("e.g. --log info, or --log picofarm_agent=debug")
    })?;
    let stderr = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_filter(filter);
    tracing_subscriber::registry()
        .with(stderr)
        .with(picofarm_agent::task_logs())
        .with(traces.map(Traces::layer))
        .init();
    Ok(())
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        super::Cli::command().debug_assert();
    }
}
