//! Benchmarks of picofarm, and comparisons with other programs: `just lab render`.
//!
//! A benchmark prints its table, and with `--json` a document. It measures this machine, so both
//! sides of a comparison run in turn in one process.

mod args;
mod dataset;
mod model;
mod queue;
mod rays;
mod reconstruct;
mod render;
mod sensor;
mod stop;
mod store;

use std::process::ExitCode;

use clap::Parser;
use picofarm_cli::{
    error::{CliError, Code, Result},
    output::Output,
    settings::Settings,
    signals,
};

use args::{Command, Lab};

/// The allocator of the `picofarm` program.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    // The benchmarks of the scheduler, of small tasks, of pages and of storage start this program
    // again in these roles.
    let role = std::env::args().nth(1);
    if matches!(
        role.as_deref(),
        Some("coordinator" | "local-worker" | "up" | "web")
    ) {
        return picofarm_cli::run_program("lab");
    }
    let Lab { global, command } = Lab::parse();
    picofarm_cli::run_with_settings(&global, async |resolved, output| {
        run(command, &resolved.settings, output).await
    })
}

/// Runs a benchmark to its end, or until a signal.
///
/// # Errors
/// Fails on unusable arguments, insufficient space on the machine, or a failure of the measured
/// code.
async fn run(command: Command, settings: &Settings, output: Output) -> Result<()> {
    let failed = |e: Box<dyn std::error::Error>| CliError::new(Code::Failed, e);
    let stop = || signals::stop_on_signal();
    match command {
        Command::Queue(args) => queue::run(args, output, &stop()?).await,
        Command::Pages(args) => queue::pages::run(args, output, &stop()?).await,
        Command::Small(args) => queue::small::run(args, output, &stop()?).await,
        Command::Dataset(args) => dataset::run(args, output, &stop()?).await,
        Command::Store(args) => store::run(args, settings, output, &stop()?).await,
        Command::Model(args) => {
            let stop = stop()?;
            blocking(move || model::run(&args, output, &stop)).await
        }
        Command::Render(args) => {
            let stop = stop()?;
            blocking(move || render::run(&args, output, &stop)).await
        }
        Command::Rays(args) => done(|| rays::run(&args.words)),
        Command::Sensor => done(sensor::run),
        Command::Stop(args) => done(|| stop::run(&args.words)),
        Command::Plato(args) => reconstruct::plato::run(&args.words).map_err(failed),
        Command::Agreement(args) => done(|| reconstruct::agreement::run(&args.words)),
        Command::Chair(args) => reconstruct::chair::run(&args.words).map_err(failed),
    }
}

/// Runs a benchmark that prints its result itself.
fn done(work: impl FnOnce()) -> Result<()> {
    work();
    Ok(())
}

async fn blocking(work: impl FnOnce() -> Result<()> + Send + 'static) -> Result<()> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|e| CliError::new(Code::Failed, format!("the benchmark broke: {e}")))?
}
