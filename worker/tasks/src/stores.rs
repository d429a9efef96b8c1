//! The executor's access to stores: opens data sets, looks up finished scenes, and publishes
//! results with retries. Classifies store errors by cause.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use bytes::Bytes;
use object_store::{ObjectStore, path::Path};
use picofarm_dataset::{Dataset, DatasetSpec, EncodedScene, METADATA, Manifest, Profile, Subsets};
use picofarm_proto::{
    key::TaskKey,
    messages::log::VERDICT,
    spec::{RenderTask, StageSpec, TaskSpec, memory::Known},
    trace,
};
use picofarm_results::Verdict;
use picofarm_scene::Scene;
use picofarm_session::{Backoff, Control, TaskError, memory_mib, random};
use picofarm_store::published::Manifest as _;
use picofarm_store::{
    PROBE_WITHIN, StorageError, check_identity, check_own_folder, expect_identity, objects,
    open_store, probe,
};
use picofarm_transient::Settings;
use sha2::{Digest, Sha256};
use tokio::runtime::Handle;
use tracing::{debug_span, info, warn};
use uuid::Uuid;

use crate::{errors::dataset_error, memory};

/// A store and the prefix in it.
type StorePath = (Arc<dyn ObjectStore>, Path);
/// A store's location and the identity that it must have.
type StoreName = (String, Option<Uuid>);

/// Minimum time for which a result is retried if the store does not accept it.
const LEAST_PATIENCE: Duration = Duration::from_secs(3);
/// Interval at which a task that waits for its store checks whether it must stop.
const STOP_LOOK: Duration = Duration::from_millis(50);

/// Maximum time for which a finished scene waits for a full or unreachable store before its task is
/// handed back.
pub(crate) const STORE_PATIENCE: Duration = Duration::from_secs(120);

/// A data set as it was last opened for writing.
#[derive(Clone)]
struct LastDataset {
    /// The properties that the task described.
    asked: DatasetSpec,
    /// The bytes of the root's metadata.
    root: Bytes,
    dataset: Dataset,
}

/// Stores, accessed from the executor's own threads.
pub(crate) struct Stores {
    runtime: Handle,
    /// Opened stores that passed the probe, by location. Their connections are kept from task to
    /// task.
    probed: Mutex<BTreeMap<StoreName, StorePath>>,
    /// Folders that passed the check of their contents: empty, or only with names of the kind that
    /// writes there.
    own_folders: Mutex<BTreeSet<String>>,
    /// The data set that was last opened for writing, so that tasks of the same stage need not
    /// parse its metadata again.
    last: Mutex<Option<LastDataset>>,
    /// Opened stores that are only read, by location.
    sources: Mutex<BTreeMap<StoreName, StorePath>>,
    /// Maximum time for which a rendered scene is retried if the store does not accept it.
    patience: Duration,
    /// Memory that tasks may use, in MiB; 0 = unknown.
    memory_mib: u64,
}

impl Stores {
    pub(crate) fn new(runtime: Handle, patience: Duration) -> Self {
        Self {
            runtime,
            probed: Mutex::default(),
            own_folders: Mutex::default(),
            last: Mutex::default(),
            sources: Mutex::default(),
            patience,
            memory_mib: memory_mib(),
        }
    }

    /// Sets the memory that tasks may use, in MiB; 0 = unknown.
    pub(crate) fn with_memory(self, memory_mib: u64) -> Self {
        Self { memory_mib, ..self }
    }

    /// Rejects a task that uses more memory than tasks may use on this machine. If several workers
    /// share the machine, each has a share of that memory. `source` is the data set that the task
    /// reads, if memory use depends on it. Returns the memory left to the task, in MiB; `None` =
    /// unknown.
    pub(crate) fn fits(
        &self,
        task: TaskSpec,
        source: Option<&DatasetSpec>,
    ) -> Result<Option<u64>, TaskError> {
        let known = Known {
            source: source.map(memory::shape),
            networks: Vec::new(),
        };
        memory::check(&task, &known, self.memory_mib)
    }

    /// Returns how many tasks of a stage may run at the same time on `threads`.
    pub(crate) fn together(&self, stage: &StageSpec, threads: usize) -> usize {
        memory::together(stage, threads, self.memory_mib)
    }

