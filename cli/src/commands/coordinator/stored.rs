//! Checks for a coordinator whether stores contain the results that workers have reported.
//!
//! By default, only folders of the coordinator's machine are checked. A submitter chooses a store's
//! location and must not make the coordinator send requests to arbitrary hosts, so object stores
//! are checked only if the operator names them. In a folder, only files with the names of results
//! are opened and only their hash is compared, so that nobody learns the contents of a file.

use std::{
    collections::HashMap,
    fmt,
    path::PathBuf,
    sync::{Arc, Mutex},
};

use futures::future::BoxFuture;
use object_store::{ObjectStore, path::Path};
use picofarm_coordinator::{ResultReader, ResultState};
use picofarm_dataset::PartName;
use picofarm_proto::spec::{
    StageSpec,
    kinds::{Manifest, TaskKind},
};
use picofarm_results::{Held, Holdings};
use picofarm_store::{StorageError, check_identity, open_store};
use picofarm_tasks::StorePrefixes;
use tokio::runtime::{Builder, Runtime};
use tokio_util::task::AbortOnDropHandle;
use uuid::Uuid;

use crate::error::{CliError, Code, Result};

/// Number of stores that remain open.
const STORES: usize = 64;
/// Number of threads that stores on a hanging disk can block. Nothing else uses these threads.
const THREADS: usize = 64;
/// In an object store, the objects of one scene in this many are looked up; in a folder, those of
/// all.
const ONE_IN: u64 = 8;

/// Reads stores, on a runtime of its own.
pub struct StoreReader {
    allowed: Allowed,
    opened: Mutex<HashMap<String, StorePath>>,
    /// `None` only while being dropped.
    runtime: Option<Runtime>,
}

/// Stores that may be read.
#[derive(Debug)]
enum Allowed {
    /// Folders of this machine.
    Folders,
    /// Stores below these prefixes.
    Below(StorePrefixes),
    /// Any store.
    Any,
}

type StorePath = (Arc<dyn ObjectStore>, Path);

impl StoreReader {
    /// Creates the reader for `--check-stores`: folders of this machine by default, no reader for
    /// `none`, or stores below prefixes.
    ///
    /// # Errors
    /// Fails if a prefix is invalid, or no threads can be started.
    pub fn asked_for(texts: &[String]) -> Result<Option<Self>> {
        match texts {
            [] => Self::new(Allowed::Folders).map(Some),
            [none] if none == "none" => Ok(None),
            prefixes => Self::below(prefixes).map(Some),
        }
    }

    /// Reads stores below these prefixes.
    ///
    /// # Errors
    /// Fails if a prefix is invalid, or no threads can be started.
    pub fn below(prefixes: &[String]) -> Result<Self> {
        let allowed = StorePrefixes::new(prefixes)
            .map_err(|e| CliError::input(format!("--check-stores: {e}")))?;
        Self::new(Allowed::Below(allowed))
    }

    /// Reads any store, for a process that also runs the tasks, and therefore accesses whatever
    /// store they name.
    ///
    /// # Errors
    /// Fails if no threads can be started.
    pub fn anywhere() -> Result<Self> {
        Self::new(Allowed::Any)
    }

    fn new(allowed: Allowed) -> Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .max_blocking_threads(THREADS)
            .thread_name("stores")
            .enable_all()
            .build()
            .map_err(|e| CliError::new(Code::Resource, format!("threads to read stores: {e}")))?;
        Ok(Self {
            allowed,
            opened: Mutex::default(),
            runtime: Some(runtime),
        })
    }

    fn open(&self, location: &str) -> std::result::Result<StorePath, String> {
        match &self.allowed {
            Allowed::Any => {}
            Allowed::Folders if folder(location).is_some() => {}
            Allowed::Folders => {
                return Err(
                    "it is no folder of the coordinator's machine, and --check-stores does not name it".into(),
                );
            }
            Allowed::Below(prefixes) if prefixes.hold(location) => {}
            Allowed::Below(_) => {
                return Err(
                    "it lies in none of the places that --check-stores names to the coordinator"
                        .into(),
                );
            }
        }
        let mut opened = self.opened.lock().expect("no panic while locked");
        if let Some(place) = opened.get(location) {
            return Ok(place.clone());
        }
        if opened.len() >= STORES {
            opened.clear();
        }
        let place = open_store(location).map_err(|e| unreadable(&e))?;
        opened.insert(location.to_owned(), place.clone());
        Ok(place)
    }
}

/// Returns the folder of this machine that a location names.
fn folder(location: &str) -> Option<PathBuf> {
    let place = picofarm_proto::spec::Place {
        field: "store",
        store: location,
        folder: "".into(),
    };
    let path = place.normal();
    path.starts_with('/').then(|| path.into())
}

/// The tasks of a question, each with the reported SHA-256.
type Results = Vec<(u64, [u8; 32])>;

