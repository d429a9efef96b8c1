//! `picofarm reconstruct --field mlp`: PlatoNeRF's networks, sampled on the grid that all later
//! steps use.

use picofarm_reconstruct::{Measured, Reconstructed, Settings};
use serde_json::Value;

use super::watch::Watch;
use crate::{
    args::{FieldArg, Reconstruct},
    error::{CliError, Result},
};

/// Checks that the options match the field.
///
/// # Errors
/// Fails if an option belongs to the other field, or if the number of steps is missing.
pub fn check(args: &Reconstruct) -> Result<()> {
    if args.field == FieldArg::Mlp {
        if cfg!(not(feature = "networks")) {
            return Err(crate::error::not_built("networks", "networks"));
        }
        if args.no_planes {
            let what = "--no-planes belongs to --field grid: networks have no planes; leave it out";
            return Err(CliError::input(what));
        }
        if args.mlp.steps.is_none() {
            let what = "--field mlp needs --steps";
            return Err(CliError::input(what).hint(
                "the paper takes 200000 of 1024 rays, weeks on a CPU; --steps 1000 --width 64 --batch 256 is a look of about half an hour",
            ));
        }
        return Ok(());
    }
    for (option, given) in [
        ("--steps", args.mlp.steps.is_some()),
        ("--width", args.mlp.width.is_some()),
        ("--batch", args.mlp.batch.is_some()),
        ("--shadow-loss", args.mlp.shadow_loss.is_some()),
    ] {
        if given {
            let what = format!("{option} belongs to --field mlp");
            return Err(CliError::input(what).hint("add --field mlp, or leave it out"));
        }
    }
    Ok(())
}

/// Fits the networks. Returns the result on a grid, and the settings for metrics.json.
///
/// # Errors
/// Fails on unusable measurements, a failed fit, or an interruption.
#[cfg(feature = "networks")]
pub fn fit(
    args: &Reconstruct,
    measured: Measured,
    grid: Settings,
    watch: &Watch,
) -> Result<(Reconstructed, Value)> {
    use picofarm_platonerf::{MlpSettings, Settings as Networks, ShadowLoss, Training};
    use picofarm_reconstruct::Reconstruction;
    use serde_json::json;

    use super::refused;
    use crate::{args::ShadowLossArg, signals};

    let start = Reconstruction::begin(measured.clone(), picofarm_platonerf::grid(grid), watch)
        .map_err(refused)?;
    let start = start.finish();
    let paper = MlpSettings::default();
    let asked = MlpSettings {
        steps: args.mlp.steps.unwrap_or(paper.steps),
        width: args.mlp.width.unwrap_or(paper.width),
        batch: args.mlp.batch.unwrap_or(paper.batch),
        shadow_loss: match args.mlp.shadow_loss {
            Some(ShadowLossArg::CrossEntropy) => ShadowLoss::CrossEntropy,
            Some(ShadowLossArg::Squares) | None => ShadowLoss::Squares,
        },
    };
    let settings = Networks::of(&asked, &start, args.seed);
    let mut training = Training::begin(measured, settings).map_err(refused)?;
    if !training.run(watch).map_err(refused)? {
        return Err(signals::interrupted("nothing was written"));
    }
    watch.step("densities", 0.0);
    Ok((training.finish(start), json!(settings)))
}

/// Returns an error, because this build has no networks.
///
/// # Errors
/// Always fails.
#[cfg(not(feature = "networks"))]
pub fn fit(_: &Reconstruct, _: Measured, _: Settings, _: &Watch) -> Result<(Reconstructed, Value)> {
    Err(crate::error::not_built("networks", "networks"))
}