    /// Rejects a render that uses more memory than tasks may use, once its scene is known. The
    /// memory of a task with scene files is unknown before.
    pub(crate) fn check_render(&self, settings: &Settings, scene: &Scene) -> Result<(), TaskError> {
        memory::check_render(settings, scene, self.memory_mib)
    }

    /// Returns the runtime that serves store requests, for threads other than the executor's.
    pub(crate) fn runtime(&self) -> &Handle {
        &self.runtime
    }

    /// Opens the models of a store for reading and writing. The first use of a location probes its
    /// store.
    #[cfg(feature = "networks")]
    pub(crate) fn models(
        &self,
        location: &str,
        control: &Control,
    ) -> Result<picofarm_results::Models, TaskError> {
        let (store, prefix) = self.probed(location, control)?;
        Ok(picofarm_results::Models::new(store, &prefix))
    }

    /// Creates or opens the job's data set. The first use of a location probes its store.
    pub(crate) fn open(&self, spec: &RenderTask, control: &Control) -> Result<Dataset, TaskError> {
        let place = &spec.output;
        let described = dataset_spec(spec)?;
        self.create_or_open(&place.store, &place.dataset, &described, control)
    }

    /// Creates or opens a data set for writing. The first use of a location probes its store.
    pub(crate) fn create_or_open(
        &self,
        location: &str,
        dataset: &str,
        spec: &DatasetSpec,
        control: &Control,
    ) -> Result<Dataset, TaskError> {
        let (store, prefix) = self.probed(location, control)?;
        let prefix = prefix.join(dataset);
        let root = || {
            self.wait(
                control,
                objects::get(&*store, &prefix.clone().join(METADATA)),
            )
        };
        let same = |last: &&LastDataset| {
            last.dataset.prefix() == &prefix
                && last.asked == *spec
                && Arc::ptr_eq(last.dataset.store(), &store)
        };
        let last = self.last.lock().expect("no panic while locked").clone();
        // Whoever deletes or grows a data set changes its root.
        if let Some(last) = last.as_ref().filter(same)
            && root()?.as_ref() == Some(&last.root)
        {
            return Ok(last.dataset.clone());
        }
        let opened = Dataset::create_or_open(store.clone(), prefix.clone(), spec);
        let dataset = self.wait_for(control, opened, of_open)?;
        let last = root()?.map(|root| LastDataset {
            asked: *spec,
            root,
            dataset: dataset.clone(),
        });
        *self.last.lock().expect("no panic while locked") = last;
        Ok(dataset)
    }

    /// Opens a data set for reading. Creates nothing and needs only read access.
    pub(crate) fn open_source(
        &self,
        location: &str,
        dataset: &str,
        control: &Control,
    ) -> Result<Dataset, TaskError> {
        let (store, prefix) = self.source(location, control)?;
        self.wait_for(control, Dataset::open(store, prefix.join(dataset)), of_open)
    }

    /// Opens the models of a store for reading. Needs only read access.
    #[cfg(feature = "networks")]
    pub(crate) fn source_models(
        &self,
        location: &str,
        control: &Control,
    ) -> Result<picofarm_results::Models, TaskError> {
        let (store, prefix) = self.source(location, control)?;
        Ok(picofarm_results::Models::new(store, &prefix))
    }

    /// Opens a location for reading.
    pub(crate) fn source(&self, location: &str, control: &Control) -> Result<StorePath, TaskError> {
        let name = named(location, control)?;
        let known = || self.sources.lock().expect("no panic while locked");
        if let Some(place) = known().get(&name) {
            return Ok(place.clone());
        }
        let place = opened(&name)?;
        known().insert(name, place.clone());
        Ok(place)
    }

    /// Checks the stores of a task that must have an identity, before the task uses them and again
    /// before its result counts. A store that was mounted in between fails the check.
    pub(crate) fn check_identities(&self, control: &Control) -> Result<(), TaskError> {
        for location in control.identified() {
            let (store, prefix) = self.source(location, control)?;
            if let (_, Some(identity)) = named(location, control)? {
                self.wait(control, check_identity(&*store, &prefix, identity))?;
            }
        }
        Ok(())
    }

