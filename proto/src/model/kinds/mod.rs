//! The kinds of tasks. Each is declared by one file here, which says how a job file writes it ([`Declared`]) and what the
//! farm must know of it ([`TaskKind`]); the table below lists them. How its tasks run is one file too, under the agent's
//! `execute`, with a line in the table there. Nothing else knows kinds by name, but where kinds belong to each other: the
//! parts that [`super::file`] puts before a rendering, the trials of [`super::sweep`], and recipes and repairs in the agent,
//! which are of scenes that are rendered, measured again or imported.

mod division;
pub mod evaluate;
pub mod export;
mod fields;
pub mod generate;
pub mod import;
pub mod infer;
mod kind;
pub(super) mod names;
mod part;
mod promote;
pub mod reconstruct;
pub mod render;
pub mod report;
pub mod reprocess;
pub mod scenes;
mod split;
pub mod train;
mod verify;

use std::{borrow::Cow, ops};

use serde::Serialize;

use super::spec_error::SpecError;
use crate::show;

pub use division::Division;
pub use evaluate::{EvaluateShardTask, EvaluateTask};
pub use export::{ExportSettings, ExportTask};
pub use fields::Fields;
pub use generate::GenerateTask;
pub use import::ImportTask;
pub use infer::InferTask;
pub use kind::{Declared, Manifest, ModelNames, Results, TaskKind};
pub use part::PartTask;
pub use promote::{PromoteSettings, PromoteTask};
pub use reconstruct::{ReconstructSettings, ReconstructTask};
pub use render::RenderTask;
pub use report::ReportTask;
pub use reprocess::ReprocessTask;
pub use split::SplitTask;
pub use train::TrainTask;
pub use verify::{VerifySettings, VerifyTask};

/// Makes [`TaskSpec`] and all that goes over every kind.
macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident($task:ident),)*) => {
        /// What the tasks of a stage do. It answers as its [`TaskKind`].
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
            /// The kind's name, as in a job file.
            pub fn kind(&self) -> &'static str {
                match self {
                    $(Self::$kind(_) => $task::NAME,)*
                }
            }

            /// The same with as much of its lists as a lease of tasks `lo..hi` needs; `None` = all of it.
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
    /// Scenes are rendered: one task each.
    Render(RenderTask),
    /// Scenes of a data set go through a sensor into another: one task each.
    Reprocess(ReprocessTask),
    /// The scenes of a data set are divided into training, validation and test: one task.
    Split(SplitTask),
    /// A data set is packed for sharing: one task.
    Export(ExportTask),
    /// Scenes of other people's data are converted into a data set: one task each.
    Import(ImportTask),
    /// Scenes are made and written as files: one task each.
    Generate(GenerateTask),
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
    /// Scenes become rooms in 3D: one task each.
    Reconstruct(ReconstructTask),
    /// Scenes of a data set are read and compared with their manifests: one task each.
    Verify(VerifyTask),
    /// Parts of heavy scenes are rendered, for a render stage to join: one task a part.
    Part(PartTask),
    /// Models meet shards of the scenes, for an evaluation to join: one task a shard.
    EvaluateShard(EvaluateShardTask),
}

/// A kind, as job files are read.
struct Row {
    name: &'static str,
    fields: &'static [&'static str],
    written: bool,
    read: fn(&mut Fields) -> Result<TaskSpec, SpecError>,
}

impl TaskSpec {
    /// Version of the code that decides the bytes of its results; a worker's must equal it.
    pub fn version(&self) -> &str {
        self.versioned().1
    }

    /// What a worker must announce to be given its tasks: the kind, and where not every program that runs the kind can run
    /// these, a colon and what is needed.
    pub fn ability(&self) -> Cow<'static, str> {
        match self.variant() {
            None => self.kind().into(),
            Some(variant) => format!("{}:{variant}", self.kind()).into(),
        }
    }

    /// Reads a task of the kind that the fields name; those that every stage has were taken out of them.
    ///
    /// # Errors
    /// A kind that is unknown; a field that is missing, of another kind, or cannot be read.
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
