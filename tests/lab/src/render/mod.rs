//! `just lab render`: CPU time of the renderer against the true error, and how it grows with the
//! size.

mod axes;
mod curve;
mod deviation;
mod ladder;
mod measure;
mod peer;
mod plot;
mod report;
mod scaling;
mod scenes;
mod tessellate;
mod truth;

use tokio_util::sync::CancellationToken;

use picofarm_cli::{
    error::{CliError, Result},
    output::Output,
};

use crate::args::Render as RenderArgs;

pub use measure::cpu_time;

fn check(args: &RenderArgs) -> Result<()> {
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

/// Measures the renderer: CPU time against the true error.
///
/// # Errors
/// Fails on unusable arguments or scenes, or on an interruption.
pub fn run(args: &RenderArgs, output: Output, stop: &CancellationToken) -> Result<()> {
    check(args)?;
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
