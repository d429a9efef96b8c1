//! `picofarm sweep export`: trials as CSV.

use std::{fs, path::Path};

use picofarm_report::trials::{Sweep, Tried, Value};
use serde_json::json;

use crate::{
    error::{Result, io},
    output::Output,
};

/// Writes a row for each trial or, with `curves`, for each epoch of each.
pub fn run(sweep: &Sweep, out: &Path, curves: bool, output: Output) -> Result<()> {
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

/// Returns a row for each line in the history of each trial that has ended: its epochs, and
/// validations within them.
fn epochs(sweep: &Sweep) -> Vec<Vec<String>> {
    let mut header = vec!["trial", "epoch", "step"];
    if !sweep.own() {
        header.extend(["loss", "learning_rate"]);
    }
    header.push(&sweep.error);
    let mut rows = vec![header.into_iter().map(str::to_owned).collect()];
    for trial in &sweep.trials {
        rows.extend(trial.history.iter().map(|line| {
            let mut row = vec![
                trial.index.to_string(),
                line.epoch.to_string(),
                line.step.to_string(),
            ];
            if !sweep.own() {
                row.extend([line.loss.to_string(), line.learning_rate.to_string()]);
            }
            row.push(number(sweep.error_at(line)));
            row
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
