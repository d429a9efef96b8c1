//! The commands of the `picofarm` program: every role of the farm, and the users' commands. The
//! program itself (`cli/program`) selects the features. Benches (`cli/bench`) are a crate above
//! this one, so that the program of a farm does not contain code that only comparisons need.
//!
//! Only these two crates use this library, so its public items are not all documented.
#![allow(missing_docs)]

pub mod args;
mod assets;
mod audit;
pub mod choices;
pub mod client;
pub mod dataset;
mod demo;
mod demultiplex;
mod describe;
mod doctor;
pub mod ends;
pub mod error;
mod explain;
mod files;
pub mod follow;
mod groups;
pub mod jobfile;
mod jobs;
mod listing;
pub mod local;
mod logging;
mod model;
pub mod output;
mod pace;
mod paths;
pub mod picture;
mod reach;
mod reconstruct;
mod render;
pub mod roles;
mod scene;
mod sense;
pub mod settings;
pub mod signals;
mod stored;
#[cfg(feature = "networks")]
mod sweep;
mod tail;
mod template;
mod token;
#[cfg(feature = "traces")]
mod traces;
#[cfg(not(feature = "traces"))]
#[path = "without_traces.rs"]
mod traces;

use std::{
    future::Future,
    io::{ErrorKind, Write},
    pin::Pin,
    process::ExitCode,
};

use tracing_subscriber::{Layer, prelude::*};

use crate::{
    args::{Cli, Command},
    error::Result,
    output::{Output, table},
    settings::{Resolved, resolve},
    traces::Traces,
};

/// Runs `picofarm bench …`, if the program has it.
pub type Bench = for<'a> fn(
    args::Bench,
    &'a settings::Settings,
    Output,
) -> Pin<Box<dyn Future<Output = Result<()>> + Send + 'a>>;

/// Runs the whole program, from its command line to its exit code. `version` is the text of
/// `--version`.
pub fn run_program(version: &'static str, bench: Option<Bench>) -> ExitCode {
    // A single cryptography provider for all TLS code of this program.
    rustls::crypto::ring::default_provider()
        .install_default()
        .expect("nothing has chosen one before main");
    let cli = match args::parse(std::env::args_os(), version) {
        Ok(cli) => cli,
        Err(asked) => return usage(&asked),
    };
    let json = cli.global.json;
    match start(cli, bench) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => ExitCode::from(e.report(json)),
    }
}

/// Prints help, the version, or an error about the arguments.
fn usage(asked: &clap::Error) -> ExitCode {
    let printed = asked.print().and_then(|()| std::io::stdout().flush());
    match printed {
        Err(e) if !asked.use_stderr() && e.kind() != ErrorKind::BrokenPipe => {
            ExitCode::from(error::io("standard output", &e).report(false))
        }
        _ => ExitCode::from(u8::try_from(asked.exit_code()).unwrap_or(2)),
    }
}

fn start(cli: Cli, bench: Option<Bench>) -> Result<()> {
    if let Command::LocalWorker = cli.command {
        return local_worker();
    }
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
    let _last_lines = log(&resolved.settings.log, traces.as_ref())?;
    let ended = runtime
        .block_on(run(cli.command, &resolved, output, bench))
        .and_then(|()| output::printed());
    if let Some(traces) = traces {
        traces.end();
    }
    ended
}

/// Runs a worker process of `up` or `demo`. Its parent has resolved the settings.
fn local_worker() -> Result<()> {
    let order = local::received()?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|e| error::io("cannot start the runtime", &e))?;
    let traces = {
        let _in = runtime.enter();
        let traces = order.otlp.as_deref();
        traces
            .map(|url| Traces::start(url, "picofarm-worker"))
            .transpose()?
    };
    let _last_lines = log(&order.settings.log, traces.as_ref())?;
    picofarm_store::limit_bandwidth(order.settings.bandwidth()?);
    let ended = runtime.block_on(local::serve(order));
    if let Some(traces) = traces {
        traces.end();
    }
    ended
}

