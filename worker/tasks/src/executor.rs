//! The table of all kinds of task, and the executor that runs their tasks.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use picofarm_files::Opener;
use picofarm_proto::messages::{Check, Examine};
use picofarm_proto::spec::{
    EvaluateShardTask, EvaluateTask, ExportTask, GenerateTask, ImportTask, InferTask, PartTask,
    PromoteTask, RenderTask, ReportTask, ReprocessTask, SpecError, SplitTask, TaskSpec, TrainTask,
    kinds::{
        CalibrateTask, Declared, DemultiplexTask, PythonTask, ReconstructTask, VerifyTask,
        export::FORMATS, reconstruct::MLP,
    },
};
use picofarm_session::{AgentError, Executor};
use picofarm_settings::Gpus;
use tokio::runtime::Handle;

#[cfg(feature = "networks")]
use crate::{device, interpreter::Interpreter, kinds::train::has_torch, python};
use crate::{
    examine,
    input::scenes,
    stores::{STORE_PATIENCE, Stores},
    submission::Submission,
    task::{Context, Control, Latest, Output, RunTask, Task, TaskError, not_built},
};
#[cfg(feature = "networks")]
use picofarm_proto::spec::train::TORCH;

/// Address of workers that only workers of the same machine can reach.
#[cfg(feature = "networks")]
const LOOPBACK: &str = "127.0.0.1";

macro_rules! kinds {
    ($($kind:ident($task:ident),)*) => {
        /// Returns the version of this program's code for each kind.
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
    Demultiplex(DemultiplexTask),
    Calibrate(CalibrateTask),
    Python(PythonTask),
}

/// Optional parts of kinds, and whether this program was built with them. See
/// [`TaskSpec::ability`].
const PARTS: [(&str, &str, bool); 2] = [
    (ExportTask::NAME, FORMATS, cfg!(feature = "formats")),
    (ReconstructTask::NAME, MLP, cfg!(feature = "networks")),
];

/// Returns the version of this program's code for a kind.
fn version(kind: &str) -> String {
    let found = versions().into_iter().find(|(name, _)| *name == kind);
    found.map_or_else(String::new, |(_, version)| version)
}

/// Completes a task's spec when its job is submitted: fills in absolute paths, this program's
/// version, furniture and the hashes of files, and makes the checks that only the kind's code can
/// make.
///
/// # Errors
/// [`SpecError`] naming the first unusable field.
pub fn resolve(task: &mut TaskSpec, here: &Submission<'_>) -> Result<(), SpecError> {
    if let Some((source, _)) = task.reads_mut() {
        source.store = here.store("source.store", &source.store)?;
    }
    for (field, store) in task.io_mut().stores {
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
    /// Creates an executor with the furniture found in `asset_dirs` and the usual folders.
    /// `runtime` serves store requests and must not own the executor's thread. `files` opens scene
    /// files and imports.
    pub fn new(asset_dirs: &[PathBuf], runtime: Handle, files: Opener) -> Self {
        Self(Context {
            files,
            libraries: scenes::find_libraries(asset_dirs),
            stores: Stores::new(runtime, STORE_PATIENCE),
            source: Latest::default(),
            #[cfg(feature = "networks")]
            peers: LOOPBACK.to_owned(),
            #[cfg(feature = "networks")]
            gpus: Vec::new(),
            #[cfg(feature = "networks")]
            torch: None,
            #[cfg(feature = "networks")]
            models: Latest::default(),
            #[cfg(feature = "networks")]
            python: None,
            #[cfg(feature = "networks")]
            environments: None,
        })
    }

    /// Sets the address at which other workers reach this one: a host, or a host and port. Only
    /// builds with networks use it.
    #[must_use]
    #[cfg_attr(not(feature = "networks"), expect(unused_mut, unused_variables))]
    pub fn reached_at(mut self, peers: &str) -> Self {
        #[cfg(feature = "networks")]
        {
            peers.clone_into(&mut self.0.peers);
        }
        self
    }

    /// Opens and tests GPUs for tasks.
    ///
    /// # Errors
    /// [`AgentError::Config`] if a GPU does not exist or computes wrong results, or if this program
    /// was built without networks and any GPU is requested.
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

    /// Runs Python code of jobs with this interpreter. Without one, no such tasks are accepted.
    /// With a folder of environments, the packages that a job requires are installed there.
    ///
    /// # Errors
    /// [`AgentError::Config`] if the interpreter or the folder cannot be used, or this program was
    /// built without networks.
    #[cfg_attr(not(feature = "networks"), expect(unused_mut))]
    pub fn with_python(
        mut self,
        python: Option<&Path>,
        environments: Option<&Path>,
    ) -> Result<Self, AgentError> {
        let Some(path) = python else {
            return Ok(self);
        };
        let refused = |what: String| AgentError::Config {
            field: "python",
            what,
        };
        #[cfg(feature = "networks")]
        {
            let found = Interpreter::find(path).map_err(refused)?;
            tracing::info!(
                "runs Python code of jobs with {} ({})",
                path.display(),
                found.version()
            );
            self.0.torch = has_torch(&found).then(|| found.clone());
            self.0.python = Some(found);
            self.0.environments = match environments {
                Some(folder) => Some(python::open_environments(folder)?),
                None => None,
            };
            Ok(self)
        }
        #[cfg(not(feature = "networks"))]
        {
            let _ = environments;
            Err(refused(format!(
                "{}: this program was built without networks, which own training is a part of",
                path.display()
            )))
        }
    }

    /// Returns whether tasks of a kind can run here.
    fn runs(&self, kind: &str) -> bool {
        #[cfg(feature = "networks")]
        let python = self.0.python.is_some();
        #[cfg(not(feature = "networks"))]
        let python = false;
        kind != PythonTask::NAME || python
    }

    /// Sets the memory that tasks may use, in MiB; 0 = unknown.
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
            .filter(|(kind, version)| !version.is_empty() && self.runs(kind));
        let parts = PARTS.iter().filter(|(_, _, built)| *built);
        let parts = parts.map(|(kind, part, _)| (format!("{kind}:{part}"), version(kind)));
        #[cfg_attr(not(feature = "networks"), expect(unused_mut))]
        let mut kinds: BTreeMap<String, String> = built
            .map(|(kind, version)| (kind.to_owned(), version))
            .chain(parts)
            .collect();
        #[cfg(feature = "networks")]
        if self.0.torch.is_some() {
            let train = TrainTask::NAME;
            kinds.insert(format!("{train}:{TORCH}"), version(train));
        }
        kinds
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

    fn together(&self, task: &Task, threads: usize) -> usize {
        self.0.stores.together(&task.spec, threads)
    }

    fn examine(&self, what: &Examine) -> Vec<Check> {
        examine::worker(&self.0, what)
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
        // A lease brings only its own part of lists.
        if spec.only(0, 0).is_none() {
            spec.check().map_err(|e| TaskError::User(e.to_string()))?;
        }
        if spec.reads().is_none() {
            // Other kinds make this check after they have read their inputs.
            self.0.stores.fits(spec.clone(), None)?;
        }
        let run = || {
            self.0.stores.check_identities(control)?;
            let output = runner(spec).run(&self.0, task, control)?;
            // Output written while the store was not mounted is lost.
            self.0.stores.check_identities(control)?;
            Ok(output)
        };
        #[cfg(feature = "networks")]
        return device::on_gpu(self.0.gpu(task), run);
        #[cfg(not(feature = "networks"))]
        run()
    }
}
