//! `picofarm dataset export`: packs a data set for sharing, or converts it to the layout of other
//! tools.

use std::time::Instant;

use picofarm_exchange::{Exported, Exporter};
use picofarm_store::open_store;
use picofarm_tasks::export::Scenes;
use serde_json::json;

use super::{failed, open};
use crate::{
    args::DatasetExport,
    error::Result,
    output::{Meter, Output, bytes, duration},
    signals,
};

const HINT: &str = "run the same command again to go on; finished files are kept";

pub async fn run(args: DatasetExport, output: Output) -> Result<()> {
    let start = Instant::now();
    let stop = signals::stop_on_signal()?;
    let dataset = open(&args.dataset).await?;
    let which = args.scenes.unwrap_or(Scenes::All);
    let scenes = which.select(&dataset).await.map_err(failed)?;
    let (store, prefix) = open_store(&args.dest).map_err(failed)?;
    let mut export =
        Exporter::new(args.format, &dataset, &scenes, &*store, prefix).map_err(failed)?;
    let mut meter = Meter::new(output);
    let steps = export.steps();
    for k in 0..steps {
        meter.update(k as f64 / steps as f64, format!("{k} of {steps} steps"));
        tokio::select! {
            done = export.step(k) => done.map_err(failed)?,
            () = stop.cancelled() => return Err(signals::interrupted(HINT)),
        }
    }
    let done = export.finish().await.map_err(failed)?;
    meter.finish();
    tell(&args.dataset, &args.dest, done, start, output);
    Ok(())
}

fn tell(dataset: &str, dest: &str, done: Exported, start: Instant, output: Output) {
    let seconds = start.elapsed().as_secs_f64();
    let facts = json!({"dataset": dataset, "dest": dest, "scenes": done.scenes, "files": done.files,
                       "bytes": done.bytes, "seconds": seconds});
    output.result(&facts, || {
        format!(
            "{dest}: {} scenes in {} files, {}, in {}",
            done.scenes,
            done.files,
            bytes(done.bytes),
            duration(seconds)
        )
    });
}
