//! A sweep as a page: its trials from the best to the worst, their progress over epochs, and the
//! error by each parameter's values.

use std::fmt::Write;

use picofarm_figures::STYLE;
use serde::{Deserialize, Serialize};

use super::{
    chart::{Axis, Series, chart, legend},
    number::{digits, short},
    text::Safe,
};
use picofarm_model::{
    metric::Metrics,
    train::{Line, epochs_at},
};

/// The error of own trainings: the loss of their histories, which the job file defines.
const OBJECTIVE: &str = "objective";

/// A sweep.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sweep {
    /// The sweep's name, which is also the prefix of its models' names.
    pub name: String,
    /// The date of the page, in the form to be shown.
    pub date: String,
    /// The name of the error, with its unit; a smaller error is better.
    pub error: String,
    /// The trials, by number.
    pub trials: Vec<Tried>,
}

/// A trial of a sweep.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tried {
    /// The trial's number.
    pub index: u64,
    /// The model's name.
    pub model: String,
    /// The values, by parameter.
    pub values: Vec<(String, Value)>,
    /// The trial's outcome.
    pub end: End,
    /// The reason for the outcome, if it requires one.
    #[serde(default)]
    pub why: String,
    /// The number of finished epochs.
    pub epochs: u64,
    /// The error at the end, or at the last rung that the trial reached.
    pub loss: Option<f64>,
    /// A line for each epoch, once the trial has ended.
    #[serde(default)]
    pub history: Vec<Line>,
}

/// A parameter's value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Value {
    /// A number.
    Number(f64),
    /// Anything else, as text.
    Text(String),
}

/// The outcome of a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum End {
    /// The trial finished.
    Finished,
    /// The trial was stopped at a rung because it was behind.
    Pruned,
    /// The trial produced NaN or infinite values.
    Diverged,
    /// The trial has not ended; it may not be running.
    Open,
}

impl End {
    /// Returns a word for the outcome.
    pub fn name(self) -> &'static str {
        match self {
            Self::Finished => "finished",
            Self::Pruned => "stopped",
            Self::Diverged => "diverged",
            Self::Open => "open",
        }
    }

    fn style(self) -> usize {
        match self {
            Self::Finished => 0,
            Self::Pruned => 7,
            Self::Diverged => 6,
            Self::Open => 4,
        }
    }
}

const ENDS: [End; 4] = [End::Finished, End::Pruned, End::Diverged, End::Open];

impl Sweep {
    /// Returns whether its trials run the user's own code, which reports only its objective.
    pub fn own(&self) -> bool {
        self.error == OBJECTIVE
    }

    /// Returns the error at a line of a trial's history; `None` if nothing was measured there.
    pub fn error_at(&self, line: &Line) -> Option<f64> {
        match self.own() {
            true => Some(line.loss),
            false => line.validation.as_ref().map(Metrics::loss),
        }
    }

    /// Returns the best of the finished trials.
    pub fn best(&self) -> Option<&Tried> {
        let finished = self.trials.iter().filter(|t| t.end == End::Finished);
        finished.filter(|t| t.loss.is_some()).min_by(|a, b| {
            a.loss
                .partial_cmp(&b.loss)
                .unwrap_or(std::cmp::Ordering::Equal)
        })
    }

    /// Returns the number of trials with this outcome.
    pub fn count(&self, end: End) -> usize {
        self.trials.iter().filter(|t| t.end == end).count()
    }

    /// Returns the names of the parameters.
    pub fn parameters(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for (name, _) in self.trials.iter().flat_map(|t| &t.values) {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        names
    }

    /// Returns a sentence with the number of trials by outcome, and the best trial.
    pub fn summary(&self) -> String {
        let ends = ENDS.map(|end| (self.count(end), end.name()));
        let ends = ends.iter().filter(|(n, _)| *n > 0);
        let ends: Vec<String> = ends.map(|(n, name)| format!("{n} {name}")).collect();
        let mut text = format!("{} trials: {}", self.trials.len(), ends.join(", "));
        if let Some(best) = self.best() {
            let _ = write!(
                text,
                "; best {} ({} {})",
                best.model,
                self.error,
                digits(best.loss.unwrap_or(f64::NAN), 4)
            );
        }
        text
    }
}

impl Tried {
    fn value(&self, parameter: &str) -> Option<&Value> {
        let named = |(name, _): &&(String, Value)| name == parameter;
        self.values.iter().find(named).map(|(_, value)| value)
    }
}

impl Value {
    /// Returns the value in readable form.
    pub fn text(&self) -> String {
        match self {
            Self::Number(x) => format!("{x}"),
            Self::Text(text) => text.clone(),
        }
    }
}

/// Returns the page, which is self-contained.
pub fn html(sweep: &Sweep) -> String {
    let (title, date) = (Safe(&sweep.name), Safe(&sweep.date));
    let summary = sweep.summary();
    let sections = [
        ("Trials", table(sweep)),
        ("Over epochs", curves(sweep)),
        ("Parameters", parameters(sweep)),
    ];
    let sections =
        sections.map(|(name, body)| format!("<section><h2>{name}</h2>{body}</section>\n"));
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <title>Sweep {title}</title>\n<style>{STYLE}</style></head>\n<body>\
         <header><h1>Sweep {title}</h1><p class=\"note\">{date} · {}</p></header>\n<main>{}</main></body></html>\n",
        Safe(summary),
        sections.concat()
    )
}

