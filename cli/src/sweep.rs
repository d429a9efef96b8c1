//! `picofarm sweep …`: records of trials.

use std::{collections::BTreeMap, fs, path::Path, time::SystemTime};

use picofarm_dataset::{Models, Rung, TrialEnd, TrialRecord};
use picofarm_model::{
    report::trials::{self, End, Sweep, Tried, Value, error_name},
    train::Line,
};
use picofarm_proto::show;
use serde_json::json;

use crate::{
    args::{Sweep as Command, WhichSweep},
    dataset::failed,
    error::{CliError, Code, Result, io},
    model::open,
    output::{Output, table},
};

pub async fn run(command: Command, output: Output) -> Result<()> {
    match command {
        Command::Status(which) => status(&read(&which).await?, output),
        Command::Best(which) => best(&which, &read(&which).await?, output)?,
        Command::Report { which, out } => report(&read(&which).await?, &out, output)?,
        Command::Export { which, out, curves } => {
            export(&read(&which).await?, &out, curves, output)?;
        }
    }
    Ok(())
}

fn status(sweep: &Sweep, output: Output) {
    output.result(sweep, || {
        let parameters = sweep.parameters();
        let mut header = vec!["trial", "end", "epochs", &*sweep.error];
        header.extend(&parameters);
        let mut rows = vec![header.into_iter().map(str::to_owned).collect::<Vec<_>>()];
        for trial in &sweep.trials {
            let mut row = vec![
                trial.index.to_string(),
                trial.end.name().to_owned(),
                trial.epochs.to_string(),
                loss(trial),
            ];
            for name in &parameters {
                let value = trial.values.iter().find(|(other, _)| other == name);
                row.push(value.map_or_else(|| "-".into(), |(_, value)| value.text()));
            }
            rows.push(row);
        }
        format!("{}{}\n", table(&rows), sweep.summary())
    });
}

fn best(which: &WhichSweep, sweep: &Sweep, output: Output) -> Result<()> {
    let Some(best) = sweep.best() else {
        let what = format!("no trial of {:?} has come to its end yet", sweep.name);
        return Err(CliError::new(Code::Failed, what).hint(sweep.summary()));
    };
    output.result(best, || {
        let values = best.values.iter();
        let values: Vec<String> = values.map(|(n, v)| format!("{n} = {}", v.text())).collect();
        format!(
            "{}: {} {}, {}\nlook at it with `picofarm model show {} {}`\n",
            show::line(&best.model),
            show::line(&sweep.error),
            loss(best),
            show::line(&values.join(", ")),
            show::argument(&which.store),
            show::argument(&best.model)
        )
    });
    Ok(())
}

fn report(sweep: &Sweep, out: &Path, output: Output) -> Result<()> {
    let date = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    let sweep = Sweep {
        date: date[..10].to_owned(),
        ..sweep.clone()
    };
    let beside = out.with_extension("json");
    let mut document = serde_json::to_string_pretty(&sweep).expect("plain data");
    document.push('\n');
    for (path, text) in [(out, trials::html(&sweep)), (&beside, document)] {
        fs::write(path, text).map_err(|e| io(path.display(), &e))?;
    }
    let facts = json!({"page": out, "json": beside, "trials": sweep.trials.len()});
    output.result(&facts, || {
        format!(
            "{}\n{} and {}\n",
            sweep.summary(),
            out.display(),
            beside.display()
        )
    });
    Ok(())
}

fn export(sweep: &Sweep, out: &Path, curves: bool, output: Output) -> Result<()> {
    let rows = match curves {
        true => epochs(sweep),
        false => trials(sweep),
    };
    let text: String = rows.iter().map(|row| csv(row)).collect();
    fs::write(out, text).map_err(|e| io(out.display(), &e))?;
    let facts = json!({"csv": out, "rows": rows.len() - 1});
    output.result(&facts, || {
        format!("{} rows in {}\n", rows.len() - 1, out.display())
    });
    Ok(())
}

/// A row for each trial.
fn trials(sweep: &Sweep) -> Vec<Vec<String>> {
    let parameters = sweep.parameters();
    let mut header = ["trial", "model", "end", "epochs", &sweep.error]
        .map(str::to_owned)
        .to_vec();
    header.extend(parameters.iter().map(|name| (*name).to_owned()));
    let row = |trial: &Tried| {
        let mut row = vec![
            trial.index.to_string(),
            trial.model.clone(),
            trial.end.name().to_owned(),
            trial.epochs.to_string(),
            number(trial.loss),
        ];
        for name in &parameters {
            let value = trial.values.iter().find(|(other, _)| other == name);
            row.push(value.map_or_else(String::new, |(_, value)| match value {
                Value::Number(value) => value.to_string(),
                Value::Text(text) => text.clone(),
            }));
        }
        row
    };
    std::iter::once(header)
        .chain(sweep.trials.iter().map(row))
        .collect()
}

