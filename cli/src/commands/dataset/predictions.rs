//! `picofarm dataset info|show|verify` for predictions, by models or by physics.

use futures::{StreamExt, TryStreamExt, stream};
use picofarm_results::{
    ModelUsed, PredictionManifest, PredictionSpec, Predictions, TimesUsed, Verdict,
};
use picofarm_store::published::Manifest as _;
use picofarm_store::{Problem, Remedy, open_store};
use serde_json::json;

use super::{
    failed,
    late::Late,
    problems::{broken_by, mode, problems_json_by},
};
use crate::{
    args::{DatasetShow, DatasetVerify},
    error::{CliError, Result},
    output::{Output, bytes, table},
};

/// Requests in flight.
const CONCURRENCY: usize = 16;

/// Opens the predictions at a location, if there are any.
pub async fn find(place: &str) -> Result<Option<Predictions>> {
    let (store, prefix) = open_store(place).map_err(failed)?;
    Predictions::find(store, prefix).await.map_err(failed)
}

/// Shows an overview of the predictions.
pub async fn info(place: &str, there: &Predictions, output: Output) -> Result<()> {
    let present = there.scenes_present().await.map_err(failed)?;
    let spec = there.spec();
    let read = present.iter().map(|&scene| there.manifest(scene));
    let manifests: Vec<PredictionManifest> = stream::iter(read)
        .buffered(CONCURRENCY)
        .try_collect()
        .await
        .map_err(failed)?;
    let verdicts = manifests
        .iter()
        .map(|m| (m.scene, Verdict::of_agreement(&m.agreement)));
    let summary = summed(verdicts.filter_map(|(scene, verdict)| Some((scene, verdict?))));
    let evaluations = there.evaluations().await.map_err(failed)?;
    let facts = json!({
        "predictions": place, "spec": spec, "scenes": present.len(), "verdict": summary,
        "evaluations": evaluations,
    });
    output.result(&facts, || {
        let mut text = format!(
            "{place}: predictions ({}) of {} of {} scenes, {}x{} pixels\n",
            arrays(spec).join(", "),
            present.len(),
            spec.scenes,
            spec.width,
            spec.height
        );
        if let Some(summary) = &summary {
            text += &format!("{}\n", summary.text);
        }
        for e in &evaluations {
            let verdict = Verdict::of_evaluation(&e.predicts, &e.metrics);
            text += &format!(
                "{} on {} {} scenes of {}: {}\n",
                e.predicts, e.scenes, e.side, e.dataset, verdict.text
            );
        }
        text
    });
    Ok(())
}

/// Combines the verdicts on several scenes; `None` if there are none.
pub(super) fn summed(verdicts: impl Iterator<Item = (u64, Verdict)>) -> Option<Verdict> {
    let all: Vec<(u64, Verdict)> = verdicts.collect();
    let doubtful = || all.iter().filter(|(_, verdict)| verdict.doubtful);
    let (scene, example) = doubtful().next().or(all.first())?;
    let text = match doubtful().count() {
        0 => format!(
            "none of {} scenes is doubtful, e.g. scene {scene}: {}",
            all.len(),
            example.text
        ),
        n => format!(
            "{n} of {} scenes are doubtful, e.g. scene {scene}: {}",
            all.len(),
            example.text
        ),
    };
    Some(Verdict {
        doubtful: example.doubtful,
        text,
    })
}

fn arrays(spec: &PredictionSpec) -> Vec<String> {
    let mut names = Vec::new();
    if spec.depth {
        names.push("depth".to_owned());
    }
    match spec.spots.len() {
        0 => {}
        1 => names.push("lit by 1 spot".into()),
        n => names.push(format!("lit by each of {n} spots")),
    }
    if spec.specular {
        names.push("specular".into());
    }
    if spec.confidence {
        names.push("confidence".into());
    }
    names
}