async fn run(
    command: Command,
    resolved: &Resolved,
    output: Output,
    bench: Option<Bench>,
) -> Result<()> {
    let settings = &resolved.settings;
    picofarm_store::limit_bandwidth(settings.bandwidth()?);
    match command {
        Command::Demo(args) => demo::demo(args, settings, output).await,
        Command::Up(args) => demo::up(args, settings, output).await,
        Command::Coordinator(args) => roles::coordinator(args, output).await,
        Command::Worker(args) => roles::worker(args, settings, output).await,
        Command::LocalWorker => unreachable!("it is started before settings are resolved"),
        Command::Job(command) => jobs::run(command, settings, output).await,
        Command::Workers { what } => explain::workers(what, settings, output).await,
        Command::Events {
            follow,
            last,
            verbose,
        } => tail::events(follow, last, verbose, settings, output).await,
        Command::Dataset(command) => dataset::run(command, settings, output).await,
        Command::Model(command) => model::run(command, output).await,
        #[cfg(feature = "networks")]
        Command::Sweep(command) => sweep::run(command, settings, output).await,
        #[cfg(not(feature = "networks"))]
        Command::Sweep(_) => Err(error::not_built("networks", "sweeps")),
        Command::Scene(command) => scene::run(command, settings, output).await,
        Command::Reconstruct(args) => reconstruct::run(args, output).await,
        Command::Demultiplex(args) => demultiplex::run(args, output).await,
        Command::Token(command) => token::run(command, resolved, output).await,
        Command::Audit(args) => audit::run(&args, settings, output).await,
        Command::Assets(command) => assets::run(command, settings, output).await,
        Command::Bench(command) => match bench {
            Some(bench) => bench(command, settings, output).await,
            None => Err(error::not_built("bench", "benches")),
        },
        Command::Config => {
            show_settings(resolved, output);
            Ok(())
        }
        Command::Doctor(args) => doctor::run(args, settings, output).await,
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut args::command(), "picofarm", &mut script);
            output::print(&script);
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
                serde_json::Value::String(text) => args::without_secrets(text),
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

/// Sends log lines to stderr, those of tasks also to their coordinator, and spans to a trace
/// collector, if configured.
fn log(filter: &str, traces: Option<&Traces>) -> Result<logging::Flush> {
    // A driver without devices is not an error.
    let filter = match filter.contains("wgpu") {
        true => filter.to_owned(),
        false => format!("{filter},wgpu_hal=off"),
    };
    let filter = tracing_subscriber::EnvFilter::try_new(&filter).map_err(|e| {
        error::CliError::input(format!("log filter {filter:?}: {e}"))
            .hint("e.g. --log info, or --log picofarm_agent=debug")
    })?;
    let started = logging::LogLines::start(std::io::stderr());
    let (lines, last_lines) = started.map_err(|e| error::io("cannot start a thread", &e))?;
    // Without colours, because the output is escaped as a whole: lines may quote text from others.
    let stderr = tracing_subscriber::fmt::layer()
        .with_writer(move || output::Escaped(lines.clone()))
        .with_ansi(false)
        .with_filter(filter);
    tracing_subscriber::registry()
        .with(stderr)
        .with(picofarm_agent::task_logs())
        .with(traces.map(Traces::layer))
        .init();
    Ok(last_lines)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        args::command().debug_assert();
    }

    #[test]
    fn a_negative_number_is_refused_as_a_value_and_not_taken_for_an_option() {
        for given in [
            &["demo", "--seed", "-1"][..],
            &["demo", "--scenes", "-5"],
            &["scene", "generate", "--seed", "-1"],
            &["bench", "queue", "--workers", "-2"],
            &["dataset", "show", "rooms", "-1"],
            &["job", "logs", "j", "--last", "-1"],
        ] {
            let all = [&["picofarm"], given].concat();
            let error = args::command().try_get_matches_from(all).unwrap_err();
            assert_eq!(
                error.kind(),
                clap::error::ErrorKind::ValueValidation,
                "{given:?}: {error}"
            );
        }
    }

    #[test]
    fn every_command_has_the_global_options_under_a_heading_of_their_own() {
        fn look(command: &clap::Command, global: &[String]) {
            for arg in command.get_arguments() {
                let ours = global.contains(&arg.get_id().to_string());
                let heading = arg.get_help_heading() == Some("Global options");
                assert_eq!(heading, ours, "{} {arg}", command.get_name());
            }
            command.get_subcommands().for_each(|c| look(c, global));
        }
        let mut command = args::command();
        let global: Vec<String> = command
            .get_arguments()
            .filter(|arg| arg.is_global_set())
            .map(|arg| arg.get_id().to_string())
            .collect();
        assert!(global.contains(&"coordinator".to_owned()), "{global:?}");
        command.build();
        look(&command, &global);
    }

    #[test]
    fn the_command_reference_has_every_command_and_option() {
        fn look(command: &clap::Command, path: &str, page: &str) {
            let heading = format!("# {path}\n");
            let at = page.find(&heading);
            let at = at.unwrap_or_else(|| panic!("{path} is missing; run docs/reference.sh"));
            let section = page[at..].split("\n#").next().expect("a part");
            let options = command.get_arguments().filter(|a| !a.is_global_set());
            for option in options
                .filter(|a| !a.is_hide_set())
                .filter_map(clap::Arg::get_long)
            {
                let known = section.contains(&format!("--{option}"));
                assert!(known, "{path} --{option} is missing; run docs/reference.sh");
            }
            for command in command.get_subcommands().filter(|c| !c.is_hide_set()) {
                if command.get_name() != "help" {
                    look(command, &format!("{path} {}", command.get_name()), page);
                }
            }
        }
        let here = std::env::var("CARGO_MANIFEST_DIR").unwrap();
        let page = std::fs::read_to_string(here + "/../docs/reference.md").unwrap();
        for command in args::command()
            .get_subcommands()
            .filter(|c| !c.is_hide_set())
        {
            if command.get_name() != "help" {
                look(command, &format!("picofarm {}", command.get_name()), &page);
            }
        }
    }
}
