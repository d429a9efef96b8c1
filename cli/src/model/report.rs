//! `picofarm model report`: a page about trained models.

use std::{collections::BTreeMap, fs, path::Path, sync::Arc, time::SystemTime};

use picofarm_agent::{Control, gallery::Gallery};
use picofarm_dataset::{Evaluation, ModelManifest, Models};
use picofarm_model::{
    Evaluated, Model,
    metric::Metrics,
    report::{Data, Entry, Report, html, json},
    train::Line,
};
use serde_json::{Value, json};
use tokio::runtime::Handle;

use super::{WEIGHTS, open};
use crate::{
    dataset::{failed, task_failed},
    error::{CliError, Code, Result, io},
    output::Output,
};

pub(super) async fn run(
    store: &str,
    names: &[String],
    (out, title): (&Path, String),
    pictures: usize,
    output: Output,
) -> Result<()> {
    let models = open(store)?;
    let mut entries = Vec::new();
    for name in chosen(&models, names).await? {
        output.say(format!("reads {name}"));
        entries.push(entry(store, &models, &name, pictures).await?);
    }
    let date = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    let report = Report {
        title,
        date: date[..10].to_owned(),
        models: entries,
    };
    let beside = out.with_extension("json");
    for (path, text) in [(out, html(&report)), (&beside, json(&report))] {
        fs::write(path, text).map_err(|e| io(path.display(), &e))?;
    }
    let facts = json!({"page": out, "json": beside, "models": report.models.len()});
    output.result(&facts, || {
        format!(
            "{} models: {} and {}",
            report.models.len(),
            out.display(),
            beside.display()
        )
    });
    Ok(())
}

/// The finished models that are meant.
async fn chosen(models: &Models, names: &[String]) -> Result<Vec<String>> {
    let mut there = Vec::new();
    for name in models.names().await.map_err(failed)? {
        if models.look(&name).await.map_err(failed)?.is_some() {
            there.push(name);
        }
    }
    let mut chosen: Vec<String> = Vec::new();
    for wanted in names {
        let begins = wanted.strip_suffix('*');
        let meant = |name: &&String| match begins {
            Some(begin) => name.starts_with(begin),
            None => *name == wanted,
        };
        let found: Vec<String> = there.iter().filter(meant).cloned().collect();
        if found.is_empty() {
            return Err(
                CliError::input(format!("no finished model is called {wanted:?}"))
                    .hint(format!("there are: {}", there.join(", "))),
            );
        }
        chosen.extend(found);
    }
    match (names.is_empty(), there.is_empty()) {
        (true, true) => Err(CliError::input("the store holds no finished models")
            .hint("`picofarm job init --kind train` writes a job that trains some")),
        (true, false) => Ok(there),
        (false, _) => {
            chosen.sort();
            chosen.dedup();
            Ok(chosen)
        }
    }
}

async fn entry(store: &str, models: &Models, name: &str, pictures: usize) -> Result<Entry> {
    let manifest = models.manifest(name).await.map_err(failed)?;
    let broken = |what: String| CliError::new(Code::Damaged, format!("model {name:?}: {what}"));
    let mut evaluations = models.evaluations(name).await.map_err(failed)?;
    let sha256 = manifest.sha256();
    evaluations.retain(|e| e.model_sha256 == sha256);
    let evaluation = evaluations.into_iter().max_by_key(|e| e.scenes);
    let mut entry = match &evaluation {
        Some(evaluation) => {
            let (gallery, store) = (Gallery::new(Handle::current()), store.to_owned());
            let evaluation = Arc::new(evaluation.clone());
            let shown = tokio::task::spawn_blocking(move || {
                gallery.show(&store, &evaluation, pictures, &Control::default())
            });
            let shown = shown
                .await
                .map_err(|e| CliError::new(Code::Failed, format!("drawing broke: {e}")))?
                .map_err(task_failed)?;
            Entry {
                pictures: shown.pictures,
                ..Entry::new(name, &shown.model, shown.side)
            }
        }
        None => {
            let weights = models.read(&manifest, WEIGHTS).await.map_err(failed)?;
            let model = Model::read(&weights, &picofarm_model::cpu());
            let model = model.map_err(|e| broken(e.to_string()))?;
            let mut entry = Entry::new(name, &model, 0);
            entry.multiply_adds = None;
            entry
        }
    };
    let history = models
        .read(&manifest, "history.jsonl")
        .await
        .map_err(failed)?;
    let lines = String::from_utf8_lossy(&history);
    let lines = lines.lines().map(serde_json::from_str::<Line>);
    entry.history = lines
        .collect::<std::result::Result<_, _>>()
        .map_err(|e| broken(format!("history.jsonl: {e}")))?;
    entry.evaluated = evaluation
        .as_ref()
        .map(|e| evaluated(&e.metrics))
        .transpose()
        .map_err(|e| broken(format!("its evaluation: {e}")))?;
    describe(&mut entry, &manifest, evaluation.as_ref());
    Ok(entry)
}

/// An evaluation's figures as they lie in the store: those of all scenes, beside them those of trivial answers, by name, and
/// of each scene.
fn evaluated(found: &Value) -> serde_json::Result<Evaluated> {
    let part = |name: &str| found.get(name).cloned().unwrap_or_default();
    let baselines: BTreeMap<String, Metrics> = serde_json::from_value(part("baselines"))?;
    Ok(Evaluated {
        metrics: serde_json::from_value(found.clone())?,
        baselines: baselines.into_iter().collect(),
        scenes: serde_json::from_value(part("by_scene"))?,
        examples: serde_json::from_value(part("examples"))?,
    })
}

/// Where it comes from.
fn describe(entry: &mut Entry, manifest: &ModelManifest, evaluation: Option<&Evaluation>) {
    let from = &manifest.lineage;
    entry.data = Data {
        name: from.dataset.clone(),
        scenes: Some(from.training_scenes),
        ..Data::default()
    };
    let setting = |path: &str| manifest.settings.pointer(path).and_then(|v| v.as_str());
    if let Some(histogram) = setting("/histogram") {
        let histogram = histogram.to_owned();
        entry.conditions.push(("histogram".into(), histogram));
    }
    if let Some(tof) = setting("/shadow/tof") {
        let tof = if tof == "truth" {
            "the truth"
        } else {
            "a depth network"
        };
        entry
            .conditions
            .push(("two-bounce times from".into(), tof.into()));
    }
    if setting("/from").is_some() {
        entry.conditions.push(("begins".into(), "trained".into()));
    }
    let line = |name: &str, value: String| (name.to_owned(), value);
    entry.lineage = vec![
        line("data", format!("{} ({})", from.dataset, from.data)),
        line(
            "split",
            format!("{} version {}", from.split.name, from.split.version),
        ),
        line("code", from.code.clone()),
        line("training key", manifest.training_key.clone()),
        line("manifest SHA-256", manifest.sha256()),
    ];
    for (name, sha256) in &from.models {
        entry
            .lineage
            .push(line("builds on", format!("{name} ({sha256})")));
    }
    if let Some(e) = evaluation {
        let on = format!("{} {} scenes of {}", e.scenes, e.side, e.dataset);
        entry.lineage.push(line("evaluated on", on));
    }
}
