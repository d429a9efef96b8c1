//! The records of a sweep's trials, and their conversion for tables, pages and searches.

use std::collections::{BTreeMap, BTreeSet};

use super::search::Outcome;
use picofarm_model::train::Line;
use picofarm_report::trials::{End, Sweep, Tried as Row, Value as Shown, error_name};
use picofarm_results::{Models, Rung, TrialEnd, TrialRecord};
use serde_json::Value;

use crate::{
    args::WhichSweep,
    commands::{dataset::failed, model::open},
    error::{CliError, Code, Result},
};

/// Kind of the trials of own trainings.
const OWN: &str = "python";

/// The records of a sweep's trials.
pub struct Records {
    pub name: String,
    pub id: String,
    /// Trials that have ended, in order.
    pub ended: Vec<TrialRecord>,
    /// Losses of the trials at each rung, in order.
    pub rungs: Vec<Rung>,
}

/// Reads the records of the selected sweep.
///
/// # Errors
/// Fails if there is none, or if several match.
pub async fn read(which: &WhichSweep) -> Result<Records> {
    let models = open(&which.store)?;
    let mut ids = ids(&models, &which.name, &which.id).await?;
    match (ids.pop(), ids.is_empty()) {
        (Some(id), true) => Records::read(&models, &which.name, id).await,
        (Some(id), false) => {
            ids.push(id);
            let what = format!("there are {} sweeps called {:?}", ids.len(), which.name);
            Err(CliError::input(what).hint(format!("choose one: --id {}", ids.join(" | "))))
        }
        (None, _) => Err(nothing(&which.name)),
    }
}

/// Returns the ids that begin with `begin`, of the sweeps called `name`.
pub async fn ids(models: &Models, name: &str, begin: &str) -> Result<Vec<String>> {
    let ids: BTreeSet<String> = models.sweeps(name).await.map_err(failed)?;
    Ok(ids.into_iter().filter(|id| id.starts_with(begin)).collect())
}

/// Returns the error for a sweep without records.
pub fn nothing(name: &str) -> CliError {
    let what = format!("no trial of a sweep called {name:?} has reported anything yet");
    CliError::input(what).hint(
        "a sweep is called as the model of its stage; `picofarm job status` shows trials that run",
    )
}

impl Records {
    /// Reads all records of a sweep.
    pub async fn read(models: &Models, name: &str, id: String) -> Result<Self> {
        let (ended, rungs) = models.trials(name, &id).await.map_err(failed)?;
        Ok(Self {
            name: name.to_owned(),
            id,
            ended,
            rungs,
        })
    }

    /// Returns the name of the error that better trials minimise.
    pub fn error(&self) -> &'static str {
        let kind = self.ended.first().map(|trial| &*trial.kind);
        kind.map_or("validation loss", error_name)
    }

    /// Returns the trials for tables and pages.
    ///
    /// # Errors
    /// Fails if a line of a history cannot be read.
    pub fn sweep(&self) -> Result<Sweep> {
        let mut all: BTreeMap<u64, Row> = BTreeMap::new();
        // Rungs are in order, so the last one that a trial has reached counts.
        for rung in &self.rungs {
            all.insert(rung.index, open_trial(&self.name, rung));
        }
        for trial in &self.ended {
            all.insert(trial.index, ended_trial(trial)?);
        }
        Ok(Sweep {
            name: self.name.clone(),
            error: self.error().to_owned(),
            trials: all.into_values().collect(),
            ..Sweep::default()
        })
    }
}

/// Returns how a trial ended, for searches.
pub fn outcome(trial: &TrialRecord) -> Outcome {
    match (&trial.end, trial.loss) {
        (TrialEnd::Finished, Some(loss)) if loss.is_finite() => Outcome::Finished(loss),
        (TrialEnd::Pruned, Some(loss)) if loss.is_finite() => Outcome::Stopped {
            epochs: trial.epochs,
            loss,
        },
        _ => Outcome::Failed,
    }
}

fn open_trial(sweep: &str, rung: &Rung) -> Row {
    Row {
        index: rung.index,
        model: format!("{sweep}.{}", rung.index),
        values: Vec::new(),
        end: End::Open,
        why: String::new(),
        epochs: rung.epochs,
        loss: Some(rung.loss),
        history: Vec::new(),
    }
}

