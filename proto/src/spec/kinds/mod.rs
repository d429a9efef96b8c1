//! The kinds of tasks. Each is declared by one file in this folder, which defines its form in a job
//! file ([`Declared`]) and its properties for the farm ([`TaskKind`]). The table below lists them.
//! The code that runs a kind's tasks is one file in `worker/tasks/src/kinds`, with a line in the
//! table of `worker/tasks/src/executor.rs`. Other code knows related kinds only: the parts that
//! [`super::file`] puts before a render stage, the trials of [`super::sweep`], recipes and repairs
//! of rendered, reprocessed or imported scenes, and the verdicts that `job watch` prints.

mod calibrate;
pub mod demultiplex;
mod division;
pub mod evaluate;
pub mod export;
mod fields;
pub mod generate;
pub mod import;
pub mod infer;
pub(super) mod io;
mod kind;
pub(super) mod names;
mod part;
mod promote;
pub mod python;
pub mod reconstruct;
pub mod render;
pub mod report;
pub mod reprocess;
mod scene_files;
pub mod scenes;
mod split;
pub mod train;
mod verify;

use std::{borrow::Cow, ops};

use serde::Serialize;

use super::spec_error::SpecError;
use crate::show;

pub use calibrate::{CalibrateSettings, CalibrateTask};
pub use demultiplex::{DemultiplexSettings, DemultiplexTask};
pub use division::Division;
pub use evaluate::{EvaluateShardTask, EvaluateTask};
pub use export::{ExportSettings, ExportTask};
pub use fields::Fields;
pub use generate::GenerateTask;
pub use import::ImportTask;
pub use infer::InferTask;
pub use io::{Io, IoMut, Makes, ModelNames};
pub use kind::{Declared, Dispatch, Manifest, Results, TaskKind};
pub use part::PartTask;
pub use promote::{PromoteSettings, PromoteTask};
pub use python::{CodeFile, Goal, PythonSettings, PythonTask};
pub use reconstruct::{ReconstructSettings, ReconstructTask};
pub use render::RenderTask;
pub use report::ReportTask;
pub use reprocess::ReprocessTask;
pub use split::SplitTask;
pub use train::TrainTask;
pub use verify::{VerifySettings, VerifyTask};

/// Defines [`TaskSpec`] and all code that covers every kind.
macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident($task:ident),)*) => {
        /// The work of a stage's tasks. It dereferences to its [`TaskKind`].
        #[derive(Debug, Clone, PartialEq, Serialize)]
        #[serde(tag = "kind", rename_all = "snake_case")]
        pub enum TaskSpec {
            $($(#[$doc])* $kind($task),)*
        }

        impl ops::Deref for TaskSpec {
            type Target = dyn TaskKind;

            fn deref(&self) -> &Self::Target {
                match self {
                    $(Self::$kind(task) => task,)*
                }
            }
        }

        impl ops::DerefMut for TaskSpec {
            fn deref_mut(&mut self) -> &mut Self::Target {
                match self {
                    $(Self::$kind(task) => task,)*
                }
            }
        }

        $(impl From<$task> for TaskSpec {
            fn from(task: $task) -> Self {
                Self::$kind(task)
            }
        })*

        impl TaskSpec {
            /// Returns the kind's name in a job file.
            pub fn kind(&self) -> &'static str {
                match self {
                    $(Self::$kind(_) => $task::NAME,)*
                }
            }

            /// Returns the task with its lists reduced to those needed by a lease of tasks
            /// `lo..hi`; `None` if nothing is removed.
            pub fn only(&self, lo: u64, hi: u64) -> Option<Self> {
                match self {
                    $(Self::$kind(task) => Declared::only(task, lo, hi).map(Self::$kind),)*
                }
            }
        }

        const TABLE: &[Row] = &[$(Row {
            name: $task::NAME,
            fields: $task::FIELDS,
            written: $task::WRITTEN,
            read: |fields| $task::read(fields).map(TaskSpec::$kind),
        },)*];
    };
}

kinds! {
    /// Renders scenes: one task each.
    Render(RenderTask),
    /// Applies a sensor to the scenes of a data set and writes another: one task each.
    Reprocess(ReprocessTask),
    /// Divides the scenes of a data set into training, validation and test sets: one task.
    Split(SplitTask),
    /// Packs a data set for sharing: one task.
    Export(ExportTask),
    /// Converts scenes of other formats into a data set: one task each.
    Import(ImportTask),
    /// Generates scenes and writes them as files: one task each.
    Generate(GenerateTask),
    /// Trains a network on a data set: one task.
    Train(TrainTask),
    /// Evaluates models on unseen scenes: one task.
    Evaluate(EvaluateTask),
    /// Gives the best of several models a name: one task.
    Promote(PromoteTask),
    /// Predicts scenes with models: one task each.
    Infer(InferTask),
    /// Reports the results of models as a page: one task.
    Report(ReportTask),
    /// Reconstructs scenes as rooms in 3D: one task each.
    Reconstruct(ReconstructTask),
    /// Reads scenes of a data set and compares them with their manifests: one task each.
    Verify(VerifyTask),
    /// Renders parts of heavy scenes, which a render stage joins: one task a part.
    Part(PartTask),
    /// Evaluates models on shards of the scenes, which an evaluation joins: one task a shard.
    EvaluateShard(EvaluateShardTask),
    /// Predicts scenes by physics from the histogram of all spots: one task each.
    Demultiplex(DemultiplexTask),
    /// Checks and corrects the calibration of a measured scene: one task.
    Calibrate(CalibrateTask),
    /// Runs a Python file: one task.
    Python(PythonTask),
}

/// A kind, for reading job files.
struct Row {
    name: &'static str,
    fields: &'static [&'static str],
    written: bool,
    read: fn(&mut Fields) -> Result<TaskSpec, SpecError>,
}

impl TaskSpec {
    /// Returns the version of the code that decides the bytes of the results. A worker's version
    /// must be equal.
    pub fn version(&self) -> &str {
        self.versioned().1
    }

    /// Returns the ability that a worker must announce to get the tasks. It is the kind, followed
    /// by a colon and the requirement if not every program that runs the kind can run these tasks.
    pub fn ability(&self) -> Cow<'static, str> {
        match self.dispatch().variant {
            None => self.kind().into(),
            Some(variant) => format!("{}:{variant}", self.kind()).into(),
        }
    }

    /// Reads a task of the kind that the fields name. The common fields of stages were removed
    /// before.
    ///
    /// # Errors
    /// Returns an error for an unknown kind, or for a missing, foreign or invalid field.
    pub(super) fn read(mut fields: Fields) -> Result<Self, SpecError> {
        let kind = fields.kind().to_owned();
        let Some(row) = TABLE.iter().find(|row| row.name == kind) else {
            let written = TABLE.iter().filter(|row| row.written).map(|row| row.name);
            let known: Vec<&str> = written.collect();
            return Err(SpecError::new("kind", show::unknown(&kind, &known)));
        };
        fields.only(row.fields, |field| {
            let owners = TABLE
                .iter()
                .filter(|row| row.written && row.fields.contains(&field));
            owners.map(|row| row.name).collect()
        })?;
        (row.read)(&mut fields)
    }
}
