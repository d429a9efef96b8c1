//! What the tasks of a stage do: a kind of task is a variant here, and what it needs to know.

use serde::{Deserialize, Serialize};

use super::{
    evaluate::EvaluateTask,
    generate::GenerateTask,
    import::ImportTask,
    infer::InferTask,
    render::{PartTask, RenderTask},
    report::ReportTask,
    reprocess::{ReprocessTask, SourceSettings},
    sweep::PromoteTask,
    train::TrainTask,
};
use crate::split::SplitSettings;

/// What the tasks of a stage do. A further kind is a variant here, a file under the agent's `execute`, and a line in each
/// `match` that the compiler then asks for.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum TaskSpec {
    /// Scenes are rendered: one task each.
    Render(RenderTask),
    /// Scenes are made and written as files: one task each.
    Generate(GenerateTask),
    /// Scenes of other people's data are converted into a data set: one task each.
    Import(ImportTask),
    /// Parts of heavy scenes are rendered, for a render stage to join: one task a part.
    Part(PartTask),
    /// Scenes of a data set go through a sensor into another: one task each.
    Reprocess(ReprocessTask),
    /// The scenes of a data set are divided into training, validation and test: one task.
    Split(SplitTask),
    /// A data set is packed for sharing: one task.
    Export(ExportTask),
    /// A network learns from a data set: one task.
    Train(TrainTask),
    /// Models meet scenes that they have not seen: one task.
    Evaluate(EvaluateTask),
    /// The best of several models gets a name: one task.
    Promote(PromoteTask),
    /// Models say what they see in scenes: one task each.
    Infer(InferTask),
    /// What models came to, as a page: one task.
    Report(ReportTask),
}

/// Dividing a data set.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SplitTask {
    /// The data set.
    pub source: SourceSettings,
    /// Its number of scenes.
    pub count: u64,
    /// How.
    pub split: SplitSettings,
}

/// Packing a data set.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ExportTask {
    /// The data set.
    pub source: SourceSettings,
    /// Its number of scenes.
    pub count: u64,
    /// What is packed, and where it goes.
    pub export: ExportSettings,
}

/// What is packed, and where it goes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExportSettings {
    /// A path or URL that every worker can reach.
    pub dest: String,
    /// `a..b`, `split:SIDE` or `split:NAME:SIDE`; empty = every scene.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub scenes: String,
    /// `zarr` (default), `sb3d`, `webdataset` or `hdf5`.
    #[serde(default = "zarr")]
    pub format: String,
}

