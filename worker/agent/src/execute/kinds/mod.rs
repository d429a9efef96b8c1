//! The worker's executor: the table of all kinds of task, each of which runs in a file of its own here. What a kind is says
//! [`picofarm_proto::model::kinds`].

#[cfg(feature = "networks")]
pub(in crate::execute) mod device;
#[cfg(feature = "networks")]
pub(super) mod evaluate;
pub mod export;
mod generate;
pub(super) mod import;
#[cfg(feature = "networks")]
pub(super) mod infer;
pub(super) mod part;
#[cfg(feature = "networks")]
mod promote;
pub mod reconstruct;
pub(super) mod render;
#[cfg(feature = "networks")]
pub mod report;
pub mod reprocess;
#[cfg(feature = "networks")]
mod saver;
pub mod split;
#[cfg(feature = "networks")]
pub(super) mod train;
mod verify;
#[cfg(not(feature = "networks"))]
mod without_networks;

use std::{collections::BTreeMap, path::PathBuf, time::Duration};

use picofarm_files::Opener;
#[cfg(feature = "networks")]
use picofarm_model::device::OpenGpu;
use picofarm_proto::model::{
    EvaluateShardTask, EvaluateTask, ExportTask, GenerateTask, ImportTask, InferTask, PartTask,
    PromoteTask, RenderTask, ReportTask, ReprocessTask, SpecError, SplitTask, TaskSpec, TrainTask,
    kinds::{Declared, ReconstructTask, VerifyTask, export::FORMATS, reconstruct::MLP},
};
use picofarm_scene::AssetLibrary;
use picofarm_session::AgentError;
use picofarm_settings::Gpus;
use tokio::runtime::Handle;

use super::{Control, Executor, Output, Submission, Task, TaskError, output::Stores, scenes};

/// How long a finished scene waits at most for a store that is full or away before its task is handed back.
pub(in crate::execute) const STORE_PATIENCE: Duration = Duration::from_secs(120);

/// Where workers of this machine alone reach one another.
#[cfg(feature = "networks")]
const LOOPBACK: &str = "127.0.0.1";

/// How tasks of a kind run.
pub(in crate::execute) trait RunTask {
    /// Version of the code that decides the bytes of its results; empty where this program was built without it.
    fn code_version() -> String
    where
        Self: Sized;

    /// Runs a task of it to its end. The version is this program's.
    ///
    /// # Errors
    /// [`TaskError`], by who is to blame.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError>;

    /// Fills in, where a job is submitted, what its tasks must be certain of beside the version and absolute places; checks
    /// what only the code that runs it knows.
    ///
    /// # Errors
    /// [`SpecError`] naming the field.
    fn resolve(&mut self, _here: &Submission<'_>) -> Result<(), SpecError> {
        Ok(())
    }
}

/// What tasks of every kind run with.
pub(in crate::execute) struct Context {
    /// Furniture.
    pub libraries: Vec<AssetLibrary>,
    /// Stores that have been opened.
    pub stores: Stores,
    /// The import that was read last.
    pub sources: import::Sources,
    /// What opens scene files and imports.
    pub files: Opener,
    /// Where other workers reach this one.
    #[cfg(feature = "networks")]
    pub peers: String,
    /// Graphics processors that tasks may use.
    #[cfg(feature = "networks")]
    pub gpus: Vec<OpenGpu>,
    /// The networks that were asked last.
    #[cfg(feature = "networks")]
    pub models: infer::ModelCache,
}

impl Context {
    /// What scenes are made of.
    pub fn scenes(&self) -> scenes::With<'_> {
        (&self.libraries, &self.files)
    }
}

