//! `picofarm dataset verify`: finds broken objects and shows how to repair them.

use picofarm_dataset::{Dataset, Snapshot, VerifyOptions};
use picofarm_store::{Verification, VerifyMode};
use serde_json::json;

use super::{
    failed,
    late::Late,
    open, predictions,
    problems::{SHOWN, broken, mode, problems_json},
    reconstructions,
};
use crate::{
    args::DatasetVerify,
    error::Result,
    output::{Output, bytes},
};

pub async fn run(args: &DatasetVerify, output: Output) -> Result<()> {
    if let Some(there) = predictions::find(&args.dataset).await? {
        return predictions::verify(args, &there, output).await;
    }
    if let Some(there) = reconstructions::find(&args.dataset).await? {
        return reconstructions::verify(args, &there, output).await;
    }
    let dataset = open(&args.dataset).await?;
    let snapshot = match &args.snapshot {
        Some(name) => Some(dataset.snapshot(name).await.map_err(failed)?),
        None => None,
    };
    let how = How {
        fast: args.fast,
        complete: args.complete,
        snapshot: snapshot.as_ref(),
    };
    let report = look(&dataset, &how, output).await?;
    tell(&args.dataset, &how, &report, output)
}

/// Scope of the verification.
pub struct How<'a> {
    pub fast: bool,
    pub complete: bool,
    pub snapshot: Option<&'a Snapshot>,
}

/// Verifies a data set and shows progress.
pub async fn look(dataset: &Dataset, how: &How<'_>, output: Output) -> Result<Verification> {
    let late = Late::new("scenes checked", output);
    let watch = |done, of| late.at(done, of);
    let options = VerifyOptions {
        mode: mode(how.fast),
        complete: how.complete,
        snapshot: how.snapshot,
        watch: &watch,
    };
    let report = dataset.verify_with(&options).await.map_err(failed);
    late.finish();
    report
}

/// Prints the result.
///
/// # Errors
/// Exit code 6 naming the broken objects.
pub fn tell(place: &str, how: &How<'_>, report: &Verification, output: Output) -> Result<()> {
    let facts = json!({
        "dataset": place, "fast": how.fast, "snapshot": how.snapshot.map(|s| &s.name), "scenes": report.scenes,
        "objects": report.objects, "bytes": report.bytes, "problems": problems_json(&report.problems),
        "unpublished": report.unpublished, "unfinished": report.unfinished,
    });
    if report.is_sound() {
        output.result(&facts, || {
            let depth = match how.fast {
                true => "whole by manifests and sizes",
                false => "whole",
            };
            format!(
                "{} scenes, {} objects, {}: {depth}{}",
                report.scenes,
                report.objects,
                bytes(report.bytes),
                unfinished(report)
            )
        });
        return Ok(());
    }
    if output.json {
        output.result(&facts, String::new);
    }
    Err(broken(place, &report.problems))
}

fn unfinished(report: &Verification) -> String {
    if report.unfinished.is_empty() {
        return String::new();
    }
    let scenes = report.unfinished.iter().take(SHOWN);
    let mut scenes: Vec<String> = scenes.map(ToString::to_string).collect();
    if report.unfinished.len() > SHOWN {
        scenes.push("…".into());
    }
    format!(
        "\n{} scene(s) have objects, but no manifest: {}. They are being written, were left by killed workers, or lost \
         their manifests; --complete takes them for broken",
        report.unfinished.len(),
        scenes.join(", ")
    )
}

/// Verifies a data set in full, for other commands.
///
/// # Errors
/// Exit code 6 naming the broken objects.
pub async fn check(place: &str) -> Result<Verification> {
    let report = open(place)
        .await?
        .verify(VerifyMode::Full)
        .await
        .map_err(failed)?;
    match report.is_sound() {
        true => Ok(report),
        false => Err(broken(place, &report.problems)),
    }
}