/// A question to a store, in terms of its data sets or models.
#[derive(Clone)]
enum Question {
    Scenes(String, Results),
    Parts(String, Vec<PartName>),
    Gltf(Results),
    Model(String, Results),
    /// Sweep, its id, the trial, and the results.
    Trial(String, String, u64, Results),
    Report(String, Results),
    Split(String, String, Results),
}

impl Question {
    /// Returns the question about results of a stage and the store to ask, or the reason why there
    /// is none.
    fn new(
        stage: &StageSpec,
        results: &[(u64, [u8; 32])],
    ) -> std::result::Result<(String, Self), String> {
        let place = stage.task.results();
        let results = results.to_vec();
        let question = match place.manifest {
            Manifest::Scene { dataset } => Self::Scenes(dataset.to_owned(), results),
            Manifest::Part {
                dataset,
                whole,
                division,
            } => {
                let name = |(index, _): &(u64, [u8; 32])| {
                    let (scene, part) = division.split(*index);
                    let key = whole.scene_key(scene)?;
                    Some(PartName {
                        scene,
                        task_key: key.to_string(),
                        part: (part, division.parts),
                    })
                };
                let names: Option<Vec<PartName>> = results.iter().map(name).collect();
                let names = names.ok_or("the job lists no file for a scene of these parts")?;
                Self::Parts(dataset.to_owned(), names)
            }
            Manifest::Gltf => Self::Gltf(results),
            Manifest::Model { name } => Self::Model(name.to_owned(), results),
            Manifest::Trial(trial) => {
                Self::Trial(trial.sweep.clone(), trial.id.clone(), trial.index, results)
            }
            Manifest::Report { name } => Self::Report(name.to_owned(), results),
            Manifest::Split { dataset, name } => {
                Self::Split(dataset.to_owned(), name.to_owned(), results)
            }
            Manifest::None => {
                let kind = stage.task.kind();
                return Err(format!(
                    "a stage of kind {kind:?} leaves no manifest to compare with"
                ));
            }
        };
        Ok((place.store.to_owned(), question))
    }

    /// Asks the store. `thorough` selects the scenes for which the objects are looked up too.
    async fn ask(
        self,
        holdings: &Holdings,
        thorough: impl Fn(u64) -> bool,
    ) -> std::result::Result<Vec<Held>, StorageError> {
        let mut held = Vec::new();
        match self {
            Self::Scenes(dataset, results) => {
                return holdings.scenes(&dataset, &results, thorough).await;
            }
            Self::Parts(dataset, parts) => return holdings.parts(&dataset, &parts).await,
            Self::Gltf(results) => return holdings.gltf_scenes(&results).await,
            Self::Model(name, results) => {
                for (_, sha256) in results {
                    held.push(holdings.model(&name, sha256).await?);
                }
            }
            Self::Trial(sweep, id, index, results) => {
                for (_, sha256) in results {
                    held.push(holdings.trial((&sweep, &id, index), sha256).await?);
                }
            }
            Self::Report(name, results) => {
                for (_, sha256) in results {
                    held.push(holdings.report(&name, sha256).await?);
                }
            }
            Self::Split(dataset, name, results) => {
                for (_, sha256) in results {
                    held.push(holdings.split(&dataset, &name, sha256).await?);
                }
            }
        }
        Ok(held)
    }
}

impl ResultReader for StoreReader {
    fn check<'a>(
        &'a self,
        stage: &'a StageSpec,
        results: &'a [(u64, [u8; 32])],
    ) -> BoxFuture<'a, std::result::Result<Vec<ResultState>, String>> {
        Box::pin(async move {
            let (location, question) = Question::new(stage, results)?;
            let (store, prefix) = self.open(&location)?;
            let folder = folder(&location);
            // If an operator names a store, it is known to be the workers' store.
            let may_be_absent = matches!(self.allowed, Allowed::Folders);
            let count = results.len();
            let identity = stage.stores.get(location.trim_end_matches('/'));
            let identity = identity.and_then(|text| Uuid::try_parse(text).ok());
            let asked = async move {
                let local = folder.is_some();
                let thorough = move |task: u64| local || task.is_multiple_of(ONE_IN);
                if may_be_absent
                    && let Some(folder) = &folder
                    && let Ok(false) = tokio::fs::try_exists(folder).await
                {
                    let around = folder.parent().unwrap_or(folder);
                    let found = match tokio::fs::try_exists(around).await {
                        Ok(true) => ResultState::NoStore,
                        _ => ResultState::NoFolder,
                    };
                    return Ok::<Vec<ResultState>, StorageError>(vec![found; count]);
                }
                // If this machine has not mounted the store, all results would seem lost.
                if let Some(identity) = identity {
                    check_identity(&*store, &prefix, identity).await?;
                }
                let holdings = Holdings::new(store, prefix);
                let mut held = question.clone().ask(&holdings, thorough).await?;
                if let (Some(folder), Question::Scenes(dataset, _)) = (&folder, &question)
                    && held.contains(&Held::Gone)
                {
                    // A network file system caches for a while that a file was missing. Opening its
                    // folder makes it ask the server again, whether or not that succeeds.
                    let _ = tokio::fs::read_dir(folder.join(dataset).join("manifests")).await;
                    held = question.ask(&holdings, thorough).await?;
                }
                let found = held.into_iter().map(|held| match held {
                    Held::Equal => ResultState::Equal,
                    Held::Gone => ResultState::Gone,
                    Held::Other => ResultState::Differs,
                });
                Ok(found.collect())
            };
            let runtime = self.runtime.as_ref().expect("there until it is dropped");
            // Aborts when the caller stops waiting.
            let running = AbortOnDropHandle::new(runtime.spawn(asked));
            match running.await {
                Ok(Ok(found)) => Ok(found),
                Ok(Err(error)) => Err(unreadable(&error)),
                Err(error) => Err(format!("looking into the store failed: {error}")),
            }
        })
    }
}