fn table(sweep: &Sweep) -> String {
    let parameters = sweep.parameters();
    let mut order: Vec<&Tried> = sweep.trials.iter().collect();
    // Trials that went further come first, and among them the better ones.
    order.sort_by(|a, b| {
        let key = |t: &Tried| (t.loss.is_none(), std::cmp::Reverse(t.epochs));
        let loss = |t: &Tried| t.loss.unwrap_or(f64::INFINITY);
        key(a).cmp(&key(b)).then(loss(a).total_cmp(&loss(b)))
    });
    let mut out = String::from("<div class=\"wide\"><table><thead><tr><th>trial</th>");
    for name in &parameters {
        let _ = write!(out, "<th class=\"n\">{}</th>", Safe(name));
    }
    let _ = write!(
        out,
        "<th class=\"n\">epochs</th><th class=\"n\">{}</th><th>end</th></tr></thead><tbody>",
        Safe(&sweep.error)
    );
    let best = sweep.best().map(|t| t.index);
    for trial in order {
        let class = if best == Some(trial.index) {
            " class=\"main\""
        } else {
            ""
        };
        let _ = write!(out, "<tr{class}><td>{}</td>", Safe(&trial.model));
        for name in &parameters {
            let value = trial.value(name).map_or_else(|| "–".into(), Value::text);
            let _ = write!(out, "<td class=\"n\">{}</td>", Safe(value));
        }
        let loss = trial
            .loss
            .map_or_else(|| "–".into(), |loss| digits(loss, 4));
        let why = match trial.why.is_empty() {
            true => String::new(),
            false => format!(": {}", trial.why),
        };
        let _ = write!(
            out,
            "<td class=\"n\">{}</td><td class=\"n\">{loss}</td><td>{}{}</td></tr>",
            trial.epochs,
            trial.end.name(),
            Safe(why)
        );
    }
    out + "</tbody></table></div>"
}

fn curves(sweep: &Sweep) -> String {
    let lines = sweep.trials.iter().map(|trial| Series {
        label: format!("{} ({})", trial.model, trial.end.name()),
        style: trial.end.style(),
        points: epochs_at(&trial.history)
            .filter_map(|(at, line)| Some((at, sweep.error_at(line)?, 0.0)))
            .collect(),
        joined: true,
        marks: trial.history.len() == 1,
    });
    let lines: Vec<Series> = lines.collect();
    let x = axis("epoch", false);
    let losses = lines.iter().flat_map(|s| &s.points).map(|p| p.1);
    let label = match sweep.own() {
        true => OBJECTIVE.to_owned(),
        false => format!("validation {}", sweep.error),
    };
    let y = axis(&label, far_apart(losses));
    let chart = chart("Validation error", &x, &y, &lines);
    drawn(&format!("<div class=\"charts\">{chart}</div>"), sweep)
}

fn parameters(sweep: &Sweep) -> String {
    let mut out = String::from("<div class=\"charts\">");
    for name in sweep.parameters() {
        let mut series = Vec::new();
        let mut values = Vec::new();
        for end in ENDS {
            let points = sweep
                .trials
                .iter()
                .filter(|t| t.end == end)
                .filter_map(|t| match (t.value(name), t.loss) {
                    (Some(Value::Number(x)), Some(loss)) => Some((*x, loss, 0.0)),
                    _ => None,
                });
            let points: Vec<(f64, f64, f64)> = points.collect();
            values.extend(points.iter().map(|p| p.0));
            series.push(Series {
                label: end.name().into(),
                style: end.style(),
                points,
                joined: false,
                marks: true,
            });
        }
        if values.is_empty() {
            continue;
        }
        let losses = series.iter().flat_map(|s| &s.points).map(|p| p.1);
        let (x, y) = (
            axis(name, far_apart(values.iter().copied())),
            axis(&sweep.error, far_apart(losses)),
        );
        out.push_str(&chart(name, &x, &y, &series));
    }
    drawn(&(out + "</div>"), sweep)
}

