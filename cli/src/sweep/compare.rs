//! `picofarm sweep compare`: compares sweeps at equal numbers of epochs spent.

use picofarm_results::{TrialEnd, TrialRecord};
use serde::Serialize;
use serde_json::{Map, Value};

use super::records::{Records, ids, listed, loss, nothing, text};
use crate::{
    error::{CliError, Result},
    model::open,
    output::{Output, table},
};

/// Number of rows of the table, one per number of epochs.
const STEPS: u64 = 8;

/// A sweep in a comparison.
#[derive(Debug, PartialEq, Serialize)]
struct Compared {
    name: String,
    id: String,
    /// Name of the error that better trials minimise.
    error: &'static str,
    finished: usize,
    stopped: usize,
    diverged: usize,
    /// Number of trials that have reached a rung but have not ended.
    open: usize,
    /// Epochs of all trials that have ended.
    epochs: u64,
    best: Option<Best>,
    /// The lowest error of the finished trials after a total number of epochs. Trials are taken in
    /// the order of their numbers, as one worker would have run them.
    course: Vec<(u64, f64)>,
}

/// The best of the finished trials.
#[derive(Debug, PartialEq, Serialize)]
struct Best {
    model: String,
    loss: f64,
    values: Map<String, Value>,
}

/// Compares the sweeps of these names. `NAME/ID` selects one of several.
pub async fn run(store: &str, names: &[String], output: Output) -> Result<()> {
    let models = open(store)?;
    let mut compared: Vec<Compared> = Vec::new();
    for name in names {
        let (name, id) = name.split_once('/').unwrap_or((name, ""));
        let ids = ids(&models, name, id).await?;
        if ids.is_empty() {
            return Err(nothing(name));
        }
        for id in ids {
            if !compared
                .iter()
                .any(|other| other.id == id && other.name == name)
            {
                compared.push(of(&Records::of(&models, name, id).await?));
            }
        }
    }
    if compared.len() < 2 {
        let what = format!(
            "there is one sweep called {:?}, and nothing to compare it with",
            names[0]
        );
        return Err(
            CliError::input(what).hint("name another: `picofarm sweep compare STORE ONE OTHER`")
        );
    }
    output.result(&compared, || described(&compared));
    Ok(())
}

fn of(records: &Records) -> Compared {
    let count = |end: fn(&TrialEnd) -> bool| records.ended.iter().filter(|t| end(&t.end)).count();
    let mut open: Vec<u64> = records.rungs.iter().map(|rung| rung.index).collect();
    open.sort_unstable();
    open.dedup();
    open.retain(|index| !records.ended.iter().any(|t| t.index == *index));
    let (mut epochs, mut best, mut course): (u64, Option<(&TrialRecord, f64)>, _) =
        (0, None, Vec::new());
    for trial in &records.ended {
        epochs += trial.epochs;
        if let (TrialEnd::Finished, Some(loss)) = (&trial.end, trial.loss)
            && best.is_none_or(|(_, least)| loss < least)
        {
            best = Some((trial, loss));
            course.push((epochs, loss));
        }
    }
    Compared {
        name: records.name.clone(),
        id: records.id.clone(),
        error: records.error(),
        finished: count(|end| *end == TrialEnd::Finished),
        stopped: count(|end| *end == TrialEnd::Pruned),
        diverged: count(|end| matches!(end, TrialEnd::Diverged(_))),
        open: open.len(),
        epochs,
        best: best.map(|(trial, loss)| Best {
            model: trial.model.clone(),
            loss,
            values: trial.values.clone().into_iter().collect(),
        }),
        course,
    }
}

/// Returns the lowest error after a total number of epochs.
fn after(sweep: &Compared, epochs: u64) -> Option<f64> {
    let there = sweep
        .course
        .iter()
        .take_while(|(spent, _)| *spent <= epochs);
    there.last().map(|(_, loss)| *loss)
}

fn described(sweeps: &[Compared]) -> String {
    let header = [
        "sweep", "id", "finished", "stopped", "diverged", "open", "epochs", "best", "error",
        "values",
    ];
    let mut rows = vec![header.map(str::to_owned).to_vec()];
    for sweep in sweeps {
        let best = sweep.best.as_ref();
        rows.push(vec![
            sweep.name.clone(),
            sweep.id.clone(),
            sweep.finished.to_string(),
            sweep.stopped.to_string(),
            sweep.diverged.to_string(),
            sweep.open.to_string(),
            sweep.epochs.to_string(),
            best.map_or_else(|| "-".into(), |best| best.model.clone()),
            format!("{} {}", loss(best.map(|best| best.loss)), sweep.error),
            best.map_or_else(String::new, |best| {
                listed(best.values.iter().map(|(n, v)| (n, text(v))))
            }),
        ]);
    }
    let mut header = vec!["epochs spent".to_owned()];
    header.extend(
        sweeps
            .iter()
            .map(|s| format!("{}/{}", s.name, &s.id[..s.id.len().min(6)])),
    );
    let most = sweeps.iter().map(|sweep| sweep.epochs).max().unwrap_or(0);
    let mut course = vec![header];
    for step in 1..=STEPS.min(most) {
        let epochs = most * step / STEPS.min(most);
        let mut row = vec![epochs.to_string()];
        row.extend(sweeps.iter().map(|sweep| match epochs <= sweep.epochs {
            true => loss(after(sweep, epochs)),
            // The sweep has not spent that many epochs.
            false => String::new(),
        }));
        course.push(row);
    }
    format!(
        "{}\nleast error after so many epochs in all, trials in the order of their numbers:\n{}",
        table(&rows),
        table(&course)
    )
}

#[cfg(test)]
mod tests {
    use super::{
        super::records::tests::{record, records},
        *,
    };

    #[test]
    fn a_sweep_is_counted_and_its_best_followed_by_epochs_spent() {
        let diverged = || TrialEnd::Diverged("x".into());
        let found = of(&records(vec![
            record(0, 1e-2, TrialEnd::Finished, &[0.9, 0.5, 0.4]),
            record(1, 1e-3, TrialEnd::Pruned, &[0.1]),
            record(2, 2e-2, TrialEnd::Finished, &[0.9, 0.5, 0.5]),
            record(3, 1e-1, diverged(), &[0.8]),
            record(5, 3e-2, TrialEnd::Finished, &[0.9, 0.4, 0.25]),
        ]));
        assert_eq!(
            (found.finished, found.stopped, found.diverged, found.open),
            (3, 1, 1, 0)
        );
        assert_eq!(found.epochs, 11);
        assert_eq!(found.course, [(3, 0.4), (11, 0.25)]);
        assert_eq!(found.best.as_ref().map(|best| &*best.model), Some("m.5"));
        assert_eq!(
            [after(&found, 2), after(&found, 10), after(&found, 11)],
            [None, Some(0.4), Some(0.25)]
        );
        let other = of(&records(vec![record(0, 1e-2, TrialEnd::Finished, &[0.3])]));
        let text = described(&[found, other]);
        assert!(text.contains("m.5") && text.contains("lr = 0.03"), "{text}");
        // The other sweep has spent one epoch; its later results are unknown.
        assert!(
            text.contains("\n1             -         0.3000\n"),
            "{text}"
        );
        assert!(text.contains("\n11            0.2500\n"), "{text}");
    }
}
