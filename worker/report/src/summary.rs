//! A summary of models: the mean and spread over the seeds of an experiment, the order of
//! experiments, and the error against the number of scenes; and the whole report as JSON.

use std::collections::BTreeMap;

use serde::Serialize;

use super::{
    Data, Entry, Published, Report, Speed,
    paper::{self, published},
};
use picofarm_model::{
    Evaluated,
    input::Target,
    metric::Metrics,
    train::{Line, Plan},
};

/// Metrics by name: `mae_m` and `rmse_m` of depths in metres; `iou`, `mae` and `f1` of masks.
pub type Figures = BTreeMap<&'static str, Spread>;

/// A metric over several runs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// The standard deviation over n - 1; `None` for a single run.
    pub deviation: Option<f64>,
    /// The number of runs.
    pub runs: usize,
}

/// An experiment: models that differ only in the seed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Group {
    /// The common part of its models' names.
    pub label: String,
    /// The learned quantity.
    pub target: Target,
    /// The indices of its models in the report.
    pub models: Vec<usize>,
    /// The seeds, each once.
    pub seeds: Vec<u64>,
    /// The metrics of the evaluated models; empty if none was evaluated.
    pub figures: Figures,
    /// The metrics of trivial answers on the same scenes, by name.
    pub baselines: BTreeMap<String, Figures>,
    /// The trivial answer with the least error, and the ratio of this experiment's error to it:
    /// depth MAE, or 1 - IoU.
    pub beside_best_baseline: Option<(String, f64)>,
    /// The 10, 50 and 90 % quantiles of the error of single scenes.
    pub scene_errors: Option<[f64; 3]>,
    /// The published metrics of the same experiment, if its size is the paper's.
    pub published: Option<Published>,
    /// The published metrics of the experiment at the paper's size, for comparing orders.
    pub repeats: Option<Published>,
    /// The settings of size in which it differs from the paper.
    pub unlike: Vec<String>,
    /// Training examples per second.
    pub samples_per_s: Option<Spread>,
    /// The error of the evaluated models: depth MAE in metres, or 1 - IoU.
    pub error: Option<Spread>,
}

/// A comparison of the order of experiments with the published one.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Order {
    /// The target of the experiments.
    pub target: Target,
    /// The number of pairs of experiments that have a metric here and a published one.
    pub pairs: usize,
    /// The number of pairs in the published order.
    pub kept: usize,
    /// The pairs in the opposite order: the better experiment here, then the worse. Pairs with
    /// equal metrics are not counted in either order.
    pub turned: Vec<[String; 2]>,
    /// The number of pairs with a difference of metrics below the spread of their seeds, √(s₁² +
    /// s₂²).
    pub close: usize,
}

/// Models that differ only in the number of training scenes (and in the seed).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scaling {
    /// The common part of their names.
    pub label: String,
    /// The learned quantity.
    pub target: Target,
    /// The number of scenes and the error, ascending.
    pub points: Vec<(u64, Spread)>,
}

/// The summary of a report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// The experiments, by target, then in the report's order.
    pub groups: Vec<Group>,
    /// The comparisons of orders, if there are two experiments to compare.
    pub orders: Vec<Order>,
    /// The error against the number of scenes.
    pub scalings: Vec<Scaling>,
}

pub(super) const TARGETS: [Target; 3] = [Target::Tof, Target::Shadow, Target::Specular];

impl Spread {
    /// Returns the spread of values, or `None` if there are none.
    pub fn from_values(values: &[f64]) -> Option<Self> {
        let (first, n) = (*values.first()?, values.len() as f64);
        // Relative to the first value: equal values then have no deviation from rounding.
        let mean = first + values.iter().map(|v| v - first).sum::<f64>() / n;
        let squares: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
        Some(Self {
            mean,
            deviation: (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt()),
            runs: values.len(),
        })
    }
}

/// Summarises the models of a report.
pub fn summary(report: &Report) -> Summary {
    let mut groups = Vec::new();
    for target in TARGETS {
        let same = partition(&report.models, target, |e| {
            (unseeded(e), e.data.clone(), e.conditions.clone())
        });
        groups.extend(same.into_iter().map(|models| group(report, target, models)));
    }
    tell_apart(report, &mut groups);
    let orders = TARGETS
        .into_iter()
        .filter_map(|target| order(report, target, &groups));
    Summary {
        orders: orders.collect(),
        scalings: scalings(report, &groups),
        groups,
    }
}

/// Renames experiments that share a label after their first model.
fn tell_apart(report: &Report, groups: &mut [Group]) {
    let labels: Vec<String> = groups.iter().map(|g| g.label.clone()).collect();
    for group in groups {
        if group.models.len() > 1 && labels.iter().filter(|l| **l == group.label).count() > 1 {
            group.label = format!("{} …", report.models[group.models[0]].name);
        }
    }
}

