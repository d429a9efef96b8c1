//! Names of results. A stage key hashes everything that shapes the outputs of a job's tasks; a task key
//! adds the task's index. Equal key, equal bytes: resume, reuse and reprocessing all rest on this.

use std::{collections::BTreeMap, fmt};

use sha2::{Digest, Sha256};

use crate::{
    model::{Histogram, JobSpec, ReportSettings, ReprocessSettings, StageSpec, TrainSettings},
    split::SplitSettings,
};

/// Hash of the canonical description of a stage's tasks, without their number, name or budgets.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct StageKey(pub [u8; 32]);

/// Names one task's result.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TaskKey(pub [u8; 32]);

macro_rules! hex_text {
    ($name:ident) => {
        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&hex::encode(self.0))
            }
        }
        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, concat!(stringify!($name), "({})"), self)
            }
        }
        impl $name {
            /// Parses 64 hexadecimal digits.
            pub fn parse(text: &str) -> Option<Self> {
                let mut bytes = [0; 32];
                hex::decode_to_slice(text, &mut bytes).ok()?;
                Some(Self(bytes))
            }
        }
    };
}
hex_text!(StageKey);
hex_text!(TaskKey);

impl StageKey {
    /// Of a description of all that shapes the results of a stage's tasks but their number.
    pub fn of(description: serde_json::Value) -> Self {
        Self(Sha256::digest(canonical(description).as_bytes()).into())
    }
}

/// The key of a stage: everything that shapes the results of its tasks but their number. A data set that is read counts
/// by its place.
pub fn stage_key(stage: &StageSpec) -> StageKey {
    StageKey::of(stage.task.shaping())
}

/// The key of task `index` of a stage.
pub fn task_key(stage: &StageKey, index: u64) -> TaskKey {
    let mut hash = Sha256::new();
    hash.update(stage.0);
    hash.update(index.to_le_bytes());
    TaskKey(hash.finalize().into())
}

/// The stage key of a reprocess stage: everything but the places of source and target, which follow from the keys of
/// the source's scenes ([`derived_key`]).
pub fn reprocess_stage_key(settings: &ReprocessSettings, profile: &str) -> StageKey {
    let description = serde_json::json!({
        "task": "reprocess",
        "histogram": settings.histogram,
        "spots": settings.spots,
        "sensor": serde_json::to_value(&settings.sensor).expect("settings are plain data"),
        "drop_left_over": settings.drop_left_over,
        "seed": settings.seed,
        "version": settings.version,
        "profile": profile,
    });
    StageKey::of(description)
}

/// The key of a task that makes one scene of another: the stage, and the key of the task that made the source.
pub fn derived_key(stage: &StageKey, source: &TaskKey) -> TaskKey {
    let mut hash = Sha256::new();
    hash.update(b"derived");
    hash.update(stage.0);
    hash.update(source.0);
    TaskKey(hash.finalize().into())
}

/// The key of the one task of a split stage over the first `scenes` scenes of what `source` makes.
pub fn split_key(settings: &SplitSettings, source: &StageKey, scenes: u64) -> TaskKey {
    let description = serde_json::json!({
        "task": "split",
        "settings": serde_json::to_value(settings).expect("settings are plain data"),
        "source": source.to_string(),
        "scenes": scenes,
    });
    TaskKey(Sha256::digest(canonical(description).as_bytes()).into())
}

/// Names what a training makes: settings and code, the scenes learnt from and validated on by what pins their bytes, in
/// order, and the models that it builds on (by field: SHA-256 of the manifest). No name and no place counts.
pub fn training_key(
    settings: &TrainSettings,
    [training, validation]: [&str; 2],
    models: &BTreeMap<&str, String>,
) -> TaskKey {
    let mut shaping = settings.clone();
    shaping.split = String::new();
    shaping.scenes = 0;
    for (_, name) in shaping.models_mut() {
        *name = "model".into();
    }
    let description = serde_json::json!({
        "task": "train",
        "settings": shaping.shaping(),
        "training": training,
        "validation": validation,
        "models": models,
    });
    TaskKey(Sha256::digest(canonical(description).as_bytes()).into())
}

/// Names what an evaluation of one model finds: the model by the SHA-256 of its manifest, what pins the bytes of the scenes
/// and of those that plain answers are fitted to, in order, the histogram and the code.
pub fn evaluation_key(
    model_sha256: &str,
    data: [&str; 2],
    histogram: Histogram,
    spots: &[u32],
    version: &str,
) -> TaskKey {
    let description = serde_json::json!({
        "task": "evaluate",
        "model": model_sha256,
        "data": data,
        "histogram": histogram,
        "spots": spots,
        "version": version,
    });
    TaskKey(Sha256::digest(canonical(description).as_bytes()).into())
}

/// Names what models predict of one scene: the scene by the SHA-256 of its manifest, each kind of model by that of its
/// manifest and the histogram that it sees, what two-bounce times follow from, and the code.
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

/// Names a report: its settings but for name and place, the models and their evaluations by what pins them, in order, and the
/// code.
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

/// The seed of scene `index`: the first eight bytes of SHA-256("scene", seed, index).
pub fn scene_seed(seed: u64, index: u64) -> u64 {
    let mut hash = Sha256::new();
    hash.update(b"scene");
    hash.update(seed.to_le_bytes());
    hash.update(index.to_le_bytes());
    let digest = hash.finalize();
    u64::from_le_bytes(digest[..8].try_into().expect("a digest has 32 bytes"))
}

/// SHA-256 over the whole spec: two submissions with equal hash are the same job.
pub fn spec_hash(spec: &JobSpec) -> String {
    let description = serde_json::to_value(spec).expect("a spec is plain data");
    hex::encode(Sha256::digest(canonical(description).as_bytes()))
}

/// JSON with the members of each object sorted. Whether serde_json sorts them by itself depends on its feature
/// `preserve_order`, which any crate of a build may switch on.
fn canonical(mut description: serde_json::Value) -> String {
    description.sort_all_objects();
    description.to_string()
}