/// Shows the origin of one scene's predictions.
pub async fn show(args: &DatasetShow, there: &Predictions, output: Output) -> Result<()> {
    let manifest = there.manifest(args.scene).await.map_err(failed)?;
    let facts = json!({
        "predictions": args.dataset, "scene": args.scene, "kind": kind(&manifest), "manifest": manifest,
        "manifest_sha256": manifest.sha256(), "bytes": manifest.total_bytes(),
    });
    output.result(&facts, || described(&manifest));
    Ok(())
}

/// Returns the kind of stage that made predictions: their code's version begins with the method.
fn kind(manifest: &PredictionManifest) -> &'static str {
    match manifest.code.starts_with("demultiplex") {
        true => "demultiplex",
        false => "infer",
    }
}

fn described(manifest: &PredictionManifest) -> String {
    let row = |name: &str, value: String| vec![name.to_owned(), value];
    let used = |model: &ModelUsed| {
        format!(
            "{} (SHA-256 {}), shown {}",
            model.name, model.manifest_sha256, model.histogram
        )
    };
    let source = &manifest.source;
    let mut rows = vec![
        row("scene", manifest.scene.to_string()),
        row("made by", kind(manifest).into()),
        row("task key", manifest.task_key.clone()),
        row("code", manifest.code.clone()),
        row("manifest", format!("SHA-256 {}", manifest.sha256())),
        row(
            "objects",
            format!(
                "{}, {}",
                manifest.objects.len(),
                bytes(manifest.total_bytes())
            ),
        ),
        row(
            "seen",
            format!(
                "scene {} of {} (SHA-256 {})",
                manifest.scene, source.dataset, source.manifest_sha256
            ),
        ),
    ];
    for (kind, model) in &manifest.models {
        rows.push(row(kind, used(model)));
    }
    match &manifest.two_bounce_times {
        None => {}
        Some(TimesUsed::Truth) => rows.push(row("two-bounce times", "of the truth".into())),
        Some(TimesUsed::Model(model)) => {
            rows.push(row("two-bounce times", format!("of {}", used(model))));
        }
    }
    if let Some(verdict) = Verdict::of_agreement(&manifest.agreement) {
        rows.push(row("verdict", verdict.text));
    }
    table(&rows)
}

/// Checks the predictions for damage.
///
/// # Errors
/// Exit code 6 naming the broken objects.
pub async fn verify(args: &DatasetVerify, there: &Predictions, output: Output) -> Result<()> {
    if args.snapshot.is_some() {
        return Err(CliError::input(format!(
            "{}: predictions have no snapshots; leave --snapshot away",
            args.dataset
        )));
    }
    let late = Late::new("scenes checked", output);
    let watch = |done, of| late.update(done, of);
    let report = there.verify(mode(args.fast), args.complete, &watch).await;
    late.finish();
    let report = report.map_err(failed)?;
    let facts = json!({
        "predictions": args.dataset, "fast": args.fast, "scenes": report.scenes, "objects": report.objects,
        "bytes": report.bytes, "problems": problems_json_by(&report.problems, remedy),
    });
    if report.is_sound() {
        output.result(&facts, || {
            let depth = match args.fast {
                true => "whole by manifests and sizes",
                false => "whole",
            };
            format!(
                "{} scenes, {} objects, {}: {depth}",
                report.scenes,
                report.objects,
                bytes(report.bytes)
            )
        });
        return Ok(());
    }
    if output.json {
        output.result(&facts, String::new);
    }
    Err(broken_by(&args.dataset, &report.problems, remedy))
}

/// Returns how to repair a problem.
fn remedy(problem: &Problem) -> Remedy {
    let text = match problem.scene {
        Some(_) => {
            "submit its job again with `picofarm job submit FILE --from-stage STAGE`, with its infer stage: what is damaged is \
             predicted again, proved equal, and put back"
        }
        None => {
            "delete it and the group's own zarr.json, and submit its job again with `picofarm job submit FILE --from-stage STAGE`: both are written anew"
        }
    };
    Remedy {
        text,
        by_repair: false,
    }
}