impl TaskSpec {
    /// The kind's name, as in a job file.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Render(_) => "render",
            Self::Part(_) => "part",
            Self::Generate(_) => "generate",
            Self::Import(_) => "import",
            Self::Reprocess(_) => "reprocess",
            Self::Split(_) => "split",
            Self::Export(_) => "export",
            Self::Train(_) => "train",
            Self::Evaluate(_) => "evaluate",
            Self::Promote(_) => "promote",
            Self::Infer(_) => "infer",
            Self::Report(_) => "report",
        }
    }

    /// Version of the code that decides the bytes of its results; a worker's must equal it.
    pub fn version(&self) -> &str {
        match self {
            Self::Render(task) => &task.render.renderer,
            Self::Part(task) => &task.whole.render.renderer,
            Self::Generate(task) => &task.generate.version,
            Self::Import(task) => &task.import.version,
            Self::Reprocess(task) => &task.reprocess.version,
            Self::Split(_) => SPLIT_VERSION,
            Self::Export(_) => EXPORT_VERSION,
            Self::Train(task) => &task.train.version,
            Self::Evaluate(task) => &task.evaluate.version,
            Self::Promote(task) => &task.promote.version,
            Self::Infer(task) => &task.infer.version,
            Self::Report(task) => &task.report.version,
        }
    }

    /// The data set that is read.
    pub fn reads(&self) -> Option<&SourceSettings> {
        match self {
            Self::Render(_)
            | Self::Part(_)
            | Self::Generate(_)
            | Self::Import(_)
            | Self::Report(_) => None,
            Self::Reprocess(task) => Some(&task.source),
            Self::Split(task) => Some(&task.source),
            Self::Export(task) => Some(&task.source),
            Self::Train(task) => Some(&task.source),
            Self::Evaluate(task) => Some(&task.source),
            Self::Promote(task) => Some(&task.source),
            Self::Infer(task) => Some(&task.source),
        }
    }

    /// Where something of each scene is put: store and folder, of a data set or of predictions.
    pub fn writes(&self) -> Option<(&String, &String)> {
        match self {
            Self::Render(task) => Some((&task.output.store, &task.output.dataset)),
            Self::Reprocess(task) => Some((&task.output.store, &task.output.dataset)),
            Self::Import(task) => Some((&task.output.store, &task.output.dataset)),
            Self::Infer(task) => Some((&task.output.store, &task.output.dataset)),
            Self::Part(_)
            | Self::Generate(_)
            | Self::Split(_)
            | Self::Export(_)
            | Self::Train(_)
            | Self::Evaluate(_)
            | Self::Promote(_)
            | Self::Report(_) => None,
        }
    }

    /// The data set that scenes are put into: store and folder.
    pub fn makes(&self) -> Option<(&String, &String)> {
        match self {
            Self::Infer(_) => None,
            other => other.writes(),
        }
    }

    /// The model that is made: store and name.
    pub fn trains(&self) -> Option<(&String, &String)> {
        match self {
            Self::Train(task) => Some((&task.source.store, &task.train.model)),
            Self::Promote(task) => Some((&task.source.store, &task.promote.model)),
            _ => None,
        }
    }

    /// The report that is made: store and name.
    pub fn reports(&self) -> Option<(&String, &String)> {
        match self {
            Self::Report(task) => Some((&task.report.store, &task.report.name)),
            _ => None,
        }
    }

    /// The store that keeps the models which are read or trained.
    pub fn shelf(&self) -> Option<&String> {
        match self {
            Self::Report(task) => Some(&task.report.store),
            other => other.reads().map(|source| &source.store),
        }
    }

    /// The models that are read, from the store of [`Self::shelf`]: field and name.
    pub fn models(&self) -> Vec<(&'static str, &String)> {
        match self {
            Self::Train(task) => task.train.models(),
            Self::Evaluate(task) => {
                let models = task.evaluate.models.iter();
                models.map(|m| ("evaluate.models", m)).collect()
            }
            Self::Promote(task) => {
                let models = task.promote.among.iter();
                models.map(|m| ("promote.among", m)).collect()
            }
            Self::Infer(task) => {
                let models = task.infer.models.iter();
                models.map(|m| ("infer.models", m)).collect()
            }
            Self::Report(task) => {
                let models = task.report.models.iter();
                models.map(|m| ("report.models", m)).collect()
            }
            _ => Vec::new(),
        }
    }

    /// The split of the data set of [`Self::reads`] that is read.
    pub fn split(&self) -> Option<&String> {
        match self {
            Self::Train(task) => Some(&task.train.split),
            Self::Evaluate(task) => Some(&task.evaluate.split),
            _ => None,
        }
    }

    /// Whether its tasks, when they are stopped, keep what they have done, and whoever runs them next goes on from there.
    /// They may run for days: none is run twice at a time, and a worker that shall end does not finish them first.
    pub fn resumes(&self) -> bool {
        matches!(self, Self::Train(_))
    }

    /// The rendering, where it is one or a part of one.
    pub fn as_render(&self) -> Option<&RenderTask> {
        match self {
            Self::Render(task) => Some(task),
            Self::Part(task) => Some(&task.whole),
            _ => None,
        }
    }

    /// The data set that is read, and the number of its scenes; to be filled in.
    pub fn reads_mut(&mut self) -> Option<(&mut SourceSettings, &mut u64)> {
        match self {
            Self::Render(_)
            | Self::Part(_)
            | Self::Generate(_)
            | Self::Import(_)
            | Self::Report(_) => None,
            Self::Reprocess(task) => Some((&mut task.source, &mut task.count)),
            Self::Split(task) => Some((&mut task.source, &mut task.count)),
            Self::Export(task) => Some((&mut task.source, &mut task.count)),
            Self::Train(task) => Some((&mut task.source, &mut task.count)),
            Self::Evaluate(task) => Some((&mut task.source, &mut task.count)),
            Self::Promote(task) => Some((&mut task.source, &mut task.count)),
            Self::Infer(task) => Some((&mut task.source, &mut task.count)),
        }
    }
}

fn zarr() -> String {
    "zarr".into()
}

/// Version of the split task.
pub const SPLIT_VERSION: &str = "split-1";
/// Version of the export task.
pub const EXPORT_VERSION: &str = "export-2";