/// Groups the models of a target that have the same key, in order.
fn partition<K: PartialEq>(
    models: &[Entry],
    target: Target,
    key: impl Fn(&Entry) -> K,
) -> Vec<Vec<usize>> {
    let mut out: Vec<(K, Vec<usize>)> = Vec::new();
    for (index, entry) in models.iter().enumerate() {
        if entry.plan.question.target != target {
            continue;
        }
        let key = key(entry);
        match out.iter_mut().find(|(k, _)| *k == key) {
            Some((_, of)) => of.push(index),
            None => out.push((key, vec![index])),
        }
    }
    out.into_iter().map(|(_, of)| of).collect()
}

fn unseeded(entry: &Entry) -> Plan {
    Plan {
        seed: 0,
        ..entry.plan.clone()
    }
}

fn group(report: &Report, target: Target, models: Vec<usize>) -> Group {
    let of = || models.iter().map(|i| &report.models[*i]);
    let evaluated: Vec<&Evaluated> = of().filter_map(|e| e.evaluated.as_ref()).collect();
    let mut trivial: BTreeMap<String, Vec<Metrics>> = BTreeMap::new();
    for (name, metrics) in evaluated.iter().flat_map(|e| &e.baselines) {
        trivial.entry(name.clone()).or_default().push(*metrics);
    }
    let errors: Vec<f64> = evaluated.iter().map(|e| e.metrics.loss()).collect();
    let error = Spread::from_values(&errors);
    let of_trivial =
        |all: &[Metrics]| Spread::from_values(&all.iter().map(Metrics::loss).collect::<Vec<_>>());
    let best = trivial
        .iter()
        .filter_map(|(name, all)| Some((name.clone(), of_trivial(all)?.mean)))
        .filter(|(_, loss)| *loss > 0.0)
        .min_by(|a, b| a.1.total_cmp(&b.1));
    let mut scenes: Vec<f64> = evaluated
        .iter()
        .flat_map(|e| e.scenes.iter().map(Metrics::loss))
        .filter(|e| e.is_finite())
        .collect();
    scenes.sort_unstable_by(f64::total_cmp);
    let quantile = |q: f64| scenes[(q * (scenes.len() - 1) as f64).round() as usize];
    let mut seeds: Vec<u64> = of().map(|e| e.plan.seed).collect();
    seeds.sort_unstable();
    seeds.dedup();
    let names: Vec<&str> = of().map(|e| &*e.name).collect();
    let speeds: Vec<f64> = of()
        .filter_map(|e| e.speed.map(|s| s.samples_per_s))
        .collect();
    let first = of().next();
    let repeats = first.and_then(published);
    let unlike = match repeats {
        Some(_) => first.map(paper::unlike).unwrap_or_default(),
        None => Vec::new(),
    };
    Group {
        label: common(&names),
        target,
        seeds,
        figures: figures(evaluated.iter().map(|e| {
            let mut all = e.metrics.figures();
            all.extend(e.released.figures());
            all
        })),
        baselines: trivial
            .iter()
            .map(|(name, all)| (name.clone(), figures(all.iter().map(Metrics::figures))))
            .collect(),
        beside_best_baseline: best
            .zip(error)
            .map(|((name, loss), e)| (name, e.mean / loss)),
        scene_errors: (!scenes.is_empty()).then(|| [0.1, 0.5, 0.9].map(quantile)),
        published: repeats.filter(|_| unlike.is_empty()),
        repeats,
        unlike,
        samples_per_s: Spread::from_values(&speeds),
        error,
        models,
    }
}

