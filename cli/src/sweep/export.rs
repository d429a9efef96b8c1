//! `picofarm sweep export`: exports trials as CSV or as TensorBoard event files.

use std::{fs, path::Path};

use picofarm_dataset::TrialEnd;
use picofarm_model::report::trials::{Sweep, Tried, Value};
use picofarm_proto::model::{Domain, Interval};
use serde_json::json;

use super::records::Records;
use crate::{
    error::{Result, io},
    output::Output,
    tensorboard::{Ended, Parameter, Run},
};

/// Writes a row for each trial, or with `curves` for each epoch of each trial.
pub fn as_csv(records: &Records, out: &Path, curves: bool, output: Output) -> Result<()> {
    let sweep = &records.sweep()?;
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

/// Writes a folder for each trial that has ended, and the data for the HPARAMS tab.
pub fn as_tensorboard(records: &Records, out: &Path, output: Output) -> Result<()> {
    let mut all = Run::default();
    let space = records.space()?;
    let parameters: Vec<Parameter> = space.into_iter().map(parameter).collect();
    all.experiment(&parameters, ("error", records.error()));
    all.write(out)?;
    for trial in &records.ended {
        let mut run = Run::default();
        let ended = match trial.end {
            TrialEnd::Finished | TrialEnd::Pruned => Ended::Well,
            TrialEnd::Diverged(_) => Ended::Badly,
        };
        run.trial(&trial.model, trial.values.iter(), ended);
        trial.history.iter().for_each(|line| run.line(line));
        let last = trial.history.last().and_then(|line| line["step"].as_i64());
        if let Some(loss) = trial.loss {
            run.scalar(last.unwrap_or(0), "error", loss);
        }
        run.write(&out.join(&trial.model))?;
    }
    let facts = json!({"tensorboard": out, "runs": records.ended.len()});
    output.result(&facts, || {
        format!(
            "{} runs in {}\nlook at them with: tensorboard --logdir {}\n",
            records.ended.len(),
            out.display(),
            picofarm_proto::show::argument(&out.display().to_string())
        )
    });
    Ok(())
}

fn parameter((name, domain): (String, Domain)) -> Parameter {
    let (interval, listed) = match domain {
        Domain::OneOf(list) => (None, list),
        Domain::Within(Interval::Range(ends) | Interval::Log(ends)) => (Some(ends), Vec::new()),
        Domain::Within(Interval::Int(ends)) => (Some(ends.map(|n| n as f64)), Vec::new()),
    };
    Parameter {
        name,
        interval,
        listed,
    }
}

/// Returns a row for each trial.
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

/// Returns a row for each line in the history of each trial that has ended: its epochs, and
/// validations within them.
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

/// Formats a number with all its digits; empty if there is none.
fn number(value: Option<f64>) -> String {
    value.map_or_else(String::new, |value| value.to_string())
}

/// Formats a line of CSV (RFC 4180).
fn csv(row: &[String]) -> String {
    let cell = |text: &String| match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.clone(),
    };
    let cells: Vec<String> = row.iter().map(cell).collect();
    format!("{}\r\n", cells.join(","))
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
