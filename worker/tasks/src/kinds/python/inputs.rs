//! The inputs of an own training, and its key.

use picofarm_proto::spec::kinds::{PythonSettings, PythonTask};
use picofarm_results::{Lineage, SplitUsed};
use picofarm_store::sha256_hex;
use serde_json::{Map, Value, json};

use crate::{
    errors::in_field,
    input::{models::pin, sides::sides},
    stores::Stores,
    task::{Control, TaskError},
};

/// The sides of a split, all of which the code may read.
const SIDES: [&str; 3] = ["train", "validation", "test"];

/// What the code reads.
pub(super) struct Inputs {
    /// Key of the training: settings, code and data.
    pub(super) key: String,
    pub(super) lineage: Lineage,
    /// Data sets by name: URL and split.
    data: Value,
}

impl Inputs {
    /// Pins the scenes of the source, if there is one.
    pub(super) fn open(
        task: &PythonTask,
        stores: &Stores,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let settings = &task.python;
        let mut lineage = Lineage {
            code: settings.version.clone(),
            ..Lineage::default()
        };
        let mut data = json!({});
        if let Some(place) = &task.source {
            let dataset = stores
                .open_source(&place.store, &place.dataset, control)
                .map_err(|e| in_field("source", e))?;
            let (split, scenes) = match settings.split.is_empty() {
                true => (
                    SplitUsed::default(),
                    stores.wait(control, dataset.scenes_present())?,
                ),
                false => {
                    let named = ("python.split", &*settings.split);
                    let found = sides(stores, &dataset, named, SIDES, control)?;
                    let [train, validation, test] = found.scenes;
                    lineage.training_scenes = train.len() as u64;
                    lineage.validation_scenes = validation.len() as u64;
                    let mut all = [train, validation, test].concat();
                    all.sort_unstable();
                    (found.split, all)
                }
            };
            if settings.split.is_empty() {
                lineage.training_scenes = scenes.len() as u64;
            }
            lineage.data = pin(stores, &dataset, &scenes, control)?.id;
            lineage.dataset.clone_from(&place.dataset);
            lineage.split = split;
            let url = format!("{}/{}", place.store.trim_end_matches('/'), place.dataset);
            let version = (lineage.split.version > 0).then_some(lineage.split.version);
            data[&place.dataset] = json!({
                "url": url, "split": settings.split, "split_version": version, "scenes": scenes,
            });
        }
        let key = json!({
            "own": settings.shaping(),
            "data": [lineage.data, lineage.split.sha256],
        });
        Ok(Self {
            key: sha256_hex(key.to_string().as_bytes()),
            lineage,
            data,
        })
    }

    /// Returns the members of `task.json`.
    pub(super) fn task(&self, settings: &PythonSettings) -> Map<String, Value> {
        let members = [
            ("kind", json!("python")),
            ("parameters", json!(settings.parameters)),
            ("inputs", self.data.clone()),
            ("epochs", json!(settings.epochs)),
            ("checkpoint_minutes", json!(settings.checkpoint_minutes)),
        ];
        members
            .into_iter()
            .map(|(name, value)| (name.to_owned(), value))
            .collect()
    }
}
