//! Results of an own training: a model's objects and figures.

use std::fs;

use bytes::Bytes;
use picofarm_proto::spec::kinds::PythonTask;
use picofarm_results::{ModelManifest, Models, NewModel, TrialEnd};
use picofarm_store::published::Manifest as _;
use serde_json::{Value, json};

use super::{
    KIND,
    inputs::Inputs,
    recorder::{Recorder, epochs},
};
use crate::{
    stores::Stores,
    task::{Control, Output, TaskError},
    trial::EndedTrial,
};

/// Name of the object with the reports.
const HISTORY: &str = "history.jsonl";
/// Name of the object with the figures.
const METRICS: &str = "metrics.json";
/// Name of the object with the code.
const CODE: &str = "code.json";
/// Names that no artefact can have.
pub(super) const RESERVED: [&str; 4] = [HISTORY, METRICS, CODE, "manifest.json"];

/// Returns the model of a training that came to its end.
pub(super) fn model(
    task: &PythonTask,
    inputs: &Inputs,
    recorder: Recorder<'_>,
    (result, facts): (Value, Value),
) -> Result<NewModel, TaskError> {
    let settings = &task.python;
    let history = recorder.history();
    let mut metrics = json!({
        "epochs": epochs(history),
        "reports": history.len(),
        "latest": recorder.latest(),
        "environment": facts,
        "repeatable": false,
    });
    if !settings.objective.is_empty() {
        metrics["objective"] = json!({
            "metric": settings.objective, "goal": settings.goal, "loss": recorder.loss(),
        });
    }
    if !result.is_null() {
        metrics["result"] = result;
    }
    let code: Value = json!({
        "entry": settings.entry,
        "files": settings.code,
    });
    let mut objects = vec![
        (HISTORY.to_owned(), Bytes::from(lines(history))),
        (METRICS.to_owned(), pretty(&metrics).into()),
        (CODE.to_owned(), pretty(&code).into()),
    ];
    for (name, path) in recorder.artifacts() {
        let bytes = fs::read(path)
            .map_err(|e| TaskError::Interrupted(format!("{}: {e}", path.display())))?;
        objects.push((name.clone(), bytes.into()));
    }
    Ok(NewModel {
        manifest: ModelManifest {
            name: settings.model.clone(),
            kind: KIND.to_owned(),
            training_key: inputs.key.clone(),
            settings: settings.shaping(),
            lineage: inputs.lineage.clone(),
            metrics,
            ..ModelManifest::default()
        },
        objects,
    })
}

/// Returns the figures of a trial whose model is stored.
pub(super) fn ended(
    manifest: &ModelManifest,
    stores: &Stores,
    models: &Models,
    control: &Control,
) -> Result<EndedTrial, TaskError> {
    let history = stores.wait(control, models.read(manifest, HISTORY))?;
    let text = String::from_utf8_lossy(&history);
    let history: Result<Vec<Value>, _> = text.lines().map(serde_json::from_str).collect();
    let history = history.map_err(|e| TaskError::Crash(format!("{HISTORY}: {e}")))?;
    Ok(EndedTrial {
        end: TrialEnd::Finished,
        epochs: epochs(&history),
        loss: manifest.metrics["objective"]["loss"].as_f64(),
        history,
    })
}

pub(super) fn output(manifest: &ModelManifest, adopted: bool) -> Output {
    Output {
        manifest_sha256: manifest.sha256(),
        bytes: manifest.total_bytes(),
        adopted,
    }
}

fn lines(history: &[Value]) -> Vec<u8> {
    let lines = history.iter().map(|line| format!("{line}\n"));
    lines.collect::<String>().into_bytes()
}

fn pretty(value: &Value) -> Vec<u8> {
    let mut value = value.clone();
    value.sort_all_objects();
    let mut bytes = serde_json::to_vec_pretty(&value).expect("plain data");
    bytes.push(b'\n');
    bytes
}