/// Returns each metric over several runs.
fn figures(runs: impl Iterator<Item = Vec<(&'static str, f64)>>) -> Figures {
    let mut each: BTreeMap<&'static str, Vec<f64>> = BTreeMap::new();
    for (name, value) in runs.flatten() {
        each.entry(name).or_default().push(value);
    }
    let spreads = each
        .into_iter()
        .filter_map(|(name, values)| Some((name, Spread::from_values(&values)?)));
    spreads.collect()
}

/// Returns the common first words of names, without a trailing "seed".
fn common(names: &[&str]) -> String {
    let Some((first, others)) = names.split_first() else {
        return String::new();
    };
    if others.is_empty() {
        return (*first).to_owned();
    }
    let apart = |c: char| matches!(c, '-' | '_' | '.' | '/' | ' ' | '=' | '#' | ',');
    let words =
        |name: &str| -> Vec<String> { name.split_inclusive(apart).map(str::to_owned).collect() };
    let mut shared = words(first);
    for other in others {
        let equal = shared
            .iter()
            .zip(words(other))
            .take_while(|(a, b)| *a == b)
            .count();
        shared.truncate(equal);
    }
    let text = shared.concat();
    let text = text.trim_end_matches(apart);
    let text = text
        .strip_suffix("seed")
        .map_or(text, |t| t.trim_end_matches(apart));
    if text.is_empty() {
        return format!("{first} …");
    }
    text.to_owned()
}

fn order(report: &Report, target: Target, groups: &[Group]) -> Option<Order> {
    let known: Vec<(&Group, Spread, f64)> = groups
        .iter()
        .filter(|g| g.target == target)
        .filter_map(|g| Some((g, g.error?, g.repeats?.loss()?)))
        .filter(|(_, error, _)| error.mean.is_finite())
        .collect();
    let mut out = Order {
        target,
        pairs: 0,
        kept: 0,
        turned: Vec::new(),
        close: 0,
    };
    let scenes = |g: &Group| report.models[g.models[0]].data.scenes;
    for (i, a) in known.iter().enumerate() {
        for b in &known[i + 1..] {
            if a.2 == b.2 || scenes(a.0) != scenes(b.0) {
                continue;
            }
            let (better, worse) = if a.1.mean <= b.1.mean { (a, b) } else { (b, a) };
            let variance = |s: Spread| s.deviation.map_or(0.0, |d| d * d);
            let spread = (variance(a.1) + variance(b.1)).sqrt();
            out.pairs += 1;
            out.close += usize::from(worse.1.mean - better.1.mean <= spread);
            if better.1.mean == worse.1.mean {
                continue;
            }
            if better.2 < worse.2 {
                out.kept += 1;
            } else {
                let pair = [better.0.label.clone(), worse.0.label.clone()];
                out.turned.push(pair);
            }
        }
    }
    (out.pairs > 0).then_some(out)
}

fn scalings(report: &Report, groups: &[Group]) -> Vec<Scaling> {
    let mut out = Vec::new();
    for target in TARGETS {
        let same = partition(&report.models, target, |e| {
            let data = Data {
                scenes: None,
                ..e.data.clone()
            };
            (unseeded(e), data, e.conditions.clone())
        });
        for models in same {
            let of = groups.iter().filter(|g| models.contains(&g.models[0]));
            let points =
                of.filter_map(|g| Some((report.models[g.models[0]].data.scenes?, g.error?)));
            let mut points: Vec<_> = points.collect();
            points.sort_unstable_by_key(|(scenes, _)| *scenes);
            let names: Vec<&str> = models.iter().map(|i| &*report.models[*i].name).collect();
            if points.len() > 1 {
                out.push(Scaling {
                    label: common(&names),
                    target,
                    points,
                });
            }
        }
    }
    out
}

#[derive(Serialize)]
struct Document<'a> {
    format: &'static str,
    title: &'a str,
    date: &'a str,
    note: &'static str,
    #[serde(flatten)]
    summary: Summary,
    models: Vec<Said<'a>>,
}

#[derive(Serialize)]
struct Said<'a> {
    name: &'a str,
    plan: &'a Plan,
    data: &'a Data,
    conditions: &'a [(String, String)],
    parameters: u64,
    multiply_adds: Option<f64>,
    history: &'a [Line],
    evaluated: &'a Option<Evaluated>,
    speed: &'a Option<Speed>,
    lineage: &'a [(String, String)],
    pictures: Vec<Example<'a>>,
}

#[derive(Serialize)]
struct Example<'a> {
    label: &'a str,
    metrics: &'a Metrics,
}

/// Returns the report as JSON: everything about the models, the pictures' metrics without their
/// pixels, and [`summary`]. A non-finite metric is null.
pub fn json(report: &Report) -> String {
    let document = Document {
        format: "picofarm-model-report-1",
        title: &report.title,
        date: &report.date,
        note: paper::NOTE,
        summary: summary(report),
        models: report.models.iter().map(said).collect(),
    };
    serde_json::to_string_pretty(&document).expect("plain data")
}

fn said(entry: &Entry) -> Said<'_> {
    Said {
        name: &entry.name,
        plan: &entry.plan,
        data: &entry.data,
        conditions: &entry.conditions,
        parameters: entry.parameters,
        multiply_adds: entry.multiply_adds,
        history: &entry.history,
        evaluated: &entry.evaluated,
        speed: &entry.speed,
        lineage: &entry.lineage,
        pictures: entry
            .pictures
            .iter()
            .map(|p| Example {
                label: &p.label,
                metrics: &p.metrics,
            })
            .collect(),
    }
}
