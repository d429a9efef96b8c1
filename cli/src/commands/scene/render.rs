//! `picofarm scene render`: renders one scene file on this machine, without a farm.

use std::{
    sync::{
        Mutex,
        atomic::{AtomicU32, Ordering},
    },
    time::Instant,
};

use picofarm_dataset::SINGLE_PICTURE;
use picofarm_transient::{Budget, Progress, RenderError};
use serde_json::json;
use tokio_util::sync::CancellationToken;

use super::{
    group::{spec, write},
    order::{Order, decisions, notes, warnings},
};
use crate::{
    args::SceneRender,
    error::{CliError, Code, Result},
    output::{Meter, Output, duration, files::free_folder},
    signals,
};

/// Shows progress. A cancelled token stops the render.
struct Watcher {
    done: AtomicU32,
    meter: Mutex<Meter>,
    stop: CancellationToken,
}

impl Progress for Watcher {
    fn at(&self, done: f32) -> bool {
        let share = (done * 1e6) as u32;
        if self.done.fetch_max(share, Ordering::Relaxed) < share
            && let Ok(mut meter) = self.meter.try_lock()
        {
            meter.update(f64::from(done), "rendering".into());
        }
        !self.stop.is_cancelled()
    }
}

/// Maximum samples of a render that only time limits: more than any render reaches.
const MOST_SAMPLES: u32 = 1 << 20;

/// Renders a scene file into a data set of one scene.
///
/// # Errors
/// Fails on an unusable scene or argument, too little memory, a folder in use, or an interruption.
pub async fn run(args: SceneRender, output: Output) -> Result<()> {
    free_folder(&args.out)?;
    let mut order = Order::new(&args.render, args.split)?;
    if args.seconds.is_some() && args.render.error.is_none() && args.render.samples.is_none() {
        // Only time limits the render.
        order.settings.budget = Budget::Samples(MOST_SAMPLES);
    }
    order.fits().map_err(|e| CliError::new(Code::Resource, e))?;
    let spec = spec(&order)?;
    let watcher = Watcher {
        done: AtomicU32::new(0),
        meter: Mutex::new(Meter::new(output)),
        stop: signals::stop_on_signal()?,
    };
    let pool = order.pool()?;
    let start = Instant::now();
    let (mut order, watcher, rendered) = tokio::task::spawn_blocking(move || {
        let run = || match args.seconds {
            None => picofarm_transient::render(&order.scene, &order.settings, &watcher),
            Some(seconds) => {
                let left = || seconds - start.elapsed().as_secs_f64();
                picofarm_transient::render_within(&order.scene, &order.settings, &left, &watcher)
            }
        };
        let rendered = pool.install(run);
        (order, watcher, rendered)
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("the renderer broke: {e}")))?;
    if let Ok(meter) = watcher.meter.into_inner() {
        meter.finish();
    }
    let rendered = rendered.map_err(|e| match e {
        RenderError::Stopped => signals::interrupted("nothing was written"),
        RenderError::Memory { .. } => CliError::new(Code::Resource, e),
        e => CliError::input(e),
    })?;
    let seconds = start.elapsed().as_secs_f64();
    if args.seconds.is_some() {
        // Records the samples actually used, so that the render can be repeated.
        order.settings.budget = Budget::Samples(rendered.error.samples);
    }
    write(&args.out, &order, &spec, &rendered).await?;
    let (e, threads) = (&rendered.error, order.threads);
    let arrays: Vec<&str> = order.wanted.iter().map(|w| w.array.as_str()).collect();
    output.result(
        &json!({
            "out": args.out, "seconds": seconds, "threads": threads, "rays": rendered.rays,
            "error": e, "overflow": rendered.overflow, "plan": rendered.plan, "subsets": arrays,
            "warnings": rendered.warnings, "picture": args.out.join(SINGLE_PICTURE),
            "notes": order.scene.provenance.notes,
        }),
        || {
            let mut text = format!(
                "{}: {} paths a pixel, median error {:.2} %, total {:.2} %, {} on {threads} thread(s), {:.1} M rays\n",
                args.out.display(), e.samples, e.median_relative * 100.0, e.total_relative * 100.0,
                duration(seconds), rendered.rays as f64 / 1e6,
            );
            if !arrays.is_empty() {
                text += &format!("  also {}\n", arrays.join(", "));
            }
            text += &format!("  picture: {}\n", args.out.join(SINGLE_PICTURE).display());
            text + &notes(&order.scene) + &decisions(&rendered.plan) + &warnings(&rendered.warnings)
        },
    );
    Ok(())
}
