//! What a kind of task reads and writes: data sets, folders, scenes, models, splits and reports.
//! One list for each kind serves checks between stages, substitution of names, plans and lineage.

use super::scenes::SceneSource;
use crate::spec::{
    kinds::train::TrainSettings,
    places::{OutputSettings, SourceSettings},
};

/// Everything that a task reads and writes by name.
#[derive(Debug, Clone, Default)]
pub struct Io<'a> {
    /// The version of the code that decides the bytes of the results, and the field with it. A
    /// worker's version must be equal.
    pub version: (&'static str, &'a str),
    /// The input data set.
    pub source: Option<&'a SourceSettings>,
    /// A further input with its field: a folder of the source's store, into which a stage may write
    /// something for each scene.
    pub folder: Option<(&'static str, &'a String)>,
    /// The scenes that are generated or read as files.
    pub scenes: Option<&'a SceneSource>,
    /// Number of tasks for each of these scenes; 0 means one.
    pub tasks_per_scene: u64,
    /// A folder of files from elsewhere, with its field.
    pub files: Option<(&'static str, &'a String)>,
    /// The split of the source that the task uses.
    pub split: Option<&'a String>,
    /// The store of the models; without one, that of the source.
    pub models_store: Option<&'a String>,
    /// The models that the task reads from that store: field and name.
    pub models: Vec<(&'static str, &'a String)>,
    /// What the task makes.
    pub makes: Makes<'a>,
}

/// What a task makes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Makes<'a> {
    /// Nothing that other stages can name.
    #[default]
    Nothing,
    /// The scenes of a data set.
    Scenes(&'a OutputSettings),
    /// Something for each scene of the source, which is no data set: predictions, reconstructions.
    PerScene(&'a OutputSettings),
    /// Like `PerScene`, by physics and not by models.
    Apart {
        /// The destination.
        to: &'a OutputSettings,
        /// Whether depths are among it.
        depths: bool,
        /// Whether evidence is among it.
        evidence: bool,
    },
    /// A split of a data set, and its name.
    Split(&'a SourceSettings, &'a String),
    /// A model.
    Model {
        /// The store.
        store: &'a String,
        /// Name of the model.
        name: &'a String,
        /// The settings of its training; `None` if it is a copy of another model.
        training: Option<&'a TrainSettings>,
    },
    /// Evaluations of the models.
    Evaluations,
    /// A report: store and name.
    Report(&'a String, &'a String),
}

/// The same as [`Io`], as far as a submission fills it in or replaces it.
#[derive(Debug, Default)]
pub struct IoMut<'a> {
    /// The version of the code; `None` if jobs do not contain it.
    pub version: Option<&'a mut String>,
    /// The input data set, and the number of its scenes.
    pub source: Option<(&'a mut SourceSettings, &'a mut u64)>,
    /// [`Io::folder`], to replace the name of a stage by its folder.
    pub folder: Option<(&'static str, &'a mut String)>,
    /// [`Io::scenes`], for files to be pinned anew.
    pub scenes: Option<&'a mut SceneSource>,
    /// The stores named in addition to that of the source, each with its field, to be made
    /// absolute.
    pub stores: Vec<(&'static str, &'a mut String)>,
    /// Whether the first of these stores has the models, and is that of the stage that trains them
    /// if it is left out.
    pub models_in_store: bool,
    /// The models, to replace names of stages by those of their models.
    pub models: ModelNames<'a>,
}

/// Names of models in a task.
#[derive(Debug)]
pub enum ModelNames<'a> {
    /// Fields with one name each.
    Single(Vec<(&'static str, &'a mut String)>),
    /// A field with any number of names.
    List(&'static str, &'a mut Vec<String>),
}

impl Default for ModelNames<'_> {
    fn default() -> Self {
        Self::Single(Vec::new())
    }
}

impl ModelNames<'_> {
    /// Replaces each name.
    pub fn replace_all(self, by: &str) {
        match self {
            Self::Single(names) => names
                .into_iter()
                .for_each(|(_, name)| *name = by.to_owned()),
            Self::List(_, names) => names.fill(by.to_owned()),
        }
    }
}

impl<'a> Io<'a> {
    /// Returns the store of the models that the task uses or trains.
    pub fn models_store(&self) -> Option<&'a String> {
        self.models_store
            .or_else(|| self.source.map(|source| &source.store))
    }

    /// Returns the store and folder into which something is written for each scene.
    pub fn writes(&self) -> Option<(&'a String, &'a String)> {
        match self.makes {
            Makes::Scenes(to) | Makes::PerScene(to) | Makes::Apart { to, .. } => {
                Some((&to.store, &to.dataset))
            }
            _ => None,
        }
    }

    /// Returns the paths and URLs that are read in addition to data sets, each with its field: by
    /// one task, or by all.
    pub fn inputs(&self, task: Option<u64>) -> Vec<(String, &'a str)> {
        let folder = self.files.iter();
        let folder = folder.map(|(field, path)| ((*field).to_owned(), &***path));
        let scene = task.map(|task| task / self.tasks_per_scene.max(1));
        let scenes = self.scenes.map(|scenes| scenes.kind.inputs(scene));
        folder.chain(scenes.into_iter().flatten()).collect()
    }
}

/// Returns each of the names with the field that lists them.
pub(super) fn names<'a>(field: &'static str, all: &'a [String]) -> Vec<(&'static str, &'a String)> {
    all.iter().map(|name| (field, name)).collect()
}
