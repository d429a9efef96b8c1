//! `picofarm dataset export`: a data set packed for sharing.

use std::{ops::Range, time::Instant};

use picofarm_dataset::{Export, open_store};
use picofarm_proto::split::{SIDES, SplitRecord};
use serde_json::json;

use super::{failed, open};
use crate::{
    args::DatasetExport,
    error::{CliError, Code, Result},
    output::{Meter, Output, bytes, duration},
    signals,
};

/// Which scenes.
#[derive(Debug, Clone, PartialEq)]
pub enum Scenes {
    Range(Range<u64>),
    Split { name: String, side: String },
}

/// Reads `a..b`, `split:SIDE` or `split:NAME:SIDE`.
///
/// # Errors
/// It is none of them.
pub fn parse(text: &str) -> Result<Scenes, String> {
    let expected = || "expected A..B, split:train, split:validation, split:test or split:NAME:SIDE";
    if let Some(split) = text.strip_prefix("split:") {
        let (name, side) = split.split_once(':').unwrap_or(("default", split));
        if !SIDES.contains(&side) {
            return Err(expected().into());
        }
        return Ok(Scenes::Split {
            name: name.into(),
            side: side.into(),
        });
    }
    let (low, high) = text.split_once("..").ok_or_else(expected)?;
    let number = |text: &str| {
        text.trim()
            .parse::<u64>()
            .map_err(|_| expected().to_owned())
    };
    let range = number(low)?..number(high)?;
    match range.is_empty() {
        true => Err(expected().into()),
        false => Ok(Scenes::Range(range)),
    }
}

pub async fn run(args: DatasetExport, output: Output) -> Result<()> {
    let start = Instant::now();
    let stop = signals::stop_on_signal()?;
    let dataset = open(&args.dataset).await?;
    let mut scenes = dataset.scenes_present().await.map_err(failed)?;
    match &args.scenes {
        None => {}
        Some(Scenes::Range(range)) => scenes.retain(|s| range.contains(s)),
        Some(Scenes::Split { name, side }) => {
            let side = of_split(&dataset, name, side).await?;
            scenes.retain(|s| side.binary_search(s).is_ok());
        }
    }
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

/// The scenes of a side of the newest version of a split, ascending.
async fn of_split(dataset: &picofarm_dataset::Dataset, name: &str, side: &str) -> Result<Vec<u64>> {
    let versions = dataset.split_versions(name).await.map_err(failed)?;
    let Some(version) = versions.last() else {
        return Err(
            CliError::input(format!("--scenes: the data set has no split {name:?}"))
                .hint("make it with `picofarm dataset split`"),
        );
    };
    let bytes = dataset.read_split(name, *version).await.map_err(failed)?;
    let record = SplitRecord::parse(&bytes).map_err(|what| {
        let place = dataset.split_place(name, *version);
        CliError::new(Code::Damaged, format!("{place}: {what}"))
    })?;
    Ok(record.scenes(side))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_are_chosen_by_range_or_by_split() {
        assert_eq!(parse("3..7"), Ok(Scenes::Range(3..7)));
        let split = |name: &str, side: &str| Scenes::Split {
            name: name.into(),
            side: side.into(),
        };
        assert_eq!(parse("split:train"), Ok(split("default", "train")));
        assert_eq!(parse("split:half:test"), Ok(split("half", "test")));
        for bad in ["", "3", "7..3", "split:", "split:training", "a..b"] {
            assert!(parse(bad).unwrap_err().starts_with("expected"), "{bad}");
        }
    }
}