impl fmt::Debug for StoreReader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StoreReader")
            .field("allowed", &self.allowed)
            .finish_non_exhaustive()
    }
}

impl Drop for StoreReader {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // Does not wait for threads that a hanging disk blocks.
            runtime.shutdown_background();
        }
    }
}

fn unreadable(error: &StorageError) -> String {
    format!("this coordinator cannot read it: {error}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stage(store: &str) -> StageSpec {
        let text = format!(
            r#"{{"name": "test", "scenes": {{"kind": "primitive", "count": 2}},
                "render": {{"renderer": "r1"}}, "output": {{"store": "{store}", "dataset": "d"}}}}"#
        );
        let spec: picofarm_proto::spec::JobSpec = serde_json::from_str(&text).unwrap();
        spec.stages[0].clone()
    }

    #[tokio::test]
    async fn only_stores_below_the_prefixes_are_looked_into() {
        let folder = tempfile::tempdir().unwrap();
        let inside = folder.path().join("mine");
        std::fs::create_dir_all(&inside).unwrap();
        let reader = StoreReader::below(&[inside.display().to_string()]).unwrap();
        let results = [(0, [0; 32])];
        let at = stage(&format!("file://{}/store", inside.display()));
        assert_eq!(
            reader.check(&at, &results).await,
            Ok(vec![ResultState::Gone])
        );
        for store in [
            "file:///etc",
            "s3://bucket/a",
            "http://169.254.169.254/latest",
        ] {
            let why = reader.check(&stage(store), &results).await.unwrap_err();
            assert!(why.contains("--check-stores"), "{store}: {why}");
        }
        assert!(StoreReader::below(&["relative".into()]).is_err());
    }

    #[tokio::test]
    async fn a_folder_that_is_not_mounted_here_is_not_taken_for_an_empty_store() {
        let folder = tempfile::tempdir().unwrap();
        let reader = StoreReader::anywhere().unwrap();
        let place = folder.path().display().to_string();
        let mut at = stage(&place);
        let results = [(0, [0; 32])];
        assert_eq!(
            reader.check(&at, &results).await,
            Ok(vec![ResultState::Gone])
        );
        at.stores.insert(place, Uuid::nil().to_string());
        let why = reader.check(&at, &results).await.unwrap_err();
        assert!(why.contains("no store identity"), "{why}");
    }

    #[tokio::test]
    async fn by_default_folders_are_looked_into_and_no_host_is_asked() {
        let place = tempfile::tempdir().unwrap();
        let reader = StoreReader::asked_for(&[]).unwrap().unwrap();
        let results = [(0, [0; 32])];
        let at = stage(&place.path().display().to_string());
        assert_eq!(
            reader.check(&at, &results).await,
            Ok(vec![ResultState::Gone])
        );
        let at = stage(&format!("file://{}/absent", place.path().display()));
        assert_eq!(
            reader.check(&at, &results).await,
            Ok(vec![ResultState::NoStore])
        );
        let at = stage(&format!("file://{}/absent/too", place.path().display()));
        assert_eq!(
            reader.check(&at, &results).await,
            Ok(vec![ResultState::NoFolder])
        );
        for store in ["s3://bucket/a", "http://169.254.169.254/latest"] {
            let why = reader.check(&stage(store), &results).await.unwrap_err();
            assert!(why.contains("--check-stores"), "{store}: {why}");
        }
        assert!(StoreReader::asked_for(&["none".into()]).unwrap().is_none());
    }

    #[tokio::test]
    async fn a_store_without_credentials_is_said_to_be_unreadable() {
        let reader = StoreReader::anywhere().unwrap();
        let at = stage("ftp://host/a");
        let why = reader.check(&at, &[(0, [0; 32])]).await.unwrap_err();
        assert!(why.contains("cannot read it"), "{why}");
    }
}
