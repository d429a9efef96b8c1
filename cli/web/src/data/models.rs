//! Models, sweeps and reports of the stores.

use std::{
    future::Future,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use picofarm_results::{Evaluation, ModelManifest, Models, Reports, Rung, TrialRecord, Verdict};
use picofarm_store::{StorageError, published::Manifest as _};
use serde_json::Value;

use super::Stores;
use crate::answer::Problem;

/// Models whose objects are read at a time.
const AT_ONCE: usize = 16;
/// Most models of a store that are listed.
const MOST: usize = 500;
/// Time for which what was read is used again: a followed page asks every second.
const FRESH: Duration = Duration::from_secs(4);
/// Entries that are kept.
const KEPT: usize = 32;

/// A model of a store, as a list shows it.
#[derive(Debug)]
pub struct Listed {
    /// Its name.
    pub name: String,
    /// Its manifest, if its training has ended.
    pub manifest: Option<ModelManifest>,
    /// How it compares with trivial answers, on the scenes of its largest evaluation.
    pub verdict: Option<Verdict>,
    /// Steps of the last whole checkpoint of a training that has not ended.
    pub step: Option<u64>,
    /// Ids of the sweeps of this name.
    pub sweeps: Vec<String>,
}

/// The models of a store.
#[derive(Debug, Default)]
pub struct StoreModels {
    /// By name. Trials of sweeps are not among them.
    pub models: Vec<Listed>,
    /// Number of models that are trials of sweeps.
    pub trials: usize,
    /// Number of models that are not listed, because there are too many.
    pub more: usize,
}

/// A model with its records in the store.
#[derive(Debug)]
pub struct Model {
    /// Its manifest.
    pub manifest: ModelManifest,
    /// SHA-256 of the manifest, in hexadecimal.
    pub sha256: String,
    /// Its learning curve: a line of `history.jsonl` each, or why it cannot be read.
    pub history: Result<Vec<Value>, String>,
    /// Its evaluations, that on the most scenes first.
    pub evaluations: Vec<Evaluation>,
    /// Names of the reports that mention it.
    pub reports: Vec<String>,
    /// Ids of the sweeps of this name.
    pub sweeps: Vec<String>,
}

/// The records of a sweep.
#[derive(Debug)]
pub struct Sweep {
    /// Trials that have ended, by number.
    pub trials: Vec<TrialRecord>,
    /// Losses at rungs, by epochs and trial.
    pub rungs: Vec<Rung>,
}

/// Values that were read a short time ago.
pub struct Recent<T>(Mutex<Vec<(String, Instant, Arc<T>)>>);

impl<T> Default for Recent<T> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<T> Recent<T> {
    async fn get(
        &self,
        key: String,
        read: impl Future<Output = Result<T, Problem>>,
    ) -> Result<Arc<T>, Problem> {
        {
            let mut held = self.0.lock().expect("no holder panics");
            held.retain(|(_, at, _)| at.elapsed() < FRESH);
            if let Some((_, _, value)) = held.iter().find(|(of, _, _)| *of == key) {
                return Ok(Arc::clone(value));
            }
        }
        let value = Arc::new(read.await?);
        let mut held = self.0.lock().expect("no holder panics");
        if held.len() >= KEPT {
            held.remove(0);
        }
        held.push((key, Instant::now(), Arc::clone(&value)));
        Ok(value)
    }
}

impl Stores {
    fn models_of(&self, store: &str) -> Result<(Models, Reports), Problem> {
        let (at, prefix) = self.open_at(store)?;
        let models = Models::new(Arc::clone(&at), &prefix);
        Ok((models, Reports::new(at, &prefix)))
    }

    /// Returns the models of a store, given as in URLs.
    ///
    /// # Errors
    /// Fails if its name leads out of the named stores, or if it cannot be read.
    pub async fn models(&self, store: &str) -> Result<Arc<StoreModels>, Problem> {
        let (models, _) = self.models_of(store)?;
        let read = async {
            let names = models.names().await?;
            let more = names.len().saturating_sub(MOST);
            let listed = stream::iter(names.into_iter().take(MOST))
                .map(|name| listed(&models, name))
                .buffered(AT_ONCE);
            let all: Vec<Listed> = listed.try_collect().await?;
            let sweeps = all.iter().filter(|model| !model.sweeps.is_empty());
            let sweeps: Vec<String> = sweeps.map(|model| model.name.clone()).collect();
            let (trials, listed): (Vec<_>, Vec<_>) = all
                .into_iter()
                // A folder may have only notes, or objects of a training that was killed.
                .filter(|m| m.manifest.is_some() || m.step.is_some() || !m.sweeps.is_empty())
                .partition(|model| is_trial(&model.name, &sweeps));
            Ok(StoreModels {
                models: listed,
                trials: trials.len(),
                more,
            })
        };
        self.recent_models.get(store.to_owned(), read).await
    }

    /// Returns a model that has been trained to its end.
    ///
    /// # Errors
    /// Fails if there is none of this name, or if it cannot be read.
    pub async fn model(&self, store: &str, name: &str) -> Result<Model, Problem> {
        let (models, _) = self.models_of(store)?;
        // It also checks the name.
        let sweeps = models.sweeps(name).await?;
        let Some(manifest) = models.look(name).await? else {
            let what = format!("name: this store has no finished model {name:?}");
            return Err(Problem::missing(what));
        };
        let history = models.read(&manifest, "history.jsonl").await;
        let history = history.map_err(|e| e.to_string()).and_then(|bytes| {
            let lines = bytes.split(|byte| *byte == b'\n').filter(|l| !l.is_empty());
            let lines = lines.map(serde_json::from_slice);
            let lines: serde_json::Result<Vec<Value>> = lines.collect();
            lines.map_err(|e| format!("history.jsonl: {e}"))
        });
        let sha256 = manifest.sha256();
        let mut evaluations = models.evaluations(name).await?;
        evaluations.retain(|evaluation| evaluation.model_sha256 == sha256);
        evaluations.sort_by_key(|evaluation| std::cmp::Reverse(evaluation.scenes));
        Ok(Model {
            history,
            sha256,
            evaluations,
            reports: models.reports_of(name).await?,
            sweeps: sweeps.into_iter().collect(),
            manifest,
        })
    }

    /// Returns the records of a sweep.
    ///
    /// # Errors
    /// Fails if there is no such sweep, or if its records cannot be read.
    pub async fn sweep(&self, store: &str, name: &str, id: &str) -> Result<Arc<Sweep>, Problem> {
        let (models, _) = self.models_of(store)?;
        let read = async {
            let (trials, rungs) = models.trials(name, id).await?;
            match trials.is_empty() && rungs.is_empty() {
                true => Err(Problem::missing(format!(
                    "no trial of a sweep {name:?} with the id {id:?} has reported anything"
                ))),
                false => Ok(Sweep { trials, rungs }),
            }
        };
        let key = format!("{store}/{name}/{id}");
        self.recent_sweeps.get(key, read).await
    }

    /// Returns the page of a report.
    ///
    /// # Errors
    /// Fails if there is no such report, or if it cannot be read.
    pub async fn report(&self, store: &str, name: &str) -> Result<Bytes, Problem> {
        let (_, reports) = self.models_of(store)?;
        match reports.look(name).await? {
            Some(manifest) => Ok(reports.read(&manifest, "report.html").await?),
            None => {
                let what = format!("name: this store has no report {name:?}");
                Err(Problem::missing(what))
            }
        }
    }
}

/// Returns whether a model is a trial of one of the sweeps: it has the sweep's name and a number.
fn is_trial(name: &str, sweeps: &[String]) -> bool {
    name.rsplit_once('.').is_some_and(|(sweep, number)| {
        number.bytes().all(|b| b.is_ascii_digit()) && sweeps.iter().any(|other| other == sweep)
    })
}

async fn listed(models: &Models, name: String) -> Result<Listed, StorageError> {
    let sweeps = models.sweeps(&name).await?.into_iter().collect();
    let manifest = models.look(&name).await?;
    let (mut verdict, mut step) = (None, None);
    match &manifest {
        Some(manifest) => {
            let sha256 = manifest.sha256();
            let mut evaluations = models.evaluations(&name).await?;
            evaluations.retain(|evaluation| evaluation.model_sha256 == sha256);
            let largest = evaluations.iter().max_by_key(|e| e.scenes);
            verdict = largest.map(|e| Verdict::of_evaluation(&manifest.kind, &e.metrics));
        }
        None => {
            let checkpoints = models.checkpoints(&name).await?;
            let whole = checkpoints.iter().filter(|c| c.finished);
            step = whole.map(|checkpoint| checkpoint.step).max();
        }
    }
    Ok(Listed {
        name,
        manifest,
        verdict,
        step,
        sweeps,
    })
}

#[cfg(test)]
mod tests {
    use super::is_trial;

    #[test]
    fn trials_are_models_of_a_sweeps_name_with_a_number() {
        let sweeps = ["depth".to_owned()];
        assert!(is_trial("depth.0", &sweeps) && is_trial("depth.26", &sweeps));
        for other in ["depth", "depth.a", "shadow.0", "depth-35", "depth.0.json"] {
            assert!(!is_trial(other, &sweeps), "{other}");
        }
    }
}
