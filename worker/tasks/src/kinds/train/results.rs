//! Results of a training: a model's objects and figures.

use picofarm_dataset::{DatasetSpec, Manifest, Profile};
use picofarm_model::train::{Line, Trained};
use picofarm_results::{Measurement, ModelManifest};
use picofarm_store::published::Manifest as _;
use serde_json::{Value, json};

use crate::task::Output;

/// Returns the metrics of a trained network, measured when its weights were stored, and figures of
/// its training.
pub(super) fn metrics(trained: &Trained) -> Value {
    let (last, kept) = (trained.history.last(), trained.kept());
    let mut metrics = json!({
        "epochs": trained.epochs(),
        "steps": last.map(|line| line.step),
        "stopped_early": trained.stopped_early,
        "kept_step": trained.kept_step,
        "kept_epoch": kept.map(|line| line.epoch),
        "loss": kept.map(|line| line.loss),
    });
    metrics["validation"] = json!(kept.and_then(|line| line.validation));
    metrics
}

/// Describes the measurement that the scenes of a data set simulate, given the manifest of one of
/// them.
pub(super) fn measurement(spec: &DatasetSpec, spots: u32, scene: &Manifest) -> Measurement {
    let plan = &scene.provenance.plan;
    let sensed = plan["kind"] == "reprocess" && plan["sensor"]["poisson"] == true;
    Measurement {
        rows: spec.height,
        columns: spec.width,
        spots,
        max_bounces: plan["max_bounces"].as_u64().unwrap_or(0) as u32,
        photon_noise: sensed || spec.profile == Profile::CountsU16,
    }
}

/// Returns a line of JSON for each epoch, and for each validation within one.
pub(super) fn lines(history: &[Line]) -> Vec<u8> {
    let line = |line: &Line| serde_json::to_string(line).expect("figures are plain data") + "\n";
    history.iter().map(line).collect::<String>().into_bytes()
}

/// Parses the lines of `history.jsonl`.
pub(super) fn lines_of(history: &[u8]) -> Result<Vec<Line>, String> {
    let text = String::from_utf8_lossy(history);
    let lines = text.lines().map(serde_json::from_str);
    let lines: Result<_, _> = lines.collect();
    lines.map_err(|e| format!("history.jsonl: {e}"))
}

pub(super) fn output(manifest: &ModelManifest, adopted: bool) -> Output {
    Output {
        manifest_sha256: manifest.sha256(),
        bytes: manifest.total_bytes(),
        adopted,
    }
}

pub(super) fn pretty(value: &Value) -> Vec<u8> {
    let mut value = value.clone();
    value.sort_all_objects();
    let mut bytes = serde_json::to_vec_pretty(&value).expect("figures are plain data");
    bytes.push(b'\n');
    bytes
}
