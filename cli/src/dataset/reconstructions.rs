//! `dataset info` of reconstructions: the means of their errors; and whether they are whole.

use futures::{StreamExt, TryStreamExt, stream};
use picofarm_dataset::{DatasetError, Problem, Reconstructions, open_store};
use serde_json::{Map, Value, json};

use super::{
    failed,
    late::Late,
    problems::{broken_by, mode, problems_json_by},
};
use crate::{
    args::DatasetVerify,
    error::{CliError, Code, Result},
    output::{Output, bytes},
};

/// Requests in flight.
const CONCURRENCY: usize = 16;

/// Figures of `metrics.json` of which means are given: a name, and the way to it.
const FIGURES: [(&str, &str); 11] = [
    ("l1_m", "/novel_views/all/l1_m"),
    ("rmse_m", "/novel_views/all/rmse_m"),
    ("psnr_db", "/novel_views/psnr_db"),
    ("visible_l1_m", "/novel_views/visible/l1_m"),
    ("occluded_l1_m", "/novel_views/occluded/l1_m"),
    ("outside_l1_m", "/novel_views/outside/l1_m"),
    ("specular_l1_m", "/novel_views/specular/l1_m"),
    ("chamfer_m", "/mesh/chamfer_m"),
    ("f_score", "/mesh/f_score"),
    ("floaters_m3", "/floaters/volume_m3"),
    ("spots", "/spots"),
];

/// The reconstructions at a place, if there are any.
pub async fn find(place: &str) -> Result<Option<Reconstructions>> {
    let (store, prefix) = open_store(place).map_err(failed)?;
    match Reconstructions::open(store, prefix).await {
        Ok(there) => Ok(Some(there)),
        Err(error @ DatasetError::Store { .. }) => Err(failed(error)),
        // What else may lie there is not for this to say.
        Err(_) => Ok(None),
    }
}

/// `dataset info`.
pub async fn info(place: &str, there: &Reconstructions, output: Output) -> Result<()> {
    let scenes = there.scenes_present().await.map_err(failed)?;
    let read = scenes
        .iter()
        .map(|scene| there.read(*scene, "metrics.json"));
    let all: Vec<bytes::Bytes> = stream::iter(read)
        .buffered(CONCURRENCY)
        .try_collect()
        .await
        .map_err(failed)?;
    let all: Vec<Value> = all
        .iter()
        .map(|bytes| serde_json::from_slice(bytes))
        .collect::<std::result::Result<_, _>>()
        .map_err(|e| {
            CliError::new(
                Code::Failed,
                format!("{place}: metrics.json of a scene: {e}"),
            )
        })?;
    let mut means = Map::new();
    for (name, way) in FIGURES {
        // A class without pixels has no error.
        let empty = |m: &Value| {
            let class = way.rsplit_once('/').map_or("", |(class, _)| class);
            m.pointer(&format!("{class}/pixels")) == Some(&json!(0))
        };
        let of = all.iter().filter(|m| !empty(m));
        let values: Vec<f64> = of
            .filter_map(|m| m.pointer(way).and_then(Value::as_f64))
            .collect();
        if !values.is_empty() {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            means.insert(name.into(), json!({"mean": mean, "scenes": values.len()}));
        }
    }
    let shown = json!({"reconstructions": place, "scenes": scenes.len(), "means": means});
    output.result(&shown, || {
        let mut text = format!("{place}: reconstructions of {} scenes\n", scenes.len());
        for (name, mean) in &means {
            text += &format!(
                "{name:>14} {:.4}, mean over {}\n",
                mean["mean"].as_f64().unwrap_or_default(),
                mean["scenes"]
            );
        }
        text
    });
    Ok(())
}

/// `dataset verify`.
///
/// # Errors
/// Exit code 6 naming what is broken.
pub async fn verify(args: &DatasetVerify, there: &Reconstructions, output: Output) -> Result<()> {
    if args.snapshot.is_some() || args.complete {
        return Err(CliError::input(format!(
            "{}: reconstructions have no snapshots and no number of scenes; leave --snapshot and --complete away",
            args.dataset
        )));
    }
    let late = Late::new("scenes checked", output);
    let watch = |done, of| late.at(done, of);
    let report = there.verify(mode(args.fast), &watch).await;
    late.finish();
    let report = report.map_err(failed)?;
    let facts = json!({
        "reconstructions": args.dataset, "fast": args.fast, "scenes": report.scenes, "objects": report.objects,
        "bytes": report.bytes, "problems": problems_json_by(&report.problems, hint),
    });
    if output.json || report.is_sound() {
        output.result(&facts, || {
            format!(
                "{} scenes, {} objects, {}: whole{}",
                report.scenes,
                report.objects,
                bytes(report.bytes),
                if args.fast {
                    " by manifests and sizes"
                } else {
                    ""
                }
            )
        });
    }
    match report.is_sound() {
        true => Ok(()),
        false => Err(broken_by(&args.dataset, &report.problems, hint)),
    }
}

/// How it is repaired.
fn hint(_: &Problem) -> &'static str {
    "submit its job again with `picofarm job submit FILE --from-stage STAGE`, with its reconstruct stage: what is damaged is \
     made again, proved equal, and put back"
}
