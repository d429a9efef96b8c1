//! The description of a kind of task: its form in job files, its properties for the farm, and the
//! places of its results.

use std::fmt;

use serde_json::Value;

use super::{
    division::Division,
    fields::Fields,
    io::{Io, IoMut, Makes},
    render::RenderTask,
    scenes::SceneSource,
    train::TrainSettings,
};
use crate::{
    key::hash::{StageKey, TaskKey},
    spec::{
        destination::Destination,
        memory::{Known, Network, Shape},
        places::{OutputSettings, SourceSettings},
        spec_error::SpecError,
        trial::Trial,
    },
};

/// The written form of a kind in job files and in leases.
pub trait Declared: TaskKind + Sized {
    /// Name of the kind.
    const NAME: &'static str;
    /// The fields of its stages, in addition to the common ones.
    const FIELDS: &'static [&'static str];
    /// Whether job files may name the kind. Otherwise only this program makes stages of it.
    const WRITTEN: bool = true;

    /// Reads the kind's fields.
    ///
    /// # Errors
    /// Returns an error for a missing or invalid field.
    fn read(fields: &mut Fields) -> Result<Self, SpecError>;

    /// Returns the task with its lists reduced to those needed by a lease of tasks `lo..hi`; `None`
    /// if nothing is removed.
    fn only(&self, _lo: u64, _hi: u64) -> Option<Self> {
        None
    }
}

/// The properties of a kind of task for the farm, excluding the code that runs it.
pub trait TaskKind: fmt::Debug + Send + Sync {
    /// Lists everything that the task reads and makes by name, and its version.
    fn io(&self) -> Io<'_>;

    /// Like [`Self::io`], as far as a submission fills it in.
    fn io_mut(&mut self) -> IoMut<'_>;

    /// Returns how the tasks are handed out.
    fn dispatch(&self) -> Dispatch {
        Dispatch::default()
    }

    /// Checks every field against its limits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    fn check(&self) -> Result<(), SpecError>;

    /// Checks that the task fits the tasks of earlier stages.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the field.
    fn check_among(&self, _before: &[&dyn TaskKind]) -> Result<(), SpecError> {
        Ok(())
    }

    /// Checks the values that a client must have filled in before it submits, except for the
    /// version and the scenes.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the field.
    fn check_resolved(&self) -> Result<(), SpecError> {
        Ok(())
    }

    /// Returns warnings about valid settings that are probably mistakes, each with its field. A
    /// plan shows them.
    fn remarks(&self) -> Vec<String> {
        Vec::new()
    }

    /// Returns everything that affects the results except their number. The key of the stage hashes
    /// it.
    fn shaping(&self) -> Value;

    /// Names the bytes of a scene that it makes, where they follow from its settings and the
    /// scene's own file alone: equal keys, equal bytes, whichever other files a job lists. `None`
    /// where a scene is made of another, or is not listed.
    fn scene_key(&self, _scene: u64) -> Option<TaskKey> {
        None
    }

    /// The key of everything that shapes its scenes but the files that they are read from; `None`
    /// where they are none.
    fn files_key(&self) -> Option<StageKey> {
        None
    }

    /// Returns the place of the results.
    fn results(&self) -> Results<'_>;

    /// Returns the most bytes of memory that a task takes on `threads` threads; `None` if that
    /// depends on unknown data.
    fn memory(&self, known: &Known, threads: u32) -> Option<f64>;

    /// Returns the size of the resulting scenes, given the size of the input scenes.
    fn shape(&self, _source: Option<Shape>) -> Option<Shape> {
        None
    }
}