fn ended_trial(trial: &TrialRecord) -> Result<Row> {
    let (end, why) = match &trial.end {
        TrialEnd::Finished => (End::Finished, String::new()),
        TrialEnd::Pruned => (End::Pruned, String::new()),
        TrialEnd::Diverged(why) => (End::Diverged, why.clone()),
    };
    let history: serde_json::Result<Vec<Line>> = match &*trial.kind {
        OWN => Ok(trial.history.iter().filter_map(own_line).collect()),
        _ => {
            let lines = trial.history.iter().cloned();
            lines.map(serde_json::from_value).collect()
        }
    };
    let broken = |e| CliError::new(Code::Damaged, format!("trial {}: {e}", trial.index));
    Ok(Row {
        index: trial.index,
        model: trial.model.clone(),
        values: trial
            .values
            .iter()
            .map(|(n, v)| (n.clone(), shown(v)))
            .collect(),
        end,
        why,
        epochs: trial.epochs,
        loss: trial.loss,
        history: history.map_err(broken)?,
    })
}

/// Returns a report of an own training that has the objective, as a line of a history.
fn own_line(report: &Value) -> Option<Line> {
    Some(Line {
        epoch: report["epoch"].as_u64().unwrap_or(0),
        within: false,
        step: report["step"].as_u64().unwrap_or(0),
        loss: report["loss"].as_f64()?,
        learning_rate: 0.0,
        validation: None,
    })
}

fn shown(value: &Value) -> Shown {
    match value {
        Value::String(text) => Shown::Text(text.clone()),
        other => other
            .as_f64()
            .map_or_else(|| Shown::Text(other.to_string()), Shown::Number),
    }
}

/// Formats a loss.
pub fn loss(loss: Option<f64>) -> String {
    loss.map_or_else(|| "-".into(), |loss| format!("{loss:.4}"))
}

/// Formats values by name.
pub fn listed<'a>(values: impl Iterator<Item = (&'a String, String)>) -> String {
    let values: Vec<String> = values
        .map(|(name, value)| format!("{name} = {value}"))
        .collect();
    values.join(", ")
}

/// Formats a value as text without quotes.
pub fn text(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

#[cfg(test)]
pub mod tests {
    use serde_json::json;

    use super::*;

    /// Creates a trial with one parameter, of a sweep called `m`.
    pub fn record(index: u64, lr: f64, end: TrialEnd, losses: &[f64]) -> TrialRecord {
        let line = |(i, mae): (usize, &f64)| json!({"epoch": i + 1, "step": i + 1, "loss": mae, "learning_rate": lr, "validation": {"mae_m": mae, "rmse_m": mae}});
        TrialRecord {
            sweep: "m".into(),
            id: "0123456789abcdef".into(),
            index,
            values: [("lr".to_owned(), json!(lr))].into(),
            over: [("lr".to_owned(), json!({"log": [1e-4, 1e-1]}))].into(),
            model: format!("m.{index}"),
            kind: "tof".into(),
            training_key: "k".into(),
            end,
            epochs: losses.len() as u64,
            loss: losses.last().copied(),
            history: losses.iter().enumerate().map(line).collect(),
        }
    }

    pub fn records(ended: Vec<TrialRecord>) -> Records {
        Records {
            name: "m".into(),
            id: "0123456789abcdef".into(),
            ended,
            rungs: Vec::new(),
        }
    }

    #[test]
    fn a_trial_that_broke_has_failed_for_a_search() {
        let outcomes: Vec<Outcome> = [
            record(0, 1e-3, TrialEnd::Finished, &[0.5]),
            record(1, 1e-3, TrialEnd::Pruned, &[0.7, 0.6]),
            record(2, 1e-3, TrialEnd::Diverged("x".into()), &[0.4]),
            record(3, 1e-3, TrialEnd::Pruned, &[]),
        ]
        .iter()
        .map(outcome)
        .collect();
        assert_eq!(
            outcomes,
            [
                Outcome::Finished(0.5),
                Outcome::Stopped {
                    epochs: 2,
                    loss: 0.6
                },
                Outcome::Failed,
                Outcome::Failed
            ]
        );
    }
}
