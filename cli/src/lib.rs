//! The commands of the `picofarm` program: every role of the farm, and the users' commands. The
//! program itself (`cli/program`) selects the features. Benchmarks (`tests/lab`) are a program of
//! their own that uses this library.
//!
//! Only these two use this library, so its public items are not all documented.
#![allow(missing_docs)]

pub mod args;
pub mod client;
pub mod commands;
pub mod error;
mod files;
mod logging;
pub mod output;
pub mod settings;
pub mod signals;
#[cfg(feature = "traces")]
mod traces;
#[cfg(not(feature = "traces"))]
#[path = "without_traces.rs"]
mod traces;

use std::{
    ffi::OsString,
    io::{ErrorKind, Write},
    process::ExitCode,
    sync::{Once, OnceLock},
};

use tracing_subscriber::{Layer, prelude::*};

use crate::{
    args::{Cli, Command},
    error::Result,
    output::Output,
    settings::{Resolved, resolve},
    traces::Traces,
};

/// The command that starts this program again, without arguments; unset for its own executable.
static START: OnceLock<Vec<OsString>> = OnceLock::new();

/// Runs the whole program, from its command line to its exit code. `version` is the text of
/// `--version`.
pub fn run_program(version: &'static str) -> ExitCode {
    ExitCode::from(run(std::env::args_os().skip(1), version))
}

/// Like [`run_program`], for a program inside another one such as an interpreter. `start` is the
/// command that runs this program, without arguments. Returns the exit code.
pub fn run_program_as(start: Vec<OsString>, args: Vec<OsString>, version: &'static str) -> u8 {
    // A second call in this process has the same command.
    let _ = START.set(start);
    run(args.into_iter(), version)
}

fn run(args: impl Iterator<Item = OsString>, version: &'static str) -> u8 {
    provide_cryptography();
    let cli = match args::parse(std::iter::once("picofarm".into()).chain(args), version) {
        Ok(cli) => cli,
        Err(asked) => return usage(&asked),
    };
    let json = cli.global.json;
    match start(cli) {
        Ok(()) => 0,
        Err(e) => e.report(json),
    }
}

/// Returns whether this program runs inside another one.
pub(crate) fn has_host() -> bool {
    START.get().is_some()
}

/// Returns a command that starts this program again.
pub(crate) fn this_program() -> std::io::Result<std::process::Command> {
    let Some([program, args @ ..]) = START.get().map(Vec::as_slice) else {
        return Ok(std::process::Command::new(std::env::current_exe()?));
    };
    let mut command = std::process::Command::new(program);
    command.args(args);
    Ok(command)
}

/// Prints help, the version, or an error about the arguments.
fn usage(asked: &clap::Error) -> u8 {
    let printed = asked.print().and_then(|()| std::io::stdout().flush());
    match printed {
        Err(e) if !asked.use_stderr() && e.kind() != ErrorKind::BrokenPipe => {
            error::io("standard output", &e).report(false)
        }
        _ => u8::try_from(asked.exit_code()).unwrap_or(2),
    }
}

fn start(cli: Cli) -> Result<()> {
    if let Command::LocalWorker = cli.command {
        return local_worker();
    }
    let Cli { global, command } = cli;
    let traces = command.traces();
    let traces = traces.map(|(url, service)| (url.to_owned(), service));
    with_settings(&global, traces, async |resolved, output| {
        commands::run(command, resolved, output).await
    })
}

/// Runs a program of this workspace that has the global options: resolves the settings, starts the
/// runtime and the log, and runs `work`. Returns the exit code.
pub fn run_with_settings(
    global: &args::Global,
    work: impl AsyncFnOnce(&Resolved, Output) -> Result<()>,
) -> ExitCode {
    provide_cryptography();
    match with_settings(global, None, work) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => ExitCode::from(e.report(global.json)),
    }
}

/// Runs `work` with the settings. `traces` is the collector's URL and the name of the service.
fn with_settings(
    global: &args::Global,
    traces: Option<(String, &'static str)>,
    work: impl AsyncFnOnce(&Resolved, Output) -> Result<()>,
) -> Result<()> {
    let resolved = resolve(global)?;
    let output = Output { json: global.json };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|e| error::io("cannot start the runtime", &e))?;
    let traces = {
        let _in = runtime.enter();
        traces
            .map(|(url, service)| Traces::start(&url, service))
            .transpose()?
    };
    let _last_lines = log(&resolved.settings.log, traces.as_ref())?;
    let ended = runtime
        .block_on(work(&resolved, output))
        .and_then(|()| output::printed());
    if let Some(traces) = traces {
        traces.end();
    }
    ended
}

/// Selects the only cryptography provider of all TLS code of this process.
pub fn provide_cryptography() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        rustls::crypto::ring::default_provider()
            .install_default()
            .expect("no other code of this process chooses one");
    });
}

/// Runs a worker process of `up` or `demo`. Its parent has resolved the settings.
fn local_worker() -> Result<()> {
    let order = commands::local_worker::received()?;
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
    let ended = runtime.block_on(commands::local_worker::serve(order));
    if let Some(traces) = traces {
        traces.end();
    }
    ended
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
            .hint("e.g. --log info, or --log picofarm_tasks=debug")
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
        .with(picofarm_tasks::task_logs())
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
