//! Records of a sweep's trials: `models/<sweep>/sweeps/<id>/`, create-only.
//! `rungs/<epochs>/<trial>.json` is a trial's loss after a number of epochs, for comparison with
//! the others; `trials/<trial>.json` is its final state.

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::path::Path;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Models, check_name};
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::{read_unsealed, seal, sha256_hex};

/// Folder of sweeps in a model's folder.
const FOLDER: &str = "sweeps";
/// Number of objects read concurrently.
const AT_ONCE: usize = 16;

/// The final state of a trial. It is a pure function of the training and of the point where it
/// stopped.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialRecord {
    /// The sweep's name.
    pub sweep: String,
    /// Id of the sweep among those of this name.
    pub id: String,
    /// The trial's number.
    pub index: u64,
    /// Its parameter values, by name.
    pub values: BTreeMap<String, Value>,
    /// The candidate values of each parameter, by name, as in the job file. Empty if unknown.
    pub over: BTreeMap<String, Value>,
    /// Name of its model, which exists only if the trial finished.
    pub model: String,
    /// The predicted quantity: `tof`, `shadow` or `specular`.
    pub kind: String,
    /// Key of the training.
    pub training_key: String,
    /// The outcome.
    pub end: TrialEnd,
    /// Number of completed epochs.
    pub epochs: u64,
    /// Final loss on the validation scenes: mean absolute error in metres, or one minus IoU.
    pub loss: Option<f64>,
    /// One entry per epoch, as in a model's `history.jsonl`.
    pub history: Vec<Value>,
}

/// The outcome of a trial.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrialEnd {
    /// The training finished.
    Finished,
    /// It was stopped because others were better.
    Pruned,
    /// The named quantity became infinite or NaN.
    Diverged(String),
}

/// A trial's loss at a rung.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rung {
    /// The trial's number.
    pub index: u64,
    /// Number of completed epochs.
    pub epochs: u64,
    /// The loss, see [`TrialRecord::loss`].
    pub loss: f64,
}

impl TrialRecord {
    /// Returns the bytes to store.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut sorted = self.clone();
        let values = sorted.values.values_mut();
        values
            .chain(sorted.over.values_mut())
            .chain(&mut sorted.history)
            .for_each(Value::sort_all_objects);
        json(&sorted)
    }

    /// Returns the SHA-256 of its bytes, in hexadecimal.
    pub fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }
}

impl Models {
    /// Stores the final state of a trial. Returns the stored record, because another run of the
    /// same trial may have been stored first.
    ///
    /// # Errors
    /// [`StorageError::Store`], [`StorageError::Damaged`] if another run's record cannot be read.
    pub async fn put_trial(&self, trial: &TrialRecord) -> Result<TrialRecord, StorageError> {
        let path = self.sweep_path(
            &trial.sweep,
            &trial.id,
            &format!("trials/{}.json", trial.index),
        )?;
        objects::create(&*self.store, &path, trial.to_bytes().into()).await?;
        let stands = objects::require(&*self.store, &path).await?;
        self.parse(&path, &stands)
    }

    /// Returns the final state of a trial, if it has ended.
    ///
    /// # Errors
    /// [`StorageError::Store`], [`StorageError::Damaged`].
    pub async fn trial(
        &self,
        sweep: &str,
        id: &str,
        index: u64,
    ) -> Result<Option<TrialRecord>, StorageError> {
        let path = self.sweep_path(sweep, id, &format!("trials/{index}.json"))?;
        let found = objects::get(&*self.store, &path).await?;
        found.map(|bytes| self.parse(&path, &bytes)).transpose()
    }

    /// Stores a trial's loss at a rung. An existing record is retained, and is the same.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn put_rung(&self, sweep: &str, id: &str, rung: &Rung) -> Result<(), StorageError> {
        let key = format!("rungs/{}/{}.json", rung.epochs, rung.index);
        let path = self.sweep_path(sweep, id, &key)?;
        objects::create(&*self.store, &path, json(rung).into()).await?;
        Ok(())
    }

    /// Returns the losses of all trials that have reached the rung after this number of epochs.
    ///
    /// # Errors
    /// [`StorageError::Store`], [`StorageError::Damaged`].
    pub async fn rung(
        &self,
        sweep: &str,
        id: &str,
        epochs: u64,
    ) -> Result<Vec<Rung>, StorageError> {
        let folder = self.sweep_path(sweep, id, &format!("rungs/{epochs}"))?;
        self.read_all(&folder).await
    }

    /// Returns the sweeps of a name.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn sweeps(&self, sweep: &str) -> Result<BTreeSet<String>, StorageError> {
        check_name(sweep)?;
        let folder = self.path(sweep, FOLDER);
        let listed = self.store.list_with_delimiter(Some(&folder)).await;
        let listed = listed.map_err(|e| self.failed("list", &folder, e))?;
        let ids = listed.common_prefixes.iter().filter_map(Path::filename);
        Ok(ids.map(str::to_owned).collect())
    }

    /// Returns the final states of a sweep's trials, and the losses of trials that reached a rung,
    /// in order.
    ///
    /// # Errors
    /// [`StorageError::Store`], [`StorageError::Damaged`].
    pub async fn trials(
        &self,
        sweep: &str,
        id: &str,
    ) -> Result<(Vec<TrialRecord>, Vec<Rung>), StorageError> {
        let mut trials: Vec<TrialRecord> = self
            .read_all(&self.sweep_path(sweep, id, "trials")?)
            .await?;
        let mut rungs: Vec<Rung> = self.read_all(&self.sweep_path(sweep, id, "rungs")?).await?;
        trials.sort_by_key(|trial| trial.index);
        rungs.sort_by_key(|rung| (rung.epochs, rung.index));
        Ok((trials, rungs))
    }

    /// Reads all documents in a folder.
    async fn read_all<T: DeserializeOwned>(&self, folder: &Path) -> Result<Vec<T>, StorageError> {
        let paths = self.list(folder).await?.into_iter().map(|o| o.location);
        stream::iter(paths)
            .map(async |path| {
                let bytes = objects::require(&*self.store, &path).await?;
                self.parse(&path, &bytes)
            })
            .buffered(AT_ONCE)
            .try_collect()
            .await
    }

    fn parse<T: DeserializeOwned>(&self, path: &Path, bytes: &Bytes) -> Result<T, StorageError> {
        read_unsealed(bytes, "the record of a trial", self.shown(path))
    }

    fn sweep_path(&self, sweep: &str, id: &str, key: &str) -> Result<Path, StorageError> {
        check_name(sweep)?;
        check_name(id)?;
        Ok(self.path(sweep, &format!("{FOLDER}/{id}/{key}")))
    }
}

fn json<T: Serialize>(document: &T) -> Vec<u8> {
    let mut bytes = serde_json::to_vec_pretty(document).expect("finite numbers and string keys");
    bytes.push(b'\n');
    seal(&bytes)
}
