//! Splitting: one task that records which scenes of a data set are for training, validation and test.
//!
//! Versions are create-only. Whoever runs the task again finds the newest version and keeps it, or extends it where
//! scenes were added since.

use std::{collections::BTreeSet, time::Duration};

use picofarm_dataset::Dataset;
use picofarm_proto::{
    model::{SourceSettings, SplitTask},
    split::{SplitRecord, SplitSettings},
};
use sha2::{Digest, Sha256};
use tokio::runtime::Handle;

use crate::execute::{Context, Control, Output, RunTask, Task, TaskError, output::Stores};

/// Attempts to be the one who writes the next version.
const ATTEMPTS: usize = 16;

/// A split of a data set.
#[derive(Debug, Clone, PartialEq)]
pub struct Split {
    /// The newest version.
    pub record: SplitRecord,
    /// Where it lies.
    pub place: String,
    /// SHA-256 of its bytes, hexadecimal.
    pub sha256: String,
    /// Its bytes.
    pub bytes: u64,
    /// It was there already and nothing was written.
    pub adopted: bool,
    /// Scenes of it that are not published (any more).
    pub missing: u64,
}

/// Splits data sets.
pub struct Splitter {
    stores: Stores,
}

impl Splitter {
    /// Stores are reached through `runtime`, which must not be a thread that calls this.
    pub fn new(runtime: Handle) -> Self {
        Self {
            stores: Stores::new(runtime, Duration::ZERO),
        }
    }

    /// Makes the split, extends it, or finds it as it is.
    ///
    /// # Errors
    /// [`TaskError::User`] for unusable settings, and for a split of this name with other settings.
    pub fn run(
        &self,
        settings: &SplitSettings,
        store: &str,
        dataset: &str,
        control: &Control,
    ) -> Result<Split, TaskError> {
        run(&self.stores, settings, store, dataset, control)
    }

    /// The newest version of a split.
    ///
    /// # Errors
    /// [`TaskError::User`] where there is none.
    pub fn show(
        &self,
        name: &str,
        store: &str,
        dataset: &str,
        control: &Control,
    ) -> Result<Split, TaskError> {
        let dataset = self.stores.open_source(store, dataset, control)?;
        let present = present(&self.stores, &dataset, control)?;
        let found = newest(&self.stores, &dataset, name, control)?;
        found
            .map(|record| found_as(record, &dataset, &present, true))
            .ok_or_else(|| {
                TaskError::User(format!(
                    "split.name: {} has no split {name:?}; make it with --counts or --fractions",
                    dataset.prefix()
                ))
            })
    }
}

impl From<&Split> for Output {
    fn from(split: &Split) -> Self {
        Self {
            manifest_sha256: split.sha256.clone(),
            bytes: split.bytes,
            adopted: split.adopted,
        }
    }
}

impl RunTask for SplitTask {
    fn code_version() -> String {
        Self::VERSION.to_owned()
    }

    fn run(&self, context: &Context, _task: &Task, control: &Control) -> Result<Output, TaskError> {
        let SourceSettings { store, dataset } = &self.source;
        let split = run(&context.stores, &self.split, store, dataset, control)?;
        Ok(Output::from(&split))
    }
}

/// Makes the split, extends it, or finds it as it is.
fn run(
    stores: &Stores,
    settings: &SplitSettings,
    store: &str,
    dataset: &str,
    control: &Control,
) -> Result<Split, TaskError> {
    let user = |e: picofarm_proto::model::SpecError| TaskError::User(e.to_string());
    settings.check().map_err(user)?;
    let dataset = stores.open_source(store, dataset, control)?;
    let present = present(stores, &dataset, control)?;
    for _ in 0..ATTEMPTS {
        let next = match newest(stores, &dataset, &settings.name, control)? {
            None => SplitRecord::first(settings, &present).map_err(user)?,
            Some(record) => match record.extended(settings, &present).map_err(user)? {
                None => return Ok(found_as(record, &dataset, &present, true)),
                Some(next) => next,
            },
        };
        let bytes = next.to_bytes();
        let create = dataset.create_split(&settings.name, next.version, bytes);
        if stores.wait(control, create)? {
            control.at(1.0);
            return Ok(found_as(next, &dataset, &present, false));
        }
    }
    Err(TaskError::Interrupted(format!(
        "split.name: others wrote versions of {:?} all the while; try again",
        settings.name
    )))
}

fn present(
    stores: &Stores,
    dataset: &Dataset,
    control: &Control,
) -> Result<BTreeSet<u64>, TaskError> {
    let present = stores.wait(control, dataset.scenes_present())?;
    Ok(present.into_iter().collect())
}

fn newest(
    stores: &Stores,
    dataset: &Dataset,
    name: &str,
    control: &Control,
) -> Result<Option<SplitRecord>, TaskError> {
    let versions = stores.wait(control, dataset.split_versions(name))?;
    let Some(version) = versions.last() else {
        return Ok(None);
    };
    let bytes = stores.wait(control, dataset.read_split(name, *version))?;
    let damaged =
        |what: String| TaskError::User(format!("{}: {what}", dataset.split_place(name, *version)));
    let record = SplitRecord::parse(&bytes).map_err(damaged)?;
    if record.version != *version || record.settings.name != name {
        return Err(damaged(format!(
            "holds version {} of {:?}",
            record.version, record.settings.name
        )));
    }
    Ok(Some(record))
}

fn found_as(
    record: SplitRecord,
    dataset: &Dataset,
    present: &BTreeSet<u64>,
    adopted: bool,
) -> Split {
    let bytes = record.to_bytes();
    let all = picofarm_proto::split::SIDES.map(|side| record.scenes(side));
    let missing = all.iter().flatten().filter(|s| !present.contains(s));
    Split {
        missing: missing.count() as u64,
        place: dataset.split_place(&record.settings.name, record.version),
        sha256: hex::encode(Sha256::digest(&bytes)),
        bytes: bytes.len() as u64,
        adopted,
        record,
    }
}