/// Parts of [`TaskKind::io`], [`TaskKind::io_mut`] and [`TaskKind::dispatch`].
impl dyn TaskKind + '_ {
    /// Returns the version of the code that decides the bytes of the results, and the field with
    /// it. A worker's version must be equal.
    pub fn versioned(&self) -> (&'static str, &str) {
        self.io().version
    }

    /// Returns the version to be filled in; `None` if jobs do not contain it.
    pub fn version_mut(&mut self) -> Option<&mut String> {
        self.io_mut().version
    }

    /// Returns the input data set.
    pub fn reads(&self) -> Option<&SourceSettings> {
        self.io().source
    }

    /// Returns the input data set and the number of its scenes, to be filled in.
    pub fn reads_mut(&mut self) -> Option<(&mut SourceSettings, &mut u64)> {
        self.io_mut().source
    }

    /// Returns the scenes that are generated or read as files.
    pub fn scenes(&self) -> Option<&SceneSource> {
        self.io().scenes
    }

    /// The same, for files to be pinned anew.
    pub fn scenes_mut(&mut self) -> Option<&mut SceneSource> {
        self.io_mut().scenes
    }

    /// Returns the paths and URLs that are read in addition to data sets, each with its field: by
    /// one task, or by all.
    pub fn inputs(&self, task: Option<u64>) -> Vec<(String, &str)> {
        self.io().inputs(task)
    }

    /// Returns the store and folder into which something is written for each scene.
    pub fn writes(&self) -> Option<(&String, &String)> {
        self.io().writes()
    }

    /// Returns the store and folder of the data set into which scenes are written.
    pub fn makes(&self) -> Option<(&String, &String)> {
        match self.io().makes {
            Makes::Scenes(to) => Some((&to.store, &to.dataset)),
            _ => None,
        }
    }

    /// Returns the split that the task makes: its data set and its name.
    pub fn divides(&self) -> Option<(&SourceSettings, &String)> {
        match self.io().makes {
            Makes::Split(source, name) => Some((source, name)),
            _ => None,
        }
    }

    /// Returns the model that the task trains: store and name.
    pub fn trains(&self) -> Option<(&String, &String)> {
        match self.io().makes {
            Makes::Model { store, name, .. } => Some((store, name)),
            _ => None,
        }
    }

    /// Returns the settings of the training.
    pub fn training(&self) -> Option<&TrainSettings> {
        match self.io().makes {
            Makes::Model { training, .. } => training,
            _ => None,
        }
    }

    /// Returns the target of the trained model.
    pub fn predicts(&self) -> Option<&'static str> {
        self.training().map(|train| train.target.name())
    }

    /// Returns the network trained on such scenes.
    pub fn network(&self, source: &Shape) -> Option<Network> {
        self.training().map(|train| train.network(source))
    }

    /// Returns the report that the task makes: store and name.
    pub fn reports(&self) -> Option<(&String, &String)> {
        match self.io().makes {
            Makes::Report(store, name) => Some((store, name)),
            _ => None,
        }
    }

    /// Returns the store of the models that the task uses or trains.
    pub fn models_store(&self) -> Option<&String> {
        self.io().models_store()
    }

    /// Returns that store, to be filled in if it may be omitted.
    pub fn models_store_mut(&mut self) -> Option<&mut String> {
        let io = self.io_mut();
        let store = io.stores.into_iter().next().filter(|_| io.models_in_store);
        store.map(|(_, store)| store)
    }

    /// Returns the models that the task reads from the store of [`Self::models_store`]: field and
    /// name.
    pub fn models(&self) -> Vec<(&'static str, &String)> {
        self.io().models
    }

    /// Returns the number of tasks.
    pub fn tasks(&self) -> u64 {
        self.dispatch().tasks
    }

    /// Returns whether stopped tasks keep their progress; see [`Dispatch::resumes`].
    pub fn resumes(&self) -> bool {
        self.dispatch().resumes
    }
}

/// How tasks are handed out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dispatch {
    /// The number of tasks.
    pub tasks: u64,
    /// Whether stopped tasks keep their progress, so that the next worker continues from there.
    /// Such tasks may run for days. None runs twice at a time, and a worker that must end does not
    /// finish them first.
    pub resumes: bool,
    /// The requirement on workers beyond the kind; see
    /// [`TaskSpec::ability`](super::TaskSpec::ability).
    pub variant: Option<&'static str>,
}

impl Default for Dispatch {
    /// Returns one task, which starts anew when it is stopped, for every worker of its kind.
    fn default() -> Self {
        Self {
            tasks: 1,
            resumes: false,
            variant: None,
        }
    }
}