    /// Stores a recipe, under a key and for one scene or all, where there is none yet; `false`
    /// where there is one. It is looked for with every scene: who deletes a data set while this
    /// worker runs gets a whole one again.
    pub(crate) fn note_recipe(
        &self,
        dataset: &Dataset,
        (key, scene): (&str, Option<u64>),
        content: &serde_json::Value,
        control: &Control,
    ) -> Result<bool, TaskError> {
        self.wait(control, dataset.create_recipe(key, scene, content))
    }

    /// Opens a location for writing. The first use of a location probes its store.
    pub(crate) fn probed(&self, location: &str, control: &Control) -> Result<StorePath, TaskError> {
        let name = named(location, control)?;
        let known = || self.probed.lock().expect("no panic while locked");
        if let Some(place) = known().get(&name) {
            return Ok(place.clone());
        }
        let (store, prefix) = opened(&name)?;
        self.wait(control, probe(&*store, &prefix, PROBE_WITHIN))?;
        known().insert(name, (store.clone(), prefix.clone()));
        Ok((store, prefix))
    }

    /// Like `probed`, for a folder that a field names, in which `is_own` must accept every name.
    /// The folder is checked once.
    pub(crate) fn probed_own(
        &self,
        (field, location): (&str, &str),
        is_own: impl Fn(&str) -> bool,
        control: &Control,
    ) -> Result<StorePath, TaskError> {
        let (store, prefix) = self.probed(location, control)?;
        let known = || self.own_folders.lock().expect("no panic while locked");
        if !known().contains(location) {
            self.wait(control, check_own_folder(&*store, &prefix, field, is_own))?;
            known().insert(location.to_owned());
        }
        Ok((store, prefix))
    }

    /// Waits for a store request, unless the task must stop, because a request to an unreachable
    /// server can take minutes to fail.
    pub(crate) fn wait<T>(
        &self,
        control: &Control,
        request: impl Future<Output = Result<T, StorageError>>,
    ) -> Result<T, TaskError> {
        self.wait_for(control, request, dataset_error)
    }

    /// Like `wait`, for requests with their own error type.
    pub(crate) fn wait_for<T, E>(
        &self,
        control: &Control,
        request: impl Future<Output = Result<T, E>>,
        blame: impl FnOnce(E) -> TaskError,
    ) -> Result<T, TaskError> {
        let stopped = async {
            while !control.stopped() {
                tokio::time::sleep(STOP_LOOK).await;
            }
        };
        self.runtime.block_on(async {
            tokio::select! {
                biased;
                result = request => result.map_err(blame),
                () = stopped => Err(TaskError::Stopped),
            }
        })
    }

    /// Returns the manifest of scene `index` if this exact task has published it.
    pub(crate) fn finished(
        &self,
        dataset: &Dataset,
        index: u64,
        key: &TaskKey,
        control: &Control,
    ) -> Result<Option<Manifest>, TaskError> {
        let looked = async {
            match dataset.published(index).await {
                Err(error @ StorageError::Damaged { .. }) => {
                    warn!(%error, task = index, "a published scene is damaged; it is made again to repair it");
                    Ok(None)
                }
                other => other,
            }
        };
        let Some(manifest) = self.wait(control, looked)? else {
            return Ok(None);
        };
        if manifest.provenance.task_key != key.to_string() {
            return Err(TaskError::User(format!(
                "output.dataset: {} holds scene {index} of another job (task key {}, this task's is {key}); \
                 choose another output.dataset for these settings",
                dataset.prefix(),
                manifest.provenance.task_key
            )));
        }
        if !self.wait(control, dataset.agrees(&manifest))? {
            warn!(
                task = index,
                "a published scene has other bytes than its manifest names; it is made again to repair it"
            );
            return Ok(None);
        }
        Ok(Some(manifest))
    }

