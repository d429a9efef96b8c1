//! `dataset info`, `verify`, `picture` and `report` for reconstructions.

mod page;
mod picture;
mod report;

use futures::{StreamExt, TryStreamExt, stream};
use picofarm_results::{Reconstructions, Verdict};
use picofarm_store::{Problem, StorageError, Verification, VerifyMode, open_store};
use serde_json::{Map, Value, json};

pub use picture::draw;
pub use report::run as report;

use super::{
    failed,
    late::Late,
    predictions::summed,
    problems::{broken_by, mode, problems_json_by},
};
use crate::{
    args::DatasetVerify,
    error::{CliError, Code, Result},
    output::{Output, bytes},
};

/// Requests in flight.
const CONCURRENCY: usize = 16;

/// Figures of `metrics.json` for which means are reported: name and JSON pointer.
const FIGURES: [(&str, &str); 12] = [
    ("l1_m", "/novel_views/all/l1_m"),
    ("rmse_m", "/novel_views/all/rmse_m"),
    ("psnr_db", "/novel_views/psnr_db"),
    ("visible_l1_m", "/novel_views/visible/l1_m"),
    ("occluded_l1_m", "/novel_views/occluded/l1_m"),
    ("outside_l1_m", "/novel_views/outside/l1_m"),
    ("within_view_l1_m", "/novel_views/within_view/l1_m"),
    ("specular_l1_m", "/novel_views/specular/l1_m"),
    ("chamfer_m", "/mesh/chamfer_m"),
    ("f_score", "/mesh/f_score"),
    ("floaters_m3", "/floaters/volume_m3"),
    ("spots", "/spots"),
];

/// Opens the reconstructions at a location, if there are any.
pub async fn find(place: &str) -> Result<Option<Reconstructions>> {
    let (store, prefix) = open_store(place).map_err(failed)?;
    match Reconstructions::open(store, prefix).await {
        Ok(there) => Ok(Some(there)),
        Err(error @ StorageError::Store { .. }) => Err(failed(error)),
        // Other contents of the location are not this function's concern.
        Err(_) => Ok(None),
    }
}

/// Opens the reconstructions at a location, which must have some.
///
/// # Errors
/// Fails if the location is empty or contains something else.
pub async fn opened(place: &str) -> Result<Reconstructions> {
    match find(place).await? {
        Some(there) => Ok(there),
        None => {
            let what = format!("{place}: holds no reconstructions");
            Err(CliError::input(what).hint(
                "name the folder that a reconstruct stage has written; `picofarm model report` tells of models",
            ))
        }
    }
}

/// `dataset info`.
pub async fn info(place: &str, there: &Reconstructions, output: Output) -> Result<()> {
    let scenes = there.scenes_present().await.map_err(failed)?;
    let read = scenes.iter().map(|scene| metrics(place, there, *scene));
    let all: Vec<Value> = stream::iter(read)
        .buffered(CONCURRENCY)
        .try_collect()
        .await?;
    let mut means = Map::new();
    for (name, way) in FIGURES {
        let values: Vec<f64> = all.iter().filter_map(|m| figure(m, way)).collect();
        if !values.is_empty() {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            means.insert(name.into(), json!({"mean": mean, "scenes": values.len()}));
        }
    }
    let verdicts = scenes.iter().zip(&all);
    let verdict = summed(verdicts.map(|(scene, m)| (*scene, Verdict::of_reconstruction(m))));
    let shown = json!({
        "reconstructions": place, "scenes": scenes.len(), "means": means, "verdict": verdict,
    });
    output.result(&shown, || {
        let mut text = format!("{place}: reconstructions of {} scenes\n", scenes.len());
        for (name, mean) in &means {
            text += &format!(
                "{name:>16} {:.4}, mean over {}\n",
                mean["mean"].as_f64().unwrap_or_default(),
                mean["scenes"]
            );
        }
        if let Some(verdict) = &verdict {
            text += &format!("{}\n", verdict.text);
        }
        text
    });
    Ok(())
}

/// Reads the metrics of a scene.
async fn metrics(place: &str, there: &Reconstructions, scene: u64) -> Result<Value> {
    let bytes = there.read(scene, "metrics.json").await.map_err(failed)?;
    serde_json::from_slice(&bytes).map_err(|e| {
        let what = format!("{place}: scenes/{scene}/metrics.json is not JSON: {e}");
        CliError::new(Code::Damaged, what)
    })
}

/// Returns a figure of a scene's metrics by its JSON pointer; `None` if it was not measured, or the
/// class has no pixels.
fn figure(metrics: &Value, way: &str) -> Option<f64> {
    let class = way.rsplit_once('/').map_or("", |(class, _)| class);
    if metrics.pointer(&format!("{class}/pixels")) == Some(&json!(0)) {
        return None;
    }
    metrics.pointer(way).and_then(Value::as_f64)
}

/// `dataset verify`.
///
/// # Errors
/// Exit code 6 naming the broken objects.
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

/// Verifies reconstructions in full, for other commands.
///
/// # Errors
/// Exit code 6 naming the broken objects.
pub async fn check(place: &str, there: &Reconstructions) -> Result<Verification> {
    let report = there.verify(VerifyMode::Full, &|_, _| ()).await;
    let report = report.map_err(failed)?;
    match report.is_sound() {
        true => Ok(report),
        false => Err(broken_by(place, &report.problems, hint)),
    }
}

/// Returns how to repair a problem.
fn hint(_: &Problem) -> &'static str {
    "submit its job again with `picofarm job submit FILE --from-stage STAGE`, with its reconstruct stage: what is damaged is \
     made again, proved equal, and put back"
}