/// The place of a stage's results.
#[derive(Debug, Clone, PartialEq)]
pub struct Results<'a> {
    /// The field that names the store.
    pub field: &'static str,
    /// The store.
    pub store: &'a str,
    /// Distinguishes the results from others in the store: a folder, or a name that no folder can
    /// have.
    pub folder: String,
    /// Where the tasks write, which decides whose that is.
    pub destination: Destination<'a>,
    /// The manifest by which a store shows whether a result exists.
    pub manifest: Manifest<'a>,
}

impl<'a> Results<'a> {
    /// Returns the results of tasks that write something for one scene each into a folder.
    pub(super) fn scenes(output: &'a OutputSettings) -> Self {
        Self {
            field: "output.store",
            store: &output.store,
            folder: output.dataset.clone(),
            destination: Destination::output(output),
            manifest: Manifest::Scene {
                dataset: &output.dataset,
            },
        }
    }
}

/// The manifests of results. A worker reports the SHA-256 of one for each task.
#[derive(Debug, Clone, PartialEq)]
pub enum Manifest<'a> {
    /// There is none.
    None,
    /// The manifest of a scene, or of a scene's predictions.
    Scene {
        /// Folder of the data set.
        dataset: &'a str,
    },
    /// The name of a part of a scene.
    Part {
        /// Folder of the data set.
        dataset: &'a str,
        /// The rendering that joins the parts.
        whole: &'a RenderTask,
        /// How its tasks go over scenes.
        division: Division,
    },
    /// A glTF scene itself.
    Gltf,
    /// The manifest of a model.
    Model {
        /// Name of the model.
        name: &'a str,
    },
    /// The record of a sweep's trial.
    Trial(&'a Trial),
    /// The manifest of a report.
    Report {
        /// Name of the report.
        name: &'a str,
    },
    /// A split itself.
    Split {
        /// Folder of the data set.
        dataset: &'a str,
        /// Name of the split.
        name: &'a str,
    },
}

/// What a network takes from the folder in [`Io::folder`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Taken {
    /// Depths, from which two-bounce times follow.
    Depths,
    /// Evidence.
    Evidence,
    /// Only the store knows.
    Unknown,
}

impl Taken {
    /// Returns what a network of these settings takes.
    pub(super) fn of(settings: &TrainSettings) -> Self {
        match settings.takes_evidence() {
            true => Self::Evidence,
            false => Self::Depths,
        }
    }
}

/// Refuses a folder in [`Io::folder`] if an earlier stage writes it and it lacks what the task
/// takes. Other folders are checked when the stage runs.
///
/// # Errors
/// Returns a [`SpecError`] at the field that names the folder.
pub(super) fn holds(
    task: &dyn TaskKind,
    taken: Taken,
    before: &[&dyn TaskKind],
) -> Result<(), SpecError> {
    let (Some((field, folder)), Some(store)) = (task.io().folder, task.models_store()) else {
        return Ok(());
    };
    let Some(writer) = before
        .iter()
        .find(|task| task.writes() == Some((store, folder)))
    else {
        return Ok(());
    };
    let predicts = |model: &String| {
        let trained = before
            .iter()
            .find(|task| task.trains() == Some((store, model)));
        // Only the store knows the target of an existing model.
        trained.is_none_or(|task| task.predicts() == Some("tof"))
    };
    let (depths, evidence) = match writer.io().makes {
        Makes::Apart {
            depths, evidence, ..
        } => (depths, evidence),
        _ => {
            let models = writer.models();
            (models.into_iter().any(|(_, model)| predicts(model)), false)
        }
    };
    let (there, lacks, remedy) = match taken {
        Taken::Depths => (
            depths,
            "depths",
            "name a demultiplex stage, or an infer stage with a \"tof\" model",
        ),
        Taken::Evidence => (
            evidence,
            "evidence",
            "name a demultiplex stage, and give it demultiplex.evidence = true",
        ),
        Taken::Unknown => (
            depths || evidence,
            "depths and no evidence",
            "name a demultiplex stage, or an infer stage with a \"tof\" model",
        ),
    };
    if there {
        return Ok(());
    }
    let what =
        format!("{folder:?} is written by a stage before this one, and holds no {lacks}; {remedy}");
    Err(SpecError::new(field, what))
}
