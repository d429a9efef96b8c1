//! A sweep: its trials as curves, as parallel coordinates, and in a table with the reason why each
//! ended.

use std::collections::{BTreeMap, BTreeSet};

use maud::{Markup, html};
use picofarm_figures::number::short as short_number;
use picofarm_results::{Rung, TrialEnd, TrialRecord};
use serde_json::Value;

use super::{
    super::{
        Page,
        chart::{Coordinate, Series, lines, parallel},
        parts::{badge, safe, scroll},
    },
    model_path, named, plain, short, validation_loss,
};
use crate::{
    App,
    answer::Problem,
    data::Sweep,
    query::{Query, encode},
};

/// The path of a sweep's page.
pub fn path(store: &str, name: &str, id: &str) -> String {
    let query = encode(&[("store", store), ("name", name), ("id", id)]);
    format!("/models/sweep?{query}")
}

/// A trial, ended or not.
struct Trial<'a> {
    index: u64,
    record: Option<&'a TrialRecord>,
    epochs: u64,
    loss: Option<f64>,
    /// Losses by epoch.
    curve: Vec<(f64, f64)>,
}

impl<'a> Trial<'a> {
    fn value(&self, name: &str) -> Option<&'a Value> {
        self.record.and_then(|record| record.values.get(name))
    }

    fn badge(&self) -> (&'static str, &'static str) {
        match self.record.map(|record| &record.end) {
            None => ("open", "run"),
            Some(TrialEnd::Finished) => ("finished", "done"),
            Some(TrialEnd::Pruned) => ("stopped", "off"),
            Some(TrialEnd::Diverged(_)) => ("diverged", "bad"),
        }
    }
}

/// Returns the page of a sweep.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let (store, name) = named(query)?;
    let id = query.text("id");
    let sweep = app.stores.sweep(store, name, id).await?;
    let mut trials = trials(&sweep);
    let names: BTreeSet<&str> = sweep
        .trials
        .iter()
        .flat_map(|trial| trial.values.keys().map(String::as_str))
        .collect();
    let sort = query.text("sort");
    order(&mut trials, sort, &names)?;
    let best = best(&trials).map(|trial| (trial.index, trial.loss));
    let link = |sort: &str| format!("{}&{}", path(store, name, id), encode(&[("sort", sort)]));
    let count = |word: &str| trials.iter().filter(|t| t.badge().0 == word).count();
    let kind = sweep.trials.first().map_or("", |trial| &*trial.kind);
    let error = match kind {
        "tof" => "validation MAE, m",
        "python" => "objective",
        _ => "validation loss",
    };
    let content = html! {
        h1 { (safe(name)) " " span.none { "sweep " code { (safe(short(id))) } } }
        section #summary { dl.line {
            @for word in ["finished", "stopped", "diverged", "open"] { div { dt { (word) } dd { (count(word)) } } }
            div { dt { "epochs" } dd { (trials.iter().map(|t| t.epochs).sum::<u64>()) } }
            @if let Some((index, loss)) = best {
                div { dt { "best" } dd { "trial " (index) ", " (figure(loss)) } }
            }
        } }
        section #curves {
            h2 { (error) " by epoch" }
            (lines("Error of each trial by epoch", ["epoch", error], &curves(&trials, best.map(|b| b.0))))
            p.legend { span.swatch.best { "best" } span.swatch.finished { "finished" } span.swatch.stopped { "stopped" }
                span.swatch.diverged { "diverged" } span.swatch.open { "open" } }
        }
        section #values {
            h2 { "Settings and error" }
            (coordinates(&trials, &names, error, best.map(|b| b.0)))
        }
        section #trials {
            h2 { "Trials" }
            (scroll("Table of trials", html! { table {
                thead { tr {
                    (head("trial", "trial", sort, &link)) th { "end" } (head("epochs", "epochs", sort, &link))
                    (head("", error, sort, &link))
                    @for name in &names { (head(name, name, sort, &link)) }
                    th { "reason" }
                } }
                tbody { @for trial in &trials { (row(store, trial, &names, &sweep.rungs)) } }
            } }))
        }
    };
    Ok(Page {
        title: format!("Sweep {name}"),
        tab: "/models",
        live: true,
        script: None,
        content,
    })
}

fn head(key: &str, text: &str, sort: &str, link: &dyn Fn(&str) -> String) -> Markup {
    html! { th.number aria-sort=[(key == sort).then_some("ascending")] { a href=(link(key)) { (safe(text)) } } }
}

fn row(store: &str, trial: &Trial, names: &BTreeSet<&str>, rungs: &[Rung]) -> Markup {
    let finished = trial
        .record
        .filter(|record| record.end == TrialEnd::Finished);
    html! { tr {
        td.number { @match finished {
            Some(record) => { a href=(model_path(store, &record.model)) { (trial.index) } }
            None => { (trial.index) }
        } }
        td { (badge(trial.badge())) }
        td.number { (trial.epochs) }
        td.number { (figure(trial.loss)) }
        @for name in names { td.number { @if let Some(value) = trial.value(name) { (safe(plain(value))) } } }
        td.message { (safe(reason(trial, rungs))) }
    } }
}