macro_rules! kinds {
    ($($kind:ident($task:ident),)*) => {
        /// The version of this program's code for each kind.
        fn versions() -> [(&'static str, String); [$(stringify!($kind)),*].len()] {
            [$(($task::NAME, $task::code_version())),*]
        }

        fn runner(task: &TaskSpec) -> &dyn RunTask {
            match task {
                $(TaskSpec::$kind(task) => task,)*
            }
        }

        fn runner_mut(task: &mut TaskSpec) -> &mut dyn RunTask {
            match task {
                $(TaskSpec::$kind(task) => task,)*
            }
        }
    };
}

kinds! {
    Render(RenderTask),
    Reprocess(ReprocessTask),
    Split(SplitTask),
    Export(ExportTask),
    Import(ImportTask),
    Generate(GenerateTask),
    Train(TrainTask),
    Evaluate(EvaluateTask),
    Promote(PromoteTask),
    Infer(InferTask),
    Report(ReportTask),
    Reconstruct(ReconstructTask),
    Verify(VerifyTask),
    Part(PartTask),
    EvaluateShard(EvaluateShardTask),
}

/// Parts of kinds that not every program has, and whether this one does: see [`TaskSpec::ability`].
const PARTS: [(&str, &str, bool); 2] = [
    (ExportTask::NAME, FORMATS, cfg!(feature = "formats")),
    (ReconstructTask::NAME, MLP, cfg!(feature = "networks")),
];

/// The version of this program's code for a kind.
fn version(kind: &str) -> String {
    let found = versions().into_iter().find(|(name, _)| *name == kind);
    found.map_or_else(String::new, |(_, version)| version)
}

/// Says how to have a kind that this program was built without.
fn not_built(kind: &str) -> String {
    format!(
        "this picofarm was built without networks, which stages of kind {kind:?} need; build it with `--features networks`"
    )
}

/// Fills in, where a job is submitted, what its tasks must be certain of: absolute places, this program's version,
/// furniture, the content of files; and checks what only the code that runs them knows.
///
/// # Errors
/// [`SpecError`] naming the first field that cannot be used.
pub fn resolve(task: &mut TaskSpec, here: &Submission<'_>) -> Result<(), SpecError> {
    if let Some((source, _)) = task.reads_mut() {
        source.store = here.store("source.store", &source.store)?;
    }
    for (field, store) in task.stores_mut() {
        *store = here.store(field, store)?;
    }
    let (field, ours) = (task.versioned().0, version(task.kind()));
    if ours.is_empty() {
        return Err(SpecError::new("kind", not_built(task.kind())));
    }
    if let Some(asked) = task.version_mut() {
        if !asked.is_empty() && *asked != ours {
            let what = format!(
                "this program has {ours:?}, the job asks for {asked:?}; leave the field out, or use the picofarm version \
                 that made the data set"
            );
            return Err(SpecError::new(field, what));
        }
        *asked = ours;
    }
    runner_mut(task).resolve(here)
}

/// Runs tasks of every kind.
pub struct TaskExecutor(Context);

impl TaskExecutor {
    /// An executor with the furniture found in `asset_dirs` and the usual places. Stores are reached through
    /// `runtime`, which must not be a thread of the executor's own. Scene files and imports are opened by `files`.
    pub fn new(asset_dirs: &[PathBuf], runtime: Handle, files: Opener) -> Self {
        Self(Context {
            files,
            libraries: scenes::find_libraries(asset_dirs),
            stores: Stores::new(runtime, STORE_PATIENCE),
            sources: import::Sources::default(),
            #[cfg(feature = "networks")]
            peers: LOOPBACK.to_owned(),
            #[cfg(feature = "networks")]
            gpus: Vec::new(),
            #[cfg(feature = "networks")]
            models: infer::ModelCache::default(),
        })
    }

    /// The same where other workers reach it at an address of this machine: host, or host and port. Without networks nobody
    /// wants to.
    #[must_use]
    #[cfg_attr(not(feature = "networks"), expect(unused_mut, unused_variables))]
    pub fn reached_at(mut self, peers: &str) -> Self {
        #[cfg(feature = "networks")]
        {
            peers.clone_into(&mut self.0.peers);
        }
        self
    }

    /// The same with graphics processors, which are opened and tried.
    ///
    /// # Errors
    /// [`AgentError::Config`] where there are none such, or one computes wrongly; in a program without networks, for any.
    #[cfg_attr(not(feature = "networks"), expect(unused_mut))]
    pub fn with_gpus(mut self, gpus: &Gpus) -> Result<Self, AgentError> {
        let refused = |what: String| AgentError::Config {
            field: "gpus",
            what,
        };
        #[cfg(feature = "networks")]
        {
            let opened = picofarm_model::device::open(gpus);
            self.0.gpus = opened.map_err(|e| refused(device::plain(e)))?;
            for gpu in &self.0.gpus {
                tracing::info!(%gpu, "{}", gpu.accuracy());
            }
        }
        #[cfg(not(feature = "networks"))]
        if *gpus != Gpus::default() {
            let what = "are for networks, which this program was built without; build it with --features wgpu or cuda";
            return Err(refused(what.into()));
        }
        Ok(self)
    }

    /// The same for tasks that may take so much memory, MiB; 0 = not known.
    #[must_use]
    pub fn with_memory(self, memory_mib: u64) -> Self {
        Self(Context {
            stores: self.0.stores.with_memory(memory_mib),
            ..self.0
        })
    }
}

impl Executor for TaskExecutor {
    fn kinds(&self) -> BTreeMap<String, String> {
        let built = versions()
            .into_iter()
            .filter(|(_, version)| !version.is_empty());
        let parts = PARTS.iter().filter(|(_, _, built)| *built);
        let parts = parts.map(|(kind, part, _)| (format!("{kind}:{part}"), version(kind)));
        built
            .map(|(kind, version)| (kind.to_owned(), version))
            .chain(parts)
            .collect()
    }

    fn gpus(&self) -> Vec<String> {
        #[cfg(feature = "networks")]
        return self.0.gpus.iter().map(ToString::to_string).collect();
        #[cfg(not(feature = "networks"))]
        Vec::new()
    }

    fn assets(&self) -> Vec<String> {
        let libraries = self.0.libraries.iter();
        libraries.map(|l| l.fingerprint().to_owned()).collect()
    }

    fn run(&self, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let spec = &task.spec.task;
        let ((field, asked), ours) = (spec.versioned(), version(spec.kind()));
        if ours.is_empty() {
            return Err(TaskError::User(not_built(spec.kind())));
        }
        if asked != ours {
            return Err(TaskError::User(format!(
                "{field}: the job asks for {asked:?}, this worker has {ours:?}; submit the job again with this version, or \
                 run workers of the other one"
            )));
        }
        // A lease brings only its part of lists.
        if spec.only(0, 0).is_none() {
            spec.check().map_err(|e| TaskError::User(e.to_string()))?;
        }
        if spec.reads().is_none() {
            // Others say it when they have seen what they read.
            self.0.stores.fits(spec.clone(), None)?;
        }
        let run = || {
            self.0.stores.check_identities(control)?;
            let output = runner(spec).run(&self.0, task, control)?;
            // What was written while the store was not mounted is not there.
            self.0.stores.check_identities(control)?;
            Ok(output)
        };
        #[cfg(feature = "networks")]
        return device::on_gpu(self.0.gpu(task), run);
        #[cfg(not(feature = "networks"))]
        run()
    }
}