    /// Publishes a scene.
    pub(crate) fn publish(
        &self,
        dataset: &Dataset,
        scene: EncodedScene,
        control: &Control,
    ) -> Result<Manifest, TaskError> {
        let _in = debug_span!(target: trace::TARGET, "publish").entered();
        self.patiently(control, async || {
            match dataset.publish_encoded(scene.clone()).await {
                Err(conflict @ StorageError::Conflict { .. }) => {
                    // A manifest without valid objects must not occupy the scene for ever.
                    let replaced = dataset.replace_unfounded(scene.clone()).await?;
                    replaced.ok_or(conflict)
                }
                published => published,
            }
        })
    }

    /// Retries a request to a store that fails (unreachable, full), so that a result is not lost
    /// with the first hiccup. Retries last as long as the task has taken, because repeating it
    /// would take as long. After that, the worker is more useful for other tasks.
    pub(crate) fn patiently<T>(
        &self,
        control: &Control,
        mut request: impl AsyncFnMut() -> Result<T, StorageError>,
    ) -> Result<T, TaskError> {
        let patience = control.elapsed().max(LEAST_PATIENCE).min(self.patience);
        let until = Instant::now() + patience;
        let mut backoff = Backoff::new(Duration::from_millis(250), Duration::from_secs(15));
        loop {
            let error = match self.wait(control, request()) {
                Ok(done) => return Ok(done),
                Err(error) => error,
            };
            if !matches!(error, TaskError::Store(_)) {
                return Err(error);
            }
            if Instant::now() >= until {
                // The next task probes the store again before it computes.
                self.probed.lock().expect("no panic while locked").clear();
                return Err(error);
            }
            let wait = backoff.next(random());
            warn!(%error, wait_s = wait.as_secs_f64(), "what is finished cannot be stored yet; trying again");
            let again = Instant::now() + wait;
            while Instant::now() < again {
                if control.stopped() {
                    return Err(TaskError::Stopped);
                }
                std::thread::sleep(STOP_LOOK.min(wait));
            }
        }
    }
}

/// Returns a store's location with the identity that a task expects there.
fn named(location: &str, control: &Control) -> Result<StoreName, TaskError> {
    let identity = control.identity(location).map(Uuid::parse_str);
    let identity = identity.transpose().map_err(|e| {
        TaskError::User(format!(
            "stores: the identity of {location}: {e}; submit the job again"
        ))
    })?;
    Ok((location.to_owned(), identity))
}

fn opened((location, identity): &StoreName) -> Result<StorePath, TaskError> {
    let (store, prefix) = open_store(location).map_err(dataset_error)?;
    Ok(match identity {
        Some(identity) => (expect_identity(store, &prefix, *identity), prefix),
        None => (store, prefix),
    })
}

/// Returns the properties of the data set that a job's settings describe.
pub(crate) fn dataset_spec(spec: &RenderTask) -> Result<DatasetSpec, TaskError> {
    let render = &spec.render;
    Ok(DatasetSpec {
        scenes: spec.scenes.count,
        height: render.resolution.height,
        width: render.resolution.width,
        spots: spec.scenes.spots.count(),
        subsets: Subsets::of(&render.subsets)
            .map_err(|e| TaskError::User(format!("render.subsets: {e}")))?,
        per_spot: render.per_spot,
        wavelengths_nm: render.optics.wavelengths_nm,
        two_bounce: false,
        gate: render.gate(),
        profile: Profile::parse(&spec.output.profile)
            .map_err(|e| TaskError::User(format!("output.profile: {e}")))?,
    })
}

/// Returns the SHA-256 of a manifest's stored bytes, in hexadecimal.
pub(crate) fn manifest_sha256(manifest: &Manifest) -> String {
    hex::encode(Sha256::digest(manifest.to_bytes()))
}

/// Like `dataset_error`, for errors on opening: the location may have no picofarm data set.
fn of_open(error: StorageError) -> TaskError {
    match dataset_error(error) {
        TaskError::Damaged(text) => TaskError::User(text),
        other => other,
    }
}

/// Logs a verdict on a result. `job watch` shows it when the job ends.
pub(crate) fn saying(verdict: &Verdict, of: &str) {
    let text = &verdict.text;
    match verdict.doubtful {
        true => warn!("{VERDICT}{of}: {text}"),
        false => info!("{VERDICT}{of}: {text}"),
    }
}
