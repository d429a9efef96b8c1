//! What a kind of task is: how job files write it, what the farm must know of it, and where its results lie.

use std::fmt;

use serde_json::Value;

use super::{division::Division, fields::Fields, render::RenderTask, scenes::SceneSource};
use crate::{
    key::hash::{StageKey, TaskKey},
    model::{
        destination::Destination,
        memory::{Known, Network, Shape},
        places::{OutputSettings, SourceSettings},
        spec_error::SpecError,
        trial::Trial,
    },
};

/// How a kind is written in a job file, and in leases.
pub trait Declared: TaskKind + Sized {
    /// Its name.
    const NAME: &'static str;
    /// The fields of its stages, beside those that every stage has.
    const FIELDS: &'static [&'static str];
    /// Job files may name it; otherwise only this program makes stages of it.
    const WRITTEN: bool = true;

    /// Reads its fields.
    ///
    /// # Errors
    /// A field that is missing or cannot be read.
    fn read(fields: &mut Fields) -> Result<Self, SpecError>;

    /// The same with as much of its lists as a lease of tasks `lo..hi` needs; `None` = all of it.
    fn only(&self, _lo: u64, _hi: u64) -> Option<Self> {
        None
    }
}

/// What the farm must know of a kind of task, but for how it runs.
pub trait TaskKind: fmt::Debug + Send + Sync {
    /// Version of the code that decides the bytes of its results, which a worker's must equal, and the field that holds it.
    fn versioned(&self) -> (&'static str, &str);

    /// The same version, to be filled in; `None` where it is not written in jobs.
    fn version_mut(&mut self) -> Option<&mut String> {
        None
    }

    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    fn check(&self) -> Result<(), SpecError>;

    /// Checks that it fits the tasks of the stages before its own.
    ///
    /// # Errors
    /// [`SpecError`] naming the field.
    fn check_among(&self, _before: &[&dyn TaskKind]) -> Result<(), SpecError> {
        Ok(())
    }

    /// Checks what a client must have filled in before it submits, beside the version and what its scenes need.
    ///
    /// # Errors
    /// [`SpecError`] naming the field.
    fn check_resolved(&self) -> Result<(), SpecError> {
        Ok(())
    }

    /// Settings that can be used but are probably not meant, in words that name the field. They are warnings of a plan.
    fn remarks(&self) -> Vec<String> {
        Vec::new()
    }

    /// Everything that shapes its results but their number: what the key of its stage hashes.
    fn shaping(&self) -> Value;

    /// Names the bytes of a scene that it makes, where they follow from its settings and the scene's own file alone: equal
    /// keys, equal bytes, whichever other files a job lists. `None` where a scene is made of another, or is not listed.
    fn scene_key(&self, _scene: u64) -> Option<TaskKey> {
        None
    }

    /// The key of everything that shapes its scenes but the files that they are read from; `None` where they are none.
    fn files_key(&self) -> Option<StageKey> {
        None
    }

    /// Where its tasks write, which decides whose that is. Without a default, so that no kind leaves it out.
    fn destination(&self) -> Destination<'_>;

    /// Where its results lie.
    fn results(&self) -> Results<'_>;

    /// Bytes of memory that a task takes at most on so many threads; `None` where that depends on data of which nothing is
    /// known.
    fn memory(&self, known: &Known, threads: u32) -> Option<f64>;

    /// Number of tasks.
    fn tasks(&self) -> u64 {
        1
    }

    /// Whether its tasks, when they are stopped, keep what they have done, and whoever runs them next goes on from there.
    /// They may run for days: none is run twice at a time, and a worker that shall end does not finish them first.
    fn resumes(&self) -> bool {
        false
    }

    /// What its tasks need of a worker beyond the kind: see [`TaskSpec::ability`](super::TaskSpec::ability).
    fn variant(&self) -> Option<&'static str> {
        None
    }

    /// The data set that is read.
    fn reads(&self) -> Option<&SourceSettings> {
        None
    }

    /// The data set that is read, and the number of its scenes; to be filled in.
    fn reads_mut(&mut self) -> Option<(&mut SourceSettings, &mut u64)> {
        None
    }

    /// What is read beside it: a folder of the same store, into which a stage may put something of each scene; and the field
    /// that names it.
    fn reads_beside(&self) -> Option<(&'static str, &String)> {
        None
    }

    /// The same, for the name of a stage to be replaced by its folder.
    fn reads_beside_mut(&mut self) -> Option<(&'static str, &mut String)> {
        None
    }

    /// Where scenes come from that are made or read as files.
    fn scenes(&self) -> Option<&SceneSource> {
        None
    }

    /// The same, for files to be pinned anew.
    fn scenes_mut(&mut self) -> Option<&mut SceneSource> {
        None
    }

