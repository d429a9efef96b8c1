//! `picofarm dataset export`: a data set packed for sharing, or in the paper's layout.

use std::time::Instant;

use object_store::{ObjectStore, path::Path};
use picofarm_agent::export::Scenes;
use picofarm_dataset::{Dataset, Export, Exported, open_store};
use serde_json::json;
use tokio_util::sync::CancellationToken;

use super::{failed, open};
use crate::{
    args::{DatasetExport, ExportFormat},
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
    let scenes = which.of(&dataset).await.map_err(failed)?;
    let (store, prefix) = open_store(&args.dest).map_err(failed)?;
    if args.format == ExportFormat::Sb3d {
        let written = sb3d(&dataset, &scenes, (&*store, &prefix), &stop, output).await?;
        tell(&args.dataset, &args.dest, written, start, output);
        return Ok(());
    }
    let mut export = Export::new(&dataset, &scenes, &*store, prefix).map_err(failed)?;
    let mut meter = Meter::new(output);
    let packs = export.packs();
    for k in 0..packs {
        meter.at(k as f64 / packs as f64, format!("{k} of {packs} packs"));
        let given_up = tokio::select! {
            packed = export.pack(k) => { packed.map_err(failed)?; false }
            () = stop.cancelled() => true,
        };
        if given_up {
            return Err(signals::interrupted(HINT));
        }
    }
    let done = export.finish().await.map_err(failed)?;
    meter.finish();
    tell(&args.dataset, &args.dest, done, start, output);
    Ok(())
}

/// Scene by scene in the paper's layout.
async fn sb3d(
    dataset: &Dataset,
    scenes: &[u64],
    (store, prefix): (&dyn ObjectStore, &Path),
    stop: &CancellationToken,
    output: Output,
) -> Result<Exported> {
    let (mut done, mut meter) = (Exported::default(), Meter::new(output));
    for (at, scene) in scenes.iter().enumerate() {
        meter.at(
            at as f64 / scenes.len() as f64,
            format!("{at} of {} scenes", scenes.len()),
        );
        let written = tokio::select! {
            written = dataset.export_sb3d(*scene, store, prefix) => written.map_err(failed)?,
            () = stop.cancelled() => return Err(signals::interrupted(HINT)),
        };
        done.scenes += 1;
        done.files += written.files;
        done.bytes += written.bytes;
    }
    meter.finish();
    Ok(done)
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