fn figure(loss: Option<f64>) -> String {
    loss.map_or_else(|| "–".into(), |loss| format!("{loss:.4}"))
}

/// The trials, by number. Rungs tell of those that have not ended.
fn trials(sweep: &Sweep) -> Vec<Trial<'_>> {
    let mut all: BTreeMap<u64, Trial> = BTreeMap::new();
    for rung in &sweep.rungs {
        let trial = all.entry(rung.index).or_insert_with(|| Trial {
            index: rung.index,
            record: None,
            epochs: 0,
            loss: None,
            curve: Vec::new(),
        });
        (trial.epochs, trial.loss) = (rung.epochs, Some(rung.loss));
        trial.curve.push((rung.epochs as f64, rung.loss));
    }
    for record in &sweep.trials {
        let lines = record.history.iter();
        let curve =
            lines.filter_map(|line| Some((line["epoch"].as_f64()?, validation_loss(line)?)));
        let trial = Trial {
            index: record.index,
            record: Some(record),
            epochs: record.epochs,
            loss: record.loss,
            curve: curve.collect(),
        };
        all.insert(record.index, trial);
    }
    all.into_values().collect()
}

/// Sorts trials by their error, or by another column.
fn order(trials: &mut [Trial], sort: &str, names: &BTreeSet<&str>) -> Result<(), Problem> {
    let last = |x: Option<f64>| x.filter(|x| !x.is_nan()).unwrap_or(f64::INFINITY);
    match sort {
        "" => trials.sort_by(|a, b| last(a.loss).total_cmp(&last(b.loss))),
        "trial" => trials.sort_by_key(|trial| trial.index),
        "epochs" => trials.sort_by_key(|trial| (trial.epochs, trial.index)),
        name if names.contains(name) => trials.sort_by(|a, b| {
            let number = |t: &Trial| last(t.value(name).and_then(Value::as_f64));
            let word = |t: &Trial| t.value(name).map(plain);
            let numbers = number(a).total_cmp(&number(b));
            numbers.then_with(|| word(a).cmp(&word(b)))
        }),
        other => {
            let names: Vec<&str> = names.iter().copied().collect();
            let what = format!(
                "sort: expected trial, epochs or one of {}, found {other:?}",
                names.join(", ")
            );
            return Err(Problem::input(what));
        }
    }
    Ok(())
}

/// The best of the finished trials.
fn best<'a, 'b>(trials: &'b [Trial<'a>]) -> Option<&'b Trial<'a>> {
    let finished = trials.iter().filter(|trial| trial.badge().0 == "finished");
    let measured = finished.filter(|trial| trial.loss.is_some_and(f64::is_finite));
    measured.min_by(|a, b| a.loss.partial_cmp(&b.loss).expect("finite"))
}

/// Why a trial ended as it did.
fn reason(trial: &Trial, rungs: &[Rung]) -> String {
    match trial.record.map(|record| &record.end) {
        None => format!("it has not ended; {} epochs are done", trial.epochs),
        Some(TrialEnd::Finished) => String::new(),
        Some(TrialEnd::Diverged(quantity)) => format!("{quantity} became infinite or no number"),
        Some(TrialEnd::Pruned) => {
            let there = rungs.iter().filter(|rung| rung.epochs == trial.epochs);
            let better = there
                .clone()
                .filter(|r| trial.loss.is_none_or(|own| r.loss < own));
            match there.clone().count() {
                0 => format!("others were better after {} epochs", trial.epochs),
                all => format!(
                    "{} of the {all} trials that reached {} epochs were better",
                    better.count(),
                    trial.epochs
                ),
            }
        }
    }
}

/// The class of a trial's lines, and how far in front they are drawn.
fn class(trial: &Trial, best: Option<u64>) -> (u8, &'static str) {
    match trial.badge().0 {
        _ if best == Some(trial.index) => (4, "best"),
        "finished" => (3, "finished"),
        "open" => (2, "open"),
        "diverged" => (1, "diverged"),
        _ => (0, "stopped"),
    }
}

fn curves(trials: &[Trial], best: Option<u64>) -> Vec<Series> {
    let mut drawn: Vec<&Trial> = trials.iter().collect();
    drawn.sort_by_key(|trial| (class(trial, best).0, trial.index));
    let series = drawn.into_iter().map(|trial| Series {
        label: format!("trial {}: {}", trial.index, figure(trial.loss)),
        class: class(trial, best).1,
        points: trial.curve.clone(),
    });
    series.collect()
}