    /// The paths and URLs that are read beside data sets, each with its field: by one task, or by all.
    fn inputs(&self, _task: Option<u64>) -> Vec<(String, &str)> {
        Vec::new()
    }

    /// The stores that are named beside that of the data set which is read, each with its field; to be made absolute.
    fn stores_mut(&mut self) -> Vec<(&'static str, &mut String)> {
        Vec::new()
    }

    /// Where something of each scene is put, of a data set or of predictions: store and folder.
    fn writes(&self) -> Option<(&String, &String)> {
        None
    }

    /// The data set that scenes are put into: store and folder.
    fn makes(&self) -> Option<(&String, &String)> {
        self.writes()
    }

    /// The size of the scenes that it makes, of such scenes as it reads.
    fn shape(&self, _source: Option<Shape>) -> Option<Shape> {
        None
    }

    /// The split that is made: of which data set, and its name.
    fn divides(&self) -> Option<(&SourceSettings, &String)> {
        None
    }

    /// The split of the data set of [`Self::reads`] that is read.
    fn split(&self) -> Option<&String> {
        None
    }

    /// The model that is made: store and name.
    fn trains(&self) -> Option<(&String, &String)> {
        None
    }

    /// What the model predicts that is trained.
    fn predicts(&self) -> Option<&'static str> {
        None
    }

    /// The network that is trained on such scenes.
    fn network(&self, _source: &Shape) -> Option<Network> {
        None
    }

    /// The models that are evaluated.
    fn evaluates(&self) -> &[String] {
        &[]
    }

    /// The report that is made: store and name.
    fn reports(&self) -> Option<(&String, &String)> {
        None
    }

    /// The store that keeps the models which are read or trained.
    fn models_store(&self) -> Option<&String> {
        self.reads().map(|source| &source.store)
    }

    /// The same where it may be left out, to be filled in.
    fn models_store_mut(&mut self) -> Option<&mut String> {
        None
    }

    /// The models that are read, from the store of [`Self::models_store`]: field and name.
    fn models(&self) -> Vec<(&'static str, &String)> {
        Vec::new()
    }

    /// The same, for names of stages to be replaced by those of their models.
    fn models_mut(&mut self) -> ModelNames<'_> {
        ModelNames::Single(Vec::new())
    }
}

/// Names of models in a task.
#[derive(Debug)]
pub enum ModelNames<'a> {
    /// Fields that hold one each.
    Single(Vec<(&'static str, &'a mut String)>),
    /// A field that holds any number.
    List(&'static str, &'a mut Vec<String>),
}

/// Where the results of a stage lie.
#[derive(Debug, Clone, PartialEq)]
pub struct Results<'a> {
    /// The field that names the store.
    pub field: &'static str,
    /// The store.
    pub store: &'a str,
    /// What tells them from other results in the store: a folder, or a name that no folder can have.
    pub folder: String,
    /// What a store is asked to learn whether a result is there.
    pub manifest: Manifest<'a>,
}

impl<'a> Results<'a> {
    /// Those of tasks that put something of a scene each into a folder.
    pub(super) fn scenes(output: &'a OutputSettings) -> Self {
        Self {
            field: "output.store",
            store: &output.store,
            folder: output.dataset.clone(),
            manifest: Manifest::Scene {
                dataset: &output.dataset,
            },
        }
    }
}

/// The manifests of results: a worker reports the SHA-256 of one for each task.
#[derive(Debug, Clone, PartialEq)]
pub enum Manifest<'a> {
    /// There is none.
    None,
    /// That of a scene, or of a scene's predictions.
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
    /// A model's.
    Model {
        /// Its name.
        name: &'a str,
    },
    /// The record of a sweep's trial.
    Trial(&'a Trial),
    /// A report's.
    Report {
        /// Its name.
        name: &'a str,
    },
    /// A split itself.
    Split {
        /// Folder of the data set.
        dataset: &'a str,
        /// Its name.
        name: &'a str,
    },
}

/// Refuses a folder that [`TaskKind::reads_beside`] names where a stage before writes it and predicts no depth. Folders of
/// which no stage is known are looked at when the stage runs.
///
/// # Errors
/// [`SpecError`] at the field that names it.
pub(super) fn predicts_depth(
    task: &dyn TaskKind,
    before: &[&dyn TaskKind],
) -> Result<(), SpecError> {
    let (Some((field, folder)), Some(store)) = (task.reads_beside(), task.models_store()) else {
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
        // Of a model that exists, only the store knows what it predicts.
        trained.is_none_or(|task| task.predicts() == Some("tof"))
    };
    if writer
        .models()
        .into_iter()
        .any(|(_, model)| predicts(model))
    {
        return Ok(());
    }
    let what = format!(
        "{folder:?} is written by a stage before this one, and holds no depths; name an infer stage with a \"tof\" model"
    );
    Err(SpecError::new(field, what))
}
