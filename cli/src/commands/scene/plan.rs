//! `picofarm scene plan`: what a render would take, without rendering.

use picofarm_proto::{show, spec::memory::gib};
use picofarm_transient::{ClassVariance, Forecast, RenderError};
use serde_json::json;

use super::order::{self, Order, decisions, notes};
use crate::{
    args::ScenePlan,
    error::{CliError, Code, Result},
    output::Output,
};

/// Estimates the time, memory and error of a render, without rendering.
///
/// # Errors
/// Fails on an unusable scene or argument.
pub async fn run(args: ScenePlan, output: Output) -> Result<()> {
    let order = Order::new(&args.render, false)?;
    let memory = order.memory();
    if let Err(what) = order.fits() {
        return too_large(&order, memory, &what, output);
    }
    let pool = order.pool()?;
    let by_class = args.variance;
    let (order, found) = tokio::task::spawn_blocking(move || {
        let run = || {
            let forecast = picofarm_transient::plan(&order.scene, &order.settings)?;
            let classes = match by_class {
                true => picofarm_transient::variance(&order.scene, &order.settings, PASSES)?,
                false => Vec::new(),
            };
            Ok((forecast, classes))
        };
        let found: std::result::Result<_, RenderError> = pool.install(run);
        (order, found)
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("the renderer broke: {e}")))?;
    let (forecast, classes) = found.map_err(CliError::input)?;
    let Forecast {
        plan,
        passes,
        error,
        rays,
        warnings,
    } = &forecast;
    let i = &order.scene.camera.intrinsics;
    let mut facts = json!({
        "scene": order.scene.name, "width": i.width, "height": i.height,
        "spots": order.scene.laser.beams.len(), "gate": order.settings.gate,
        "strategies": plan.strategies, "approximations": plan.approximations,
        "samples": passes, "error": error, "rays": rays, "memory_bytes": memory, "fits": true,
        "warnings": warnings,
    });
    if by_class {
        let share = |c: &ClassVariance| {
            json!({
                "paths": c.class, "energy": c.energy, "variance": c.variance, "of_the_middle_half": c.middle,
            })
        };
        facts["variance"] = classes.iter().map(share).collect();
    }
    output.result(
        &facts,
        || {
            let head = format!(
                "{}: {}x{} pixels x {} bins, {} spots\n\
                 about {passes} paths a pixel, median error {:.1} %, {:.1} M rays, about {} of memory\n",
                show::line(&order.scene.name),
                i.width,
                i.height,
                order.settings.gate.bins,
                order.scene.laser.beams.len(),
                error * 100.0,
                *rays as f64 / 1e6,
                gib(memory),
            );
            head + &notes(&order.scene)
                + &decisions(plan)
                + &variances(by_class, &classes)
                + &order::warnings(warnings)
        },
    );
    Ok(())
}

/// Number of passes for estimating the variance of path classes.
const PASSES: u32 = 64;

/// Formats the variance by path class as a table.
fn variances(asked: bool, classes: &[ClassVariance]) -> String {
    if !asked {
        return String::new();
    }
    if classes.is_empty() {
        return "no paths of three bounces and more\n".to_owned();
    }
    let mut text = "paths of three bounces and more, and of two where they are drawn into the image: % of energy, of variance, and of the variance of the middle\n\
         half of the pixels:\n"
        .to_owned();
    for c in classes {
        let [energy, variance, middle] = [c.energy, c.variance, c.middle].map(|x| 100.0 * x);
        text += &format!(
            "  {energy:6.2}  {variance:6.2}  {middle:6.2}  {}\n",
            c.class
        );
    }
    text
}

/// Prints the plan of a render that does not fit into memory. Nothing is measured for it.
fn too_large(order: &Order, memory: u64, what: &str, output: Output) -> Result<()> {
    let ((width, height), _) = order.size();
    output.result(
        &json!({
            "scene": order.scene.name, "width": width, "height": height,
            "spots": order.scene.laser.beams.len(), "gate": order.settings.gate,
            "memory_bytes": memory, "fits": false,
        }),
        || format!("{}: does not fit: {what}\n", show::line(&order.scene.name)),
    );
    Ok(())
}