/// A row for each epoch of each trial that ended.
fn epochs(sweep: &Sweep) -> Vec<Vec<String>> {
    let header = [
        "trial",
        "epoch",
        "step",
        "loss",
        "learning_rate",
        &sweep.error,
    ];
    let mut rows = vec![header.map(str::to_owned).to_vec()];
    for trial in &sweep.trials {
        rows.extend(trial.history.iter().map(|line| {
            vec![
                trial.index.to_string(),
                line.epoch.to_string(),
                line.step.to_string(),
                line.loss.to_string(),
                line.learning_rate.to_string(),
                number(line.validation.map(|found| found.loss())),
            ]
        }));
    }
    rows
}

/// A number with all its digits; empty where there is none.
fn number(value: Option<f64>) -> String {
    value.map_or_else(String::new, |value| value.to_string())
}

/// A line of CSV (RFC 4180).
fn csv(row: &[String]) -> String {
    let cell = |text: &String| match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.clone(),
    };
    let cells: Vec<String> = row.iter().map(cell).collect();
    format!("{}\r\n", cells.join(","))
}

/// The records of a sweep's trials.
async fn read(which: &WhichSweep) -> Result<Sweep> {
    let models = open(&which.store)?;
    let id = the_one(&models, which).await?;
    let found = models.trials(&which.name, &id).await;
    let (ended, rungs) = found.map_err(failed)?;
    let kind = ended.first().map(|trial| trial.kind.clone());
    let mut all: BTreeMap<u64, Tried> = BTreeMap::new();
    // Rungs come in order: the last that a trial has reached counts.
    for rung in rungs {
        all.insert(rung.index, open_trial(which, &rung));
    }
    for trial in ended {
        all.insert(trial.index, ended_trial(trial)?);
    }
    Ok(Sweep {
        name: which.name.clone(),
        date: String::new(),
        error: kind
            .map_or("validation loss", |kind| error_name(&kind))
            .to_owned(),
        trials: all.into_values().collect(),
    })
}

/// The sweep that is meant.
async fn the_one(models: &Models, which: &WhichSweep) -> Result<String> {
    let name = &which.name;
    let ids = models.sweeps(name).await.map_err(failed)?;
    let mut found: Vec<String> = ids
        .into_iter()
        .filter(|id| id.starts_with(&which.id))
        .collect();
    match (found.pop(), found.is_empty()) {
        (Some(id), true) => Ok(id),
        (Some(id), false) => {
            found.push(id);
            let what = format!("there are {} sweeps called {name:?}", found.len());
            Err(CliError::input(what).hint(format!("choose one: --id {}", found.join(" | "))))
        }
        (None, _) => {
            let what = format!("no trial of a sweep called {name:?} has reported anything yet");
            Err(CliError::input(what).hint(
                "a sweep is called as the model of its stage; `picofarm job status` shows trials that run",
            ))
        }
    }
}

fn open_trial(which: &WhichSweep, rung: &Rung) -> Tried {
    Tried {
        index: rung.index,
        model: format!("{}.{}", which.name, rung.index),
        values: Vec::new(),
        end: End::Open,
        why: String::new(),
        epochs: rung.epochs,
        loss: Some(rung.loss),
        history: Vec::new(),
    }
}

fn ended_trial(trial: TrialRecord) -> Result<Tried> {
    let (end, why) = match trial.end {
        TrialEnd::Finished => (End::Finished, String::new()),
        TrialEnd::Pruned => (End::Pruned, String::new()),
        TrialEnd::Diverged(why) => (End::Diverged, why),
    };
    let lines = trial.history.into_iter().map(serde_json::from_value);
    let history: serde_json::Result<Vec<Line>> = lines.collect();
    let broken = |e| CliError::new(Code::Damaged, format!("trial {}: {e}", trial.index));
    let value = |value: serde_json::Value| match value {
        serde_json::Value::String(text) => Value::Text(text),
        other => other
            .as_f64()
            .map_or_else(|| Value::Text(other.to_string()), Value::Number),
    };
    Ok(Tried {
        index: trial.index,
        model: trial.model,
        values: trial
            .values
            .into_iter()
            .map(|(n, v)| (n, value(v)))
            .collect(),
        end,
        why,
        epochs: trial.epochs,
        loss: trial.loss,
        history: history.map_err(broken)?,
    })
}

fn loss(trial: &Tried) -> String {
    trial
        .loss
        .map_or_else(|| "-".into(), |loss| format!("{loss:.4}"))
}

#[cfg(test)]
mod tests {
    use super::csv;

    #[test]
    fn cells_of_csv_are_quoted_where_they_must_be() {
        let row = ["a", "b, c", "say \"d\"", ""].map(str::to_owned);
        assert_eq!(csv(&row), "a,\"b, c\",\"say \"\"d\"\"\",\r\n");
    }
}