/// Parallel coordinates of the trials that have ended: their values, and the error.
fn coordinates(trials: &[Trial], names: &BTreeSet<&str>, error: &str, best: Option<u64>) -> Markup {
    let mut ended: Vec<&Trial> = trials.iter().filter(|t| t.record.is_some()).collect();
    if ended.is_empty() {
        return html! { p.none { "No trial has ended yet." } };
    }
    ended.sort_by_key(|trial| (class(trial, best).0, trial.index));
    let mut axes: Vec<Coordinate> = names.iter().map(|name| coordinate(&ended, name)).collect();
    axes.push(Coordinate {
        name: error.to_owned(),
        words: Vec::new(),
        values: ended
            .iter()
            .map(|trial| trial.loss.filter(|l| l.is_finite()))
            .collect(),
    });
    let drawn: Vec<_> = ended
        .iter()
        .map(|trial| {
            let values = names
                .iter()
                .filter_map(|name| Some((name, trial.value(name)?)));
            let values = values.map(|(name, value)| format!("{name} = {}", plain(value)));
            let values: Vec<String> = values.collect();
            let loss = trial.loss.map(short_number).unwrap_or_else(|| "–".into());
            let text = format!("trial {}: {loss}; {}", trial.index, values.join(", "));
            (text, class(trial, best).1)
        })
        .collect();
    parallel("Settings and error of each trial", &axes, &drawn)
}

fn coordinate(trials: &[&Trial], name: &str) -> Coordinate {
    let values = || trials.iter().map(|trial| trial.value(name));
    let numeric = values().flatten().all(Value::is_number);
    let words: BTreeSet<String> = match numeric {
        true => BTreeSet::new(),
        false => values().flatten().map(plain).collect(),
    };
    let words: Vec<String> = words.into_iter().collect();
    let place = |value: &Value| match numeric {
        true => value.as_f64(),
        false => words
            .iter()
            .position(|w| *w == plain(value))
            .map(|at| at as f64),
    };
    Coordinate {
        name: name.to_owned(),
        values: values().map(|value| value.and_then(place)).collect(),
        words: words.clone(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn record(index: u64, lr: f64, end: TrialEnd, losses: &[f64]) -> TrialRecord {
        let line = |(i, mae): (usize, &f64)| json!({"epoch": i + 1, "step": i + 1, "loss": mae, "validation": {"mae_m": mae}});
        TrialRecord {
            sweep: "m".into(),
            id: "0123456789abcdef".into(),
            index,
            values: [("lr".to_owned(), json!(lr)), ("net".to_owned(), json!("u"))].into(),
            over: BTreeMap::new(),
            model: format!("m.{index}"),
            kind: "tof".into(),
            training_key: "k".into(),
            end,
            epochs: losses.len() as u64,
            loss: losses.last().copied(),
            history: losses.iter().enumerate().map(line).collect(),
        }
    }

    fn example() -> Sweep {
        let rung = |index, epochs, loss| Rung {
            index,
            epochs,
            loss,
        };
        Sweep {
            trials: vec![
                record(0, 0.01, TrialEnd::Finished, &[0.5, 0.4, 0.3]),
                record(1, 0.1, TrialEnd::Pruned, &[0.9]),
                record(2, 0.02, TrialEnd::Finished, &[0.6, 0.3, 0.2]),
                record(3, 1.0, TrialEnd::Diverged("the loss".into()), &[0.8]),
            ],
            rungs: vec![
                rung(0, 1, 0.5),
                rung(1, 1, 0.9),
                rung(2, 1, 0.6),
                rung(4, 1, 0.7),
            ],
        }
    }

    #[test]
    fn the_best_trial_is_first_and_each_end_has_its_reason() {
        let sweep = example();
        let mut trials = trials(&sweep);
        let names = BTreeSet::from(["lr", "net"]);
        order(&mut trials, "", &names).unwrap();
        let indices: Vec<u64> = trials.iter().map(|trial| trial.index).collect();
        assert_eq!(indices, [2, 0, 4, 3, 1]);
        assert_eq!(best(&trials).map(|trial| trial.index), Some(2));
        let reasons: Vec<String> = trials.iter().map(|t| reason(t, &sweep.rungs)).collect();
        assert_eq!(
            reasons,
            [
                "",
                "",
                "it has not ended; 1 epochs are done",
                "the loss became infinite or no number",
                "3 of the 4 trials that reached 1 epochs were better",
            ]
        );
        order(&mut trials, "lr", &names).unwrap();
        let indices: Vec<u64> = trials.iter().map(|trial| trial.index).collect();
        assert_eq!(indices, [0, 2, 1, 3, 4], "trials without values are last");
        let wrong = order(&mut trials, "width", &names).unwrap_err();
        assert!(wrong.message.contains("lr, net"), "{}", wrong.message);
    }

    #[test]
    fn words_have_places_on_an_axis_of_their_own() {
        let sweep = example();
        let trials = trials(&sweep);
        let ended: Vec<&Trial> = trials.iter().filter(|t| t.record.is_some()).collect();
        let net = coordinate(&ended, "net");
        assert_eq!(
            (net.words, net.values),
            (vec!["u".to_owned()], vec![Some(0.0); 4])
        );
        let lr = coordinate(&ended, "lr");
        assert_eq!(lr.values, [Some(0.01), Some(0.1), Some(0.02), Some(1.0)]);
    }
}