/// A chart and what its colours mean.
fn drawn(chart: &str, sweep: &Sweep) -> String {
    let there = ENDS.iter().filter(|end| sweep.count(**end) > 0);
    format!(
        "{chart}{}",
        legend(there.map(|end| (end.style(), end.name())))
    )
}

fn axis(label: &str, log: bool) -> Axis<'_> {
    Axis {
        label,
        log,
        zero: false,
        write: short,
    }
}

/// Returns whether values are positive and span more than a decade.
fn far_apart(values: impl Iterator<Item = f64>) -> bool {
    let (mut low, mut high) = (f64::INFINITY, 0f64);
    for v in values {
        (low, high) = (low.min(v), high.max(v));
    }
    low > 0.0 && high > 10.0 * low
}

/// Returns the name of [`picofarm_model::metric::Metrics::loss`] for a kind of prediction.
pub fn error_name(kind: &str) -> &'static str {
    match kind {
        "tof" => "MAE (m)",
        "python" => OBJECTIVE,
        _ => "1 − IoU",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tried(index: u64, lr: f64, end: End, losses: &[f64]) -> Tried {
        let line = |(i, mae_m): (usize, &f64)| Line {
            epoch: i as u64 + 1,
            within: false,
            step: i as u64 + 1,
            loss: *mae_m,
            learning_rate: lr,
            validation: Some(Metrics::Depth {
                mae_m: *mae_m,
                rmse_m: *mae_m,
            }),
        };
        Tried {
            index,
            model: format!("<m>.{index}"),
            values: vec![
                ("lr".into(), Value::Number(lr)),
                ("net".into(), Value::Text("a<b".into())),
            ],
            end,
            why: String::new(),
            epochs: losses.len() as u64,
            loss: losses.last().copied(),
            history: losses.iter().enumerate().map(line).collect(),
        }
    }

    fn sweep() -> Sweep {
        Sweep {
            name: "m".into(),
            date: "2026-01-01".into(),
            error: error_name("tof").into(),
            trials: vec![
                tried(0, 1e-2, End::Finished, &[0.9, 0.5, 0.3]),
                tried(1, 1e-4, End::Pruned, &[0.2]),
                tried(2, 3e-2, End::Finished, &[0.9, 0.4, 0.25]),
                tried(3, 1e-1, End::Diverged, &[]),
            ],
        }
    }

    #[test]
    fn the_error_of_own_trainings_is_their_loss_and_of_others_that_of_their_validation() {
        let mut line = tried(0, 0.1, End::Finished, &[3.0]).history[0];
        let sweep = |error: &str| Sweep {
            error: error.into(),
            ..Sweep::default()
        };
        assert_eq!(sweep("MAE (m)").error_at(&line), Some(3.0));
        (line.loss, line.validation) = (7.0, None);
        assert_eq!(sweep("MAE (m)").error_at(&line), None);
        assert_eq!(sweep(error_name("python")).error_at(&line), Some(7.0));
    }

    #[test]
    fn the_best_is_the_best_of_those_that_came_to_their_end() {
        let sweep = sweep();
        assert_eq!(sweep.best().map(|t| t.index), Some(2));
        assert_eq!(
            sweep.summary(),
            "4 trials: 2 finished, 1 stopped, 1 diverged; best <m>.2 (MAE (m) 0.2500)"
        );
    }

    #[test]
    fn a_page_lists_all_trials_best_first_and_nothing_becomes_markup() {
        let page = html(&sweep());
        let place = |name: &str| page.find(&format!("<td>&lt;m&gt;.{name}</td>")).unwrap();
        assert!(place("2") < place("0") && place("0") < place("1") && place("1") < place("3"));
        assert!(page.contains("a&lt;b") && !page.contains("<m>"));
        // One chart over epochs, one for the parameter that has numbers.
        assert_eq!(
            page.matches("role=\"img\"")
                .count()
                .max(page.matches("class=\"title\"").count()),
            2
        );
    }

    #[test]
    fn a_sweep_without_trials_is_a_page_too() {
        let page = html(&Sweep::default());
        assert!(page.contains("0 trials"));
    }
}
