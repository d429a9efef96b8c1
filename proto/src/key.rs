//! Keys of results. A stage key hashes everything that affects the outputs of a job's tasks; a task
//! key adds the task's index. Equal keys mean equal bytes: resume, reuse and reprocessing rely on
//! this.

use std::collections::BTreeMap;

use sha2::{Digest, Sha256};

use crate::{
    spec::{Histogram, JobSpec, ReportSettings, StageSpec, TrainSettings},
    split::SplitSettings,
};
use hash::canonical;

pub(crate) mod hash;

pub use hash::{StageKey, TaskKey, derived_key, task_key};

/// Returns the key of a stage: everything that affects the results of its tasks except their
/// number. An input data set counts by its place.
pub fn stage_key(stage: &StageSpec) -> StageKey {
    StageKey::of(stage.task.shaping())
}

/// Returns the key of the single task of a split stage over the first `scenes` scenes of `source`.
pub fn split_key(settings: &SplitSettings, source: &StageKey, scenes: u64) -> TaskKey {
    let description = serde_json::json!({
        "task": "split",
        "settings": serde_json::to_value(settings).expect("settings are plain data"),
        "source": source.to_string(),
        "scenes": scenes,
    });
    TaskKey(Sha256::digest(canonical(description).as_bytes()).into())
}

/// Returns the key of a training. It contains the settings and the code, the pinned training and
/// validation scenes in order, and its inputs by field: models by the SHA-256 of their manifests,
/// and predictions by their pinned bytes. Names and places do not count.
pub fn training_key(
    settings: &TrainSettings,
    [training, validation]: [&str; 2],
    built_on: &BTreeMap<&str, String>,
) -> TaskKey {
    let mut shaping = settings.clone();
    shaping.split = String::new();
    shaping.scenes = 0;
    shaping.io_mut().models.replace_all("model");
    if shaping.times().is_some() {
        shaping.shadow.times = "predictions".into();
    }
    let description = serde_json::json!({
        "task": "train",
        "settings": shaping.shaping(),
        "training": training,
        "validation": validation,
        "models": built_on,
    });
    TaskKey(Sha256::digest(canonical(description).as_bytes()).into())
}

/// Returns the key of an evaluation of one model. It contains the model by the SHA-256 of its
/// manifest, the pinned scenes and those to which plain answers are fitted, in order, and the
/// histogram. It also contains the source of two-bounce times (`truth`, or the pinned predictions;
/// empty if none are used), whether the model's sensor is applied, and the code.
pub fn evaluation_key(
    model_sha256: &str,
    data: [&str; 2],
    times: &str,
    (histogram, spots): (Histogram, &[u32]),
    sensor: bool,
    version: &str,
) -> TaskKey {
    let description = serde_json::json!({
        "task": "evaluate",
        "model": model_sha256,
        "data": data,
        "histogram": histogram,
        "spots": spots,
        "times": times,
        "sensor": sensor,
        "version": version,
    });
    TaskKey(Sha256::digest(canonical(description).as_bytes()).into())
}

/// Returns the key of models' predictions for one scene. It contains the scene by the SHA-256 of
/// its manifest, each model by that of its manifest with its histogram, the source of two-bounce
/// times, and the code.
pub fn inference_key(
    scene_sha256: &str,
    models: &BTreeMap<&str, (String, Histogram, Vec<u32>)>,
    times: &str,
    version: &str,
) -> TaskKey {
    let description = serde_json::json!({
        "task": "infer",
        "scene": scene_sha256,
        "models": models,
        "times": times,
        "version": version,
    });
    TaskKey(Sha256::digest(canonical(description).as_bytes()).into())
}

/// Returns the key of a report: its settings without name and place, the pinned models and their
/// evaluations in order, and the code.
pub fn report_key(settings: &ReportSettings, models: &[String]) -> TaskKey {
    let description = serde_json::json!({
        "task": "report",
        "title": settings.title,
        "pictures": settings.pictures,
        "version": settings.version,
        "models": models,
    });
    TaskKey(Sha256::digest(canonical(description).as_bytes()).into())
}

/// Returns the seed of scene `index`: the first eight bytes of SHA-256("scene", seed, index).
pub fn scene_seed(seed: u64, index: u64) -> u64 {
    let mut hash = Sha256::new();
    hash.update(b"scene");
    hash.update(seed.to_le_bytes());
    hash.update(index.to_le_bytes());
    let digest = hash.finalize();
    u64::from_le_bytes(digest[..8].try_into().expect("a digest has 32 bytes"))
}

/// Returns the SHA-256 of the whole spec. Two submissions with equal hashes are the same job.
pub fn spec_hash(spec: &JobSpec) -> String {
    let description = serde_json::to_value(spec).expect("a spec is plain data");
    hex::encode(Sha256::digest(canonical(description).as_bytes()))
}
