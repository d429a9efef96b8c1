//! One module for each command: the code of `picofarm demo` is in `demo.rs`.

mod assets;
mod audit;
mod autoalloc;
mod capture;
mod catalog;
mod certificates;
mod completions;
mod config;
pub mod coordinator;
pub mod dataset;
mod demo;
mod demultiplex;
mod doctor;
mod events;
mod figure;
mod hook;
pub(crate) mod job;
pub mod local;
pub(crate) mod local_worker;
mod model;
mod reconstruct;
mod rendered;
mod scene;
#[cfg(feature = "networks")]
mod sweep;
mod token;
mod up;
mod usage;
#[cfg(feature = "web")]
mod web;
mod worker;
mod workers;

use crate::{args::Command, error::Result, output::Output, settings::Resolved};

/// Runs a command.
pub(crate) async fn run(command: Command, resolved: &Resolved, output: Output) -> Result<()> {
    let settings = &resolved.settings;
    picofarm_store::limit_bandwidth(settings.bandwidth()?);
    match command {
        Command::Demo(args) => demo::run(args, settings, output).await,
        Command::Up(args) => up::run(args, settings, output).await,
        Command::Coordinator(args) => coordinator::run(args, output).await,
        Command::Worker(args) => worker::run(args, settings, output).await,
        Command::Autoalloc(command) => autoalloc::run(command, settings, output).await,
        #[cfg(feature = "web")]
        Command::Web(args) => web::run(args, settings, output).await,
        #[cfg(not(feature = "web"))]
        Command::Web(_) => Err(crate::error::not_built("web", "pages for a browser")),
        Command::LocalWorker => unreachable!("it is started before settings are resolved"),
        Command::Job(command) => job::run(command, settings, output).await,
        Command::Workers { what } => workers::run(what, settings, output).await,
        Command::Events {
            follow,
            run,
            kinds,
            cursor,
            last,
            verbose,
        } => {
            let hook = run.map(|command| hook::Hook::new(command, kinds, cursor));
            let hook = hook.transpose()?;
            events::run(follow, (last, verbose), hook, settings, output).await
        }
        Command::Dataset(command) => dataset::run(command, settings, output).await,
        Command::Capture(command) => capture::run(command, output).await,
        Command::Model(command) => model::run(command, output).await,
        #[cfg(feature = "networks")]
        Command::Sweep(command) => sweep::run(command, settings, output).await,
        #[cfg(not(feature = "networks"))]
        Command::Sweep(_) => Err(crate::error::not_built("networks", "sweeps")),
        Command::Scene(command) => scene::run(command, settings, output).await,
        Command::Reconstruct(args) => reconstruct::run(args, output).await,
        Command::Demultiplex(args) => demultiplex::run(args, output).await,
        Command::Figure(args) => figure::run(args, output).await,
        Command::Token(command) => token::run(command, resolved, output).await,
        Command::Certificates(args) => certificates::run(&args, output),
        Command::Usage(args) => usage::run(&args, settings, output).await,
        Command::Catalog(command) => catalog::run(command, output).await,
        Command::Audit(args) => audit::run(&args, settings, output).await,
        Command::Assets(command) => assets::run(command, settings, output).await,
        Command::Config => {
            config::show(resolved, output);
            Ok(())
        }
        Command::Doctor(args) => doctor::run(args, settings, output).await,
        Command::Man { folder } => completions::manual(&folder, output),
        Command::Completions { shell } => {
            completions::print(shell);
            Ok(())
        }
    }
}
