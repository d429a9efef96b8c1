//! What runs a task, and the state that tasks of every kind share.

#[cfg(feature = "networks")]
use std::collections::BTreeMap;
#[cfg(feature = "networks")]
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use picofarm_exchange::import::Source;
use picofarm_files::Opener;
#[cfg(feature = "networks")]
use picofarm_model::{Model, device::OpenGpu};
use picofarm_proto::spec::{ImportSettings, SpecError};
use picofarm_scene::AssetLibrary;
pub use picofarm_session::{Control, Output, Task, TaskError};

#[cfg(feature = "networks")]
use crate::interpreter::Interpreter;
use crate::{stores::Stores, submission::Submission};

/// Runs the tasks of a kind.
pub(crate) trait RunTask {
    /// Returns the version of the code that determines the bytes of its results. Empty if this
    /// program was built without the kind.
    fn code_version() -> String
    where
        Self: Sized;

    /// Runs a task of this kind to its end. The task's version equals this program's.
    ///
    /// # Errors
    /// [`TaskError`], classified by cause.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError>;

    /// Completes the spec when a job is submitted: fills in the inputs of its tasks other than the
    /// version and absolute paths, and makes the checks that only this code can make.
    ///
    /// # Errors
    /// [`SpecError`] naming the field.
    fn resolve(&mut self, _here: &Submission<'_>) -> Result<(), SpecError> {
        Ok(())
    }
}

/// State shared by tasks of every kind.
pub(crate) struct Context {
    /// Furniture.
    pub libraries: Vec<AssetLibrary>,
    /// Opened stores.
    pub stores: Stores,
    /// The latest import source, so that a folder with many scenes is listed only once.
    pub source: Latest<Option<(ImportSettings, Arc<Source>)>>,
    /// Opens scene files and imports.
    pub files: Opener,
    /// Address at which other workers reach this one.
    #[cfg(feature = "networks")]
    pub peers: String,
    /// GPUs that tasks may use.
    #[cfg(feature = "networks")]
    pub gpus: Vec<OpenGpu>,
    /// The Python interpreter for trainings by PyTorch, if it has PyTorch.
    #[cfg(feature = "networks")]
    pub torch: Option<Interpreter>,
    /// The models that the latest inference used.
    #[cfg(feature = "networks")]
    pub models: Latest<Models>,
    /// The interpreter for Python code of jobs; `None` = such tasks are not accepted.
    #[cfg(feature = "networks")]
    pub python: Option<Interpreter>,
    /// Folder of virtual environments for that code; `None` = the interpreter must have all that
    /// a job requires.
    #[cfg(feature = "networks")]
    pub environments: Option<PathBuf>,
}

impl Context {
    /// Returns the inputs for making scenes.
    pub fn scenes(&self) -> (&[AssetLibrary], &Opener) {
        (&self.libraries, &self.files)
    }
}

/// Models by the SHA-256 of their manifest and by whether they are on a GPU.
#[cfg(feature = "networks")]
pub(crate) type Models = BTreeMap<(String, bool), Arc<Model>>;

/// A value that the latest task of a kind leaves for the next one.
#[derive(Debug, Default)]
pub(crate) struct Latest<T>(Mutex<T>);

impl<T: Clone> Latest<T> {
    /// Returns a copy of the value.
    pub fn get(&self) -> T {
        self.0.lock().expect("no panic while locked").clone()
    }

    /// Replaces the value.
    pub fn set(&self, value: T) {
        *self.0.lock().expect("no panic while locked") = value;
    }
}

/// Returns a message on how to build picofarm with a missing kind.
pub(crate) fn not_built(kind: &str) -> String {
    format!(
        "this picofarm was built without networks, which stages of kind {kind:?} need; build it with `--features networks`"
    )
}

/// Continues a task at this fraction of its progress.
///
/// # Errors
/// [`TaskError::Stopped`] if the task must stop.
pub(crate) fn proceed(control: &Control, fraction: f32) -> Result<(), TaskError> {
    match control.at(fraction) {
        true => Ok(()),
        false => Err(TaskError::Stopped),
    }
}
