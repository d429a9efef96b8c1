//! `picofarm dataset export`: a data set packed for sharing.

use std::time::Instant;

use picofarm_agent::export::Scenes;
use picofarm_dataset::{Export, open_store};
use serde_json::json;

use super::{failed, open};
use crate::{
    args::DatasetExport,
    error::Result,
    output::{Meter, Output, bytes, duration},
    signals,
};

pub async fn run(args: DatasetExport, output: Output) -> Result<()> {
    let start = Instant::now();
    let stop = signals::stop_on_signal()?;
    let dataset = open(&args.dataset).await?;
    let which = args.scenes.unwrap_or(Scenes::All);
    let scenes = which.of(&dataset).await.map_err(failed)?;
    let (store, prefix) = open_store(&args.dest).map_err(failed)?;
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
            let hint = "run the same command again to go on; finished files are kept";
            return Err(signals::interrupted(hint));
        }
    }
    let done = export.finish().await.map_err(failed)?;
    meter.finish();
    let seconds = start.elapsed().as_secs_f64();
    let facts = json!({"dataset": args.dataset, "dest": args.dest, "scenes": done.scenes, "files": done.files,
                       "bytes": done.bytes, "seconds": seconds});
    output.result(&facts, || {
        format!(
            "{}: {} scenes in {} files, {}, in {}",
            args.dest,
            done.scenes,
            done.files,
            bytes(done.bytes),
            duration(seconds)
        )
    });
    Ok(())
}
