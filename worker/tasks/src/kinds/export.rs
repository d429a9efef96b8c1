//! Packs a data set, or part of it, for sharing.

use std::ops::Range;

use picofarm_dataset::Dataset;
use picofarm_exchange::{ExportFormat, Exporter};
use picofarm_proto::{
    spec::{ExportTask, SpecError, TaskSpec},
    split::{SIDES, SplitRecord},
};
use picofarm_store::StorageError;
use tracing::info;

use crate::{
    errors::dataset_error,
    submission::Submission,
    task::{Context, Control, Output, RunTask, Task, TaskError},
};

/// Selects scenes of a data set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Scenes {
    /// All published scenes.
    All,
    /// The published scenes in an interval.
    Range(Range<u64>),
    /// The published scenes on a side of a split.
    Split {
        /// Name of the split.
        name: String,
        /// Name of the side.
        side: String,
    },
}

impl Scenes {
    /// Parses an empty string, `a..b`, `split:SIDE` or `split:NAME:SIDE`.
    ///
    /// # Errors
    /// Fails if the text has none of these forms.
    pub fn parse(text: &str) -> Result<Self, String> {
        let expected =
            || "expected A..B, split:train, split:validation, split:test or split:NAME:SIDE";
        if text.is_empty() {
            return Ok(Self::All);
        }
        if let Some(split) = text.strip_prefix("split:") {
            let (name, side) = split.split_once(':').unwrap_or(("default", split));
            if !SIDES.contains(&side) {
                return Err(expected().into());
            }
            return Ok(Self::Split {
                name: name.into(),
                side: side.into(),
            });
        }
        let (low, high) = text.split_once("..").ok_or_else(expected)?;
        let number = |text: &str| {
            let number = text.trim().parse::<u64>();
            number.map_err(|_| expected().to_owned())
        };
        let range = number(low)?..number(high)?;
        match range.is_empty() {
            true => Err(expected().into()),
            false => Ok(Self::Range(range)),
        }
    }

    /// Returns the selected published scenes, in ascending order.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if there is no such split; other errors if the store cannot be
    /// read.
    pub async fn select(&self, dataset: &Dataset) -> Result<Vec<u64>, StorageError> {
        let mut scenes = dataset.scenes_present().await?;
        match self {
            Self::All => {}
            Self::Range(range) => scenes.retain(|s| range.contains(s)),
            Self::Split { name, side } => {
                let side = of_split(dataset, name, side).await?;
                scenes.retain(|s| side.binary_search(s).is_ok());
            }
        }
        Ok(scenes)
    }
}

/// Returns the scenes on a side of the newest version of a split, in ascending order.
async fn of_split(dataset: &Dataset, name: &str, side: &str) -> Result<Vec<u64>, StorageError> {
    let versions = dataset.split_versions(name).await?;
    let Some(version) = versions.last() else {
        return Err(StorageError::Invalid {
            field: "scenes".into(),
            what: format!(
                "{} has no split {name:?}; make it with a split task or `picofarm dataset split`",
                dataset.prefix()
            ),
        });
    };
    let bytes = dataset.read_split(name, *version).await?;
    let record = SplitRecord::parse(&bytes).map_err(|what| StorageError::Damaged {
        object: dataset.split_place(name, *version),
        what,
    })?;
    Ok(record.scenes(side))
}

impl RunTask for ExportTask {
    fn code_version() -> String {
        Self::VERSION.to_owned()
    }

    /// Packs the scenes that the job names. Existing files are kept.
    fn run(&self, context: &Context, _task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, spec) = (&context.stores, self);
        let field = |e: TaskError, field: &str| match e {
            TaskError::User(text) => TaskError::User(format!("{field}: {text}")),
            other => other,
        };
        let which = Scenes::parse(&spec.export.scenes)
            .map_err(|what| TaskError::User(format!("export.scenes: {what}")))?;
        let place = &spec.source;
        let source = stores
            .open_source(&place.store, &place.dataset, control)
            .map_err(|e| field(e, "source"))?;
        stores.fits(TaskSpec::Export(spec.clone()), Some(source.spec()))?;
        let scenes = stores
            .wait(control, which.select(&source))
            .map_err(|e| field(e, "export.scenes"))?;
        let (store, prefix) = stores
            .source(&spec.export.dest, control)
            .map_err(|e| field(e, "export.dest"))?;
        let format = ExportFormat::parse(&spec.export.format)
            .map_err(|what| TaskError::User(format!("export.format: {what}")))?;
        let mut export =
            Exporter::new(format, &source, &scenes, &*store, prefix).map_err(dataset_error)?;
        let steps = export.steps();
        for k in 0..steps {
            stores.wait(control, export.step(k))?;
            info!("step {} of {steps} written", k + 1);
            if !control.at((k + 1) as f32 / (steps + 1) as f32) {
                return Err(TaskError::Stopped);
            }
        }
        let done = stores.wait(control, export.finish())?;
        control.at(1.0);
        Ok(Output {
            manifest_sha256: hex::encode(done.sha256),
            bytes: done.bytes,
            adopted: false,
        })
    }

    fn resolve(&mut self, _here: &Submission<'_>) -> Result<(), SpecError> {
        ExportFormat::parse(&self.export.format).map_err(|e| SpecError::new("export.format", e))?;
        Scenes::parse(&self.export.scenes).map_err(|e| SpecError::new("export.scenes", e))?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_are_chosen_by_range_or_by_split() {
        assert_eq!(Scenes::parse(""), Ok(Scenes::All));
        assert_eq!(Scenes::parse("3..7"), Ok(Scenes::Range(3..7)));
        let split = |name: &str, side: &str| Scenes::Split {
            name: name.into(),
            side: side.into(),
        };
        assert_eq!(Scenes::parse("split:train"), Ok(split("default", "train")));
        let half = Scenes::parse("split:half:test");
        assert_eq!(half, Ok(split("half", "test")));
        for bad in ["3", "7..3", "split:", "split:training", "a..b"] {
            assert!(
                Scenes::parse(bad).unwrap_err().starts_with("expected"),
                "{bad}"
            );
        }
    }
}
