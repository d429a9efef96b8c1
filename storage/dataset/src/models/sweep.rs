//! What trials of a sweep tell of themselves: `models/<sweep>/sweeps/<id>/`, create-only. `rungs/<epochs>/<trial>.json` is
//! how good a trial was after so many epochs, for the others to compare with; `trials/<trial>.json` how it ended.

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::path::Path;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Models, check_name};
use crate::error::DatasetError;
use crate::layout::manifest::{read_unsealed, seal, sha256_hex};
use crate::store::objects;

/// Folder of sweeps below a name.
const FOLDER: &str = "sweeps";
/// Objects that are read at a time.
const AT_ONCE: usize = 16;

/// How a trial ended. A pure function of its training and of where it stopped.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialRecord {
    /// The sweep's name.
    pub sweep: String,
    /// Which sweep of that name.
    pub id: String,
    /// The trial's number.
    pub index: u64,
    /// Its values, by the parameters' names.
    pub values: BTreeMap<String, Value>,
    /// By the parameters' names: the values that each may have, as in the job file. Empty where it does not say.
    pub over: BTreeMap<String, Value>,
    /// The name of its model; there is one only where it came to its end.
    pub model: String,
    /// What it predicts: `tof`, `shadow` or `specular`.
    pub kind: String,
    /// Key of the training.
    pub training_key: String,
    /// How it ended.
    pub end: TrialEnd,
    /// Epochs done.
    pub epochs: u64,
    /// How bad it was at the end, on the validation scenes: mean absolute error in metres, or one less IoU.
    pub loss: Option<f64>,
    /// A line for each epoch, as in a model's `history.jsonl`.
    pub history: Vec<Value>,
}

/// How a trial ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrialEnd {
    /// It came to its end.
    Finished,
    /// It fell behind others.
    Pruned,
    /// Its numbers became infinite or none: what did.
    Diverged(String),
}

/// How good a trial was at a rung.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rung {
    /// The trial's number.
    pub index: u64,
    /// Epochs done.
    pub epochs: u64,
    /// As [`TrialRecord::loss`].
    pub loss: f64,
}

impl TrialRecord {
    /// Its bytes as they lie in the store.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut sorted = self.clone();
        let values = sorted.values.values_mut();
        values
            .chain(sorted.over.values_mut())
            .chain(&mut sorted.history)
            .for_each(Value::sort_all_objects);
        json(&sorted)
    }

    /// SHA-256 of its bytes, hexadecimal.
    pub fn sha256(&self) -> String {
        sha256_hex(&self.to_bytes())
    }
}

impl Models {
    /// Stores how a trial ended, and says what stands: another run of the same trial may have been faster.
    ///
    /// # Errors
    /// [`DatasetError::Store`], [`DatasetError::Damaged`] for another's that cannot be read.
    pub async fn put_trial(&self, trial: &TrialRecord) -> Result<TrialRecord, DatasetError> {
        let path = self.sweep_path(
            &trial.sweep,
            &trial.id,
            &format!("trials/{}.json", trial.index),
        )?;
        objects::create(&*self.store, &path, trial.to_bytes().into()).await?;
        let stands = objects::require(&*self.store, &path).await?;
        self.parse(&path, &stands)
    }

    /// How a trial ended, if it has.
    ///
    /// # Errors
    /// [`DatasetError::Store`], [`DatasetError::Damaged`].
    pub async fn trial(
        &self,
        sweep: &str,
        id: &str,
        index: u64,
    ) -> Result<Option<TrialRecord>, DatasetError> {
        let path = self.sweep_path(sweep, id, &format!("trials/{index}.json"))?;
        let found = objects::get(&*self.store, &path).await?;
        found.map(|bytes| self.parse(&path, &bytes)).transpose()
    }

    /// Stores how good a trial is at a rung; a record that is there stands, and is the same.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn put_rung(&self, sweep: &str, id: &str, rung: &Rung) -> Result<(), DatasetError> {
        let key = format!("rungs/{}/{}.json", rung.epochs, rung.index);
        let path = self.sweep_path(sweep, id, &key)?;
        objects::create(&*self.store, &path, json(rung).into()).await?;
        Ok(())
    }

    /// How good all trials were that have reached the rung after so many epochs.
    ///
    /// # Errors
    /// [`DatasetError::Store`], [`DatasetError::Damaged`].
    pub async fn rung(
        &self,
        sweep: &str,
        id: &str,
        epochs: u64,
    ) -> Result<Vec<Rung>, DatasetError> {
        let folder = self.sweep_path(sweep, id, &format!("rungs/{epochs}"))?;
        self.read_all(&folder).await
    }

    /// The sweeps of a name.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn sweeps(&self, sweep: &str) -> Result<BTreeSet<String>, DatasetError> {
        check_name(sweep)?;
        let folder = self.path(sweep, FOLDER);
        let listed = self.store.list_with_delimiter(Some(&folder)).await;
        let listed = listed.map_err(|e| self.failed("list", &folder, e))?;
        let ids = listed.common_prefixes.iter().filter_map(Path::filename);
        Ok(ids.map(str::to_owned).collect())
    }

    /// How the trials of a sweep ended, and how good those were at rungs that came to any, in order.
    ///
    /// # Errors
    /// [`DatasetError::Store`], [`DatasetError::Damaged`].
    pub async fn trials(
        &self,
        sweep: &str,
        id: &str,
    ) -> Result<(Vec<TrialRecord>, Vec<Rung>), DatasetError> {
        let mut trials: Vec<TrialRecord> = self
            .read_all(&self.sweep_path(sweep, id, "trials")?)
            .await?;
        let mut rungs: Vec<Rung> = self.read_all(&self.sweep_path(sweep, id, "rungs")?).await?;
        trials.sort_by_key(|trial| trial.index);
        rungs.sort_by_key(|rung| (rung.epochs, rung.index));
        Ok((trials, rungs))
    }

    /// All documents below a folder.
    async fn read_all<T: DeserializeOwned>(&self, folder: &Path) -> Result<Vec<T>, DatasetError> {
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

    fn parse<T: DeserializeOwned>(&self, path: &Path, bytes: &Bytes) -> Result<T, DatasetError> {
        read_unsealed(bytes, "the record of a trial", self.shown(path))
    }

    fn sweep_path(&self, sweep: &str, id: &str, key: &str) -> Result<Path, DatasetError> {
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
