//! The data set as the executor sees it: opened for a job, asked for finished scenes, and published to with
//! patience. Says who is to blame when the store does not play along.

use std::{
    collections::BTreeSet,
    sync::Mutex,
    time::{Duration, Instant},
};

use picofarm_dataset::{
    Dataset, DatasetError, DatasetSpec, EncodedScene, Gate, Manifest, Profile, Subsets, open_store,
    probe,
};
use picofarm_proto::{key::TaskKey, model::JobSpec};
use sha2::{Digest, Sha256};
use tokio::runtime::Handle;
use tracing::warn;

use super::{Control, TaskError};
use crate::session::backoff::{Backoff, random};

/// Stores, reached from the executor's own thread.
pub(super) struct Stores {
    runtime: Handle,
    /// Locations that passed the probe.
    probed: Mutex<BTreeSet<String>>,
    /// How long a rendered scene is held for a store that does not take it.
    patience: Duration,
}

impl Stores {
    pub(super) fn new(runtime: Handle, patience: Duration) -> Self {
        Self {
            runtime,
            probed: Mutex::default(),
            patience,
        }
    }

    /// Creates or opens the job's data set. The first use of a location proves that its store is safe.
    pub(super) fn open(&self, spec: &JobSpec) -> Result<Dataset, TaskError> {
        let place = &spec.output;
        self.create_or_open(&place.store, &place.dataset, &dataset_spec(spec)?)
    }

    /// Creates or opens a data set to write to. The first use of a location proves that its store is safe.
    pub(super) fn create_or_open(
        &self,
        location: &str,
        dataset: &str,
        spec: &DatasetSpec,
    ) -> Result<Dataset, TaskError> {
        let (store, prefix) = open_store(location).map_err(of_dataset)?;
        let probed = |s: &Self| {
            s.probed
                .lock()
                .expect("no panic while locked")
                .contains(location)
        };
        if !probed(self) {
            self.runtime
                .block_on(probe(&*store, &prefix))
                .map_err(of_dataset)?;
            let mut probed = self.probed.lock().expect("no panic while locked");
            probed.insert(location.to_owned());
        }
        self.wait(Dataset::create_or_open(store, prefix.join(dataset), spec))
    }

    /// Opens a data set to read; creates nothing.
    pub(super) fn open_source(&self, location: &str, dataset: &str) -> Result<Dataset, TaskError> {
        let (store, prefix) = open_store(location).map_err(of_dataset)?;
        self.wait(Dataset::open(store, prefix.join(dataset)))
    }

    /// Waits for an operation on a data set.
    pub(super) fn wait<T>(
        &self,
        operation: impl Future<Output = Result<T, DatasetError>>,
    ) -> Result<T, TaskError> {
        self.read(operation).map_err(of_dataset)
    }

    /// Waits for an operation whose error the caller judges.
    pub(super) fn read<T>(
        &self,
        operation: impl Future<Output = Result<T, DatasetError>>,
    ) -> Result<T, DatasetError> {
        self.runtime.block_on(operation)
    }

    /// The manifest of scene `index` if this very task has published it.
    pub(super) fn finished(
        &self,
        dataset: &Dataset,
        index: u64,
        key: &TaskKey,
    ) -> Result<Option<Manifest>, TaskError> {
        let manifest = match self.runtime.block_on(dataset.published(index)) {
            Ok(None) => return Ok(None),
            Ok(Some(manifest)) => manifest,
            Err(error @ DatasetError::Damaged { .. }) => {
                warn!(%error, task = index, "a published scene is damaged; it is made again to mend it");
                return Ok(None);
            }
            Err(error) => return Err(of_dataset(error)),
        };
        if manifest.provenance.task_key != key.to_string() {
            return Err(TaskError::User(format!(
                "output.dataset: {} holds scene {index} of another job (task key {}, this task's is {key}); \
                 choose another output.dataset for these settings",
                dataset.prefix(),
                manifest.provenance.task_key
            )));
        }
        Ok(Some(manifest))
    }

    /// Publishes a scene. A store that fails (unreachable, full) is asked again for a while, so that the
    /// render is not lost with the first hiccup.
    pub(super) fn publish(
        &self,
        dataset: &Dataset,
        scene: EncodedScene,
        control: &Control,
    ) -> Result<Manifest, TaskError> {
        let until = Instant::now() + self.patience;
        let mut backoff = Backoff::new(Duration::from_millis(250), Duration::from_secs(15));
        loop {
            let error = match self
                .runtime
                .block_on(dataset.publish_encoded(scene.clone()))
            {
                Ok(manifest) => return Ok(manifest),
                Err(error) => of_dataset(error),
            };
            if !matches!(error, TaskError::Interrupted(_)) || Instant::now() >= until {
                return Err(error);
            }
            let wait = backoff.next(random());
            warn!(%error, wait_s = wait.as_secs_f64(), "the finished scene cannot be stored yet; trying again");
            let again = Instant::now() + wait;
            while Instant::now() < again {
                if control.stopped() {
                    return Err(TaskError::Stopped);
                }
                std::thread::sleep(Duration::from_millis(50).min(wait));
            }
        }
    }
}

/// The data set that a job's settings describe.
fn dataset_spec(spec: &JobSpec) -> Result<DatasetSpec, TaskError> {
    let render = &spec.render;
    Ok(DatasetSpec {
        scenes: spec.scenes.count,
        height: render.resolution,
        width: render.resolution,
        spots: spec.scenes.spots,
        subsets: Subsets::of(&render.subsets)
            .map_err(|e| TaskError::User(format!("render.subsets: {e}")))?,
        per_spot: render.per_spot,
        gate: Gate {
            start_m: render.gate_start_m,
            bin_width_m: render.bin_width_m,
            bins: render.bins,
        },
        profile: Profile::parse(&spec.output.profile)
            .map_err(|e| TaskError::User(format!("output.profile: {e}")))?,
    })
}

/// SHA-256 of a manifest's bytes as they lie in the store, hexadecimal.
pub(super) fn manifest_sha256(manifest: &Manifest) -> String {
    let mut bytes = serde_json::to_vec_pretty(manifest)
        .expect("a manifest has only string keys and finite numbers");
    bytes.push(b'\n');
    hex::encode(Sha256::digest(&bytes))
}

/// Who is to blame for a data set's error.
pub(super) fn of_dataset(error: DatasetError) -> TaskError {
    let text = error.to_string();
    match error {
        DatasetError::Store { .. } | DatasetError::Io { .. } => TaskError::Interrupted(text),
        DatasetError::Codec { .. } => TaskError::Crash(text),
        _ => TaskError::User(text),
    }
}
