//! Splitting: a single task that records which scenes of a data set are for training, validation
//! and test.
//!
//! Versions are create-only. If the task runs again, it keeps the newest version, or extends it if
//! scenes have been added since.

use std::{collections::BTreeSet, time::Duration};

use picofarm_dataset::Dataset;
use picofarm_proto::{
    spec::{SourceSettings, SplitTask},
    split::{SplitRecord, SplitSettings},
};
use sha2::{Digest, Sha256};
use tokio::runtime::Handle;

use crate::{
    stores::Stores,
    task::{Context, Control, Output, RunTask, Task, TaskError},
};

/// Maximum number of attempts to write the next version when other writers compete.
const ATTEMPTS: usize = 16;

/// A split of a data set.
#[derive(Debug, Clone, PartialEq)]
pub struct Split {
    /// The newest version.
    pub record: SplitRecord,
    /// Location of the version.
    pub place: String,
    /// SHA-256 of its bytes, in hexadecimal.
    pub sha256: String,
    /// Size of the version in bytes.
    pub bytes: u64,
    /// Whether the version already existed, so that nothing was written.
    pub adopted: bool,
    /// Number of its scenes that are not published, or no longer.
    pub missing: u64,
}

/// Splits data sets.
pub struct Splitter {
    stores: Stores,
}

impl Splitter {
    /// Creates a splitter. `runtime` serves store requests and must not own the calling thread.
    pub fn new(runtime: Handle) -> Self {
        Self {
            stores: Stores::new(runtime, Duration::ZERO),
        }
    }

    /// Makes the split, extends it, or returns it unchanged.
    ///
    /// # Errors
    /// [`TaskError::User`] for unusable settings, and for an existing split of this name with other
    /// settings.
    pub fn run(
        &self,
        settings: &SplitSettings,
        store: &str,
        dataset: &str,
        control: &Control,
    ) -> Result<Split, TaskError> {
        run(&self.stores, settings, store, dataset, control)
    }

    /// Returns the newest version of a split.
    ///
    /// # Errors
    /// [`TaskError::User`] if there is none.
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

/// Makes the split, extends it, or returns it unchanged.
fn run(
    stores: &Stores,
    settings: &SplitSettings,
    store: &str,
    dataset: &str,
    control: &Control,
) -> Result<Split, TaskError> {
    let user = |e: picofarm_proto::spec::SpecError| TaskError::User(e.to_string());
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
