//! The worker's executor: every kind of task there is, each in a file of its own beside this one.

use std::{collections::BTreeMap, path::PathBuf, time::Duration};

use picofarm_proto::model::{
    TaskSpec,
    task::{EXPORT_VERSION, SPLIT_VERSION},
};
use picofarm_scene::AssetLibrary;
use tokio::runtime::Handle;

use super::{
    Control, Executor, Output, Task, TaskError, evaluate, export, generate, import, infer,
    output::Stores, parts, promote, render, report, reprocess, scenes, split, train,
};

/// How long a finished scene waits for a store that is full or away before its task is handed back.
pub(super) const STORE_PATIENCE: Duration = Duration::from_secs(120);

/// Runs tasks of every kind.
pub struct TaskExecutor {
    libraries: Vec<AssetLibrary>,
    stores: Stores,
    sources: import::Sources,
    minds: infer::Minds,
}

impl TaskExecutor {
    /// An executor with the furniture found in `asset_dirs` and the usual places. Stores are reached through
    /// `runtime`, which must not be a thread of the executor's own.
    pub fn new(asset_dirs: &[PathBuf], runtime: Handle) -> Self {
        Self {
            libraries: scenes::find_libraries(asset_dirs),
            stores: Stores::new(runtime, STORE_PATIENCE),
            sources: import::Sources::default(),
            minds: infer::Minds::default(),
        }
    }
}

impl Executor for TaskExecutor {
    fn kinds(&self) -> BTreeMap<String, String> {
        [
            ("render", render::renderer_version()),
            ("generate", generate::generator_version()),
            ("import", import::import_version()),
            ("part", render::renderer_version()),
            ("reprocess", reprocess::sensor_version()),
            ("split", SPLIT_VERSION.to_owned()),
            ("export", EXPORT_VERSION.to_owned()),
            ("train", train::model_version()),
            ("evaluate", train::model_version()),
            ("promote", train::model_version()),
            ("infer", infer::infer_version()),
            ("report", train::model_version()),
        ]
        .map(|(kind, version)| (kind.to_owned(), version))
        .into()
    }

    fn assets(&self) -> Vec<String> {
        let fingerprints = self.libraries.iter().map(|l| l.fingerprint().to_owned());
        fingerprints.collect()
    }

    fn run(&self, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let stores = &self.stores;
        match &task.spec.task {
            TaskSpec::Render(spec) => render::run(stores, &self.libraries, spec, task, control),
            TaskSpec::Part(spec) => parts::run(stores, &self.libraries, spec, task, control),
            TaskSpec::Generate(spec) => generate::run(stores, &self.libraries, spec, task, control),
            TaskSpec::Import(spec) => import::run(stores, &self.sources, spec, task, control),
            TaskSpec::Reprocess(spec) => {
                reprocess::run(stores, spec, task.spec.force, task.index, control)
            }
            TaskSpec::Split(spec) => {
                let place = &spec.source;
                let run = split::run(stores, &spec.split, &place.store, &place.dataset, control);
                run.map(|split| Output::from(&split))
            }
            TaskSpec::Export(spec) => export::run(stores, spec, control),
            TaskSpec::Train(spec) => {
                let gpus = task.spec.resources.gpus;
                train::run(stores, spec, (task.spec.force, gpus), control)
            }
            TaskSpec::Evaluate(spec) => evaluate::run(stores, spec, control),
            TaskSpec::Promote(spec) => promote::run(stores, spec, control),
            TaskSpec::Infer(spec) => {
                let force = task.spec.force;
                infer::run(stores, &self.minds, spec, force, task.index, control)
            }
            TaskSpec::Report(spec) => report::run(stores, spec, task.spec.force, control),
        }
    }
}
