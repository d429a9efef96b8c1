//! `picofarm bench …`: benchmarks of renders (time and error), of the scheduler, of operations on
//! very many scenes, of histogram codecs, and of training steps.

mod axes;
mod curve;
mod dataset;
mod deviation;
mod ladder;
mod measure;
mod model;
mod peer;
mod plot;
mod queue;
mod report;
mod scaling;
mod scenes;
mod store;
mod tessellate;
mod truth;

use tokio_util::sync::CancellationToken;

use picofarm_cli::{
    args::{Bench as Command, BenchRender},
    error::{CliError, Code, Result},
    output::Output,
    settings::Settings,
    signals,
};

/// Runs a benchmark to its end, or until a signal.
///
/// # Errors
/// Fails on unusable arguments, insufficient space on the machine, or a failure of the measured
/// code.
pub async fn run(command: Command, settings: &Settings, output: Output) -> Result<()> {
    let stop = signals::stop_on_signal()?;
    let args = match command {
        Command::Queue(args) => return queue::run(args, output, &stop).await,
        Command::Dataset(args) => return dataset::run(args, output, &stop).await,
        Command::Store(args) => return store::run(args, settings, output, &stop).await,
        Command::Model(args) => {
            return blocking(move || model::run(&args, output, &stop)).await;
        }
        Command::Render(args) => args,
    };
    check(&args)?;
    blocking(move || render(&args, output, &stop)).await
}

async fn blocking(work: impl FnOnce() -> Result<()> + Send + 'static) -> Result<()> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|e| CliError::new(Code::Failed, format!("the benchmark broke: {e}")))?
}

fn check(args: &BenchRender) -> Result<()> {
    if let Some(e) = args.error.iter().find(|e| !(**e > 0.0 && **e < 1.0)) {
        return Err(CliError::input(format!("--error {e}: expected a share"))
            .hint("write for example --error 10%,5%"));
    }
    if args.truth.is_some() && args.scenes.len() != 1 {
        return Err(CliError::input(format!(
            "--truth belongs to one scene, found {}",
            args.scenes.len()
        ))
        .hint("name the scene that it was rendered from"));
    }
    Ok(())
}

fn render(args: &BenchRender, output: Output, stop: &CancellationToken) -> Result<()> {
    if args.scaling {
        let found = scaling::run(args, output, stop)?;
        output.result(&found, || report::scaling(&found));
        return Ok(());
    }
    let peers = peer::read(&args.peer)?;
    let mut results = Vec::new();
    for name in &args.scenes {
        let scene = scenes::load(name, args)?;
        results.push(ladder::run(&scene, args, &peers, output, stop)?);
    }
    if let Some(path) = &args.plot {
        plot::draw(&results, &args.error, path)?;
        output.say(format!("drew {}", path.display()));
    }
    let document = report::document(&results, args);
    output.result(&document, || report::ladders(&results));
    Ok(())
}
