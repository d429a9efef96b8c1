//! The models of the stores, and one of them. `sweep` shows trials.

mod sweep;

use std::{collections::BTreeSet, sync::Arc};

use futures::future::join_all;
use maud::{Markup, html};
use picofarm_figures::number::thousands;
use picofarm_proto::spec::kinds::{Declared as _, PythonTask};
use picofarm_results::{Evaluation, ModelManifest, Verdict};
use picofarm_store::published::Manifest as _;
use serde_json::Value;

pub use self::sweep::page as sweep;
use super::{
    Page,
    chart::{Series, lines},
    parts::{bytes, safe, scroll},
};
use crate::{
    App,
    answer::Problem,
    data::{Listed, Listing, Model, SceneId, StoreModels, flight_path},
    query::{Query, encode},
};

/// Scenes of the list of errors.
const WORST: usize = 40;

/// Returns the list of models.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let stores: Vec<String> = match query.text("store") {
        "" => app.stores.folders().await.into_iter().collect(),
        store => vec![store.to_owned()],
    };
    let read = stores.iter().map(async |store| {
        let models = app.stores.models(store).await;
        Ok::<_, Problem>((store, app.stores.place(store)?, models))
    });
    let read = join_all(read).await.into_iter();
    let read = read.collect::<Result<Vec<_>, Problem>>()?;
    let shown = |models: &Result<Arc<StoreModels>, Problem>| match models {
        Ok(models) => !models.models.is_empty(),
        Err(_) => true,
    };
    let content = html! {
        h1 { "Models" }
        @if stores.is_empty() {
            p.none { "No store is shown. Start " code { "picofarm web --store FOLDER_OR_URL" } "." }
        } @else if !read.iter().any(|(_, _, models)| shown(models)) {
            p.none { "No models. " code { "picofarm job init --kind train" } " writes a job that trains some." }
        }
        @for (store, place, models) in read.iter().filter(|(_, _, models)| shown(models)) {
            section id={ "store-" (store) } {
                h2 { (safe(place)) }
                @match models {
                    Ok(models) => { (table(store, models)) }
                    Err(problem) => { p.problem role="alert" { (safe(&problem.message)) } }
                }
            }
        }
    };
    Ok(Page {
        title: "Models".into(),
        tab: "/models",
        live: true,
        script: None,
        content,
    })
}

fn table(store: &str, models: &StoreModels) -> Markup {
    let rest = [
        (models.trials, "trials are on the pages of their sweeps."),
        (models.more, "more models are not listed."),
    ];
    let table = scroll(
        "Table of models",
        html! { table {
            thead { tr {
                th { "model" } th { "predicts" } th { "trained on" } th.number { "scenes" }
                th.number { "size" } th { "on held-out scenes" } th { "sweeps" }
            } }
            tbody { @for model in &models.models { (row(store, model)) } }
        } },
    );
    html! {
        (table)
        @for (count, what) in rest.into_iter().filter(|rest| rest.0 > 0) { p.hint { (count) " " (what) } }
    }
}

fn row(store: &str, model: &Listed) -> Markup {
    html! { tr {
        td.name {
            @match &model.manifest {
                Some(_) => { a href=(model_path(store, &model.name)) { (safe(&model.name)) } }
                None => { (safe(&model.name)) }
            }
        }
        @match &model.manifest {
            Some(manifest) => {
                td { (safe(&manifest.kind)) }
                td { (safe(&manifest.lineage.dataset)) }
                td.number { (thousands(manifest.lineage.training_scenes)) }
                td.number { (bytes(manifest.total_bytes())) }
                td.message { @match &model.verdict {
                    Some(verdict) => { (self::verdict(verdict)) }
                    None => { span.none { "not evaluated" } }
                } }
            }
            None => {
                td colspan="4" { span.none { "not finished" } }
                td { @if let Some(step) = model.step { span.none { "a checkpoint after " (thousands(step)) " steps" } } }
            }
        }
        td { @for id in &model.sweeps { a.id href=(sweep::path(store, &model.name, id)) { (safe(short(id))) } " " } }
    } }
}

/// The path of a model's page.
fn model_path(store: &str, name: &str) -> String {
    format!(
        "/models/model?{}",
        encode(&[("store", store), ("name", name)])
    )
}

/// The beginning of a long id.
fn short(id: &str) -> &str {
    id.get(..8).unwrap_or(id)
}

fn verdict(verdict: &Verdict) -> Markup {
    html! { span.doubtful[verdict.doubtful] { (safe(&verdict.text)) } }
}

/// Reads the parameters `store` and `name`.
fn named(query: &Query) -> Result<(&str, &str), Problem> {
    match (query.text("store"), query.text("name")) {
        ("", _) => Err(Problem::input("store: expected a store, found nothing")),
        (_, "") => Err(Problem::input("name: expected a name, found nothing")),
        both => Ok(both),
    }
}

/// Returns the page of a model.
pub async fn model(app: &App, query: &Query) -> Result<Page, Problem> {
    let (store, name) = named(query)?;
    let model = app.stores.model(store, name).await?;
    let listed = app.stores.list().await;
    let content = html! {
        h1 { (safe(name)) }
        (facts(store, &model))
        section #curve {
            h2 { "Learning curve" }
            @match &model.history {
                Ok(history) => { (curve(history)) }
                Err(why) => { p.problem role="alert" { (safe(why)) } }
            }
        }
        @for (i, evaluation) in model.evaluations.iter().enumerate() {
            (evaluated(&listed, store, &model.manifest, evaluation, i))
        }
        section #settings { h2 { "Settings" }
            pre.file tabindex="0" { (safe(pretty(&model.manifest.settings))) } }
    };
    Ok(Page {
        title: name.to_owned(),
        tab: "/models",
        live: false,
        script: None,
        content,
    })
}

fn facts(store: &str, model: &Model) -> Markup {
    let from = &model.manifest.lineage;
    html! {
        section #facts { dl.facts-list {
            dt { "predicts" } dd { (safe(&model.manifest.kind)) }
            dt { "data" } dd { (safe(&from.dataset)) ", " (thousands(from.training_scenes)) " scenes learnt from, "
                (thousands(from.validation_scenes)) " validated on" }
            dt { "split" } dd { (safe(&from.split.name)) " version " (from.split.version) }
            @for (name, sha256) in &from.models {
                dt { "builds on" } dd { a href=(model_path(store, name)) { (safe(name)) } " " code { (safe(short(sha256))) } }
            }
            @if let Some(promoted) = &from.promoted {
                dt { "promoted" } dd { a href=(model_path(store, &promoted.model)) { (safe(&promoted.model)) }
                    ", the best of " (promoted.finished) " that finished, of " (promoted.begun) }
            }
            @for (name, value) in model.manifest.metrics.as_object().into_iter().flatten() {
                dt { (safe(name)) } dd { (safe(plain(value))) }
            }
            @if model.manifest.kind == PythonTask::NAME {
                // The farm knows no seed of own code.
                dt { "code" } dd { (safe(&from.code)) }
            } @else {
                dt { "code, seed" } dd { (safe(&from.code)) ", " (from.seed) }
            }
            dt { "manifest" } dd { code { "SHA-256 " (model.sha256) } }
            dt { "size" } dd { (bytes(model.manifest.total_bytes())) }
            @if !model.sweeps.is_empty() { dt { "sweeps" } dd {
                @for id in &model.sweeps { a.id href=(sweep::path(store, &model.manifest.name, id)) { (safe(short(id))) } " " }
            } }
            @if !model.reports.is_empty() { dt { "reports" } dd {
                @for report in &model.reports {
                    a href={ "/models/report?" (encode(&[("store", store), ("name", report)])) } { (safe(report)) } " "
                }
            } }
        } }
    }
}

/// The losses of a history: that of the training steps, and that on the validation scenes.
fn curve(history: &[Value]) -> Markup {
    if history.iter().any(is_own) {
        return own_curves(history);
    }
    let at = |line: &Value| line["step"].as_f64().unwrap_or(f64::NAN);
    let points = |figure: &dyn Fn(&Value) -> Option<f64>| {
        let lines = history.iter();
        lines
            .filter_map(|line| Some((at(line), figure(line)?)))
            .collect()
    };
    let series = [
        Series {
            label: "training loss".into(),
            class: "training",
            points: points(&|line| line["loss"].as_f64()),
        },
        Series {
            label: "validation loss".into(),
            class: "validation",
            points: points(&validation_loss),
        },
    ];
    html! {
        (lines("Loss by optimiser step", ["step", "loss"], &series))
        p.legend { span.swatch.training { "training" } span.swatch.validation { "validation" } }
    }
}

/// Whether a line of a history is a report of an own training.
fn is_own(line: &Value) -> bool {
    line["metrics"].is_object()
}

/// The metrics that an own training has reported, each over epochs, or over steps if it counts no
/// epochs.
fn own_curves(history: &[Value]) -> Markup {
    let metrics = history
        .iter()
        .filter_map(|line| line["metrics"].as_object())
        .flat_map(|metrics| metrics.keys());
    let names: BTreeSet<&String> = metrics.collect();
    let across = match history.iter().any(|line| line["epoch"].is_number()) {
        true => "epoch",
        false => "step",
    };
    let series = |name: &str| {
        let point = |line: &Value| Some((line[across].as_f64()?, line["metrics"][name].as_f64()?));
        [Series {
            label: name.to_owned(),
            class: "validation",
            points: history.iter().filter_map(point).collect(),
        }]
    };
    html! {
        @for name in names {
            h3 { (safe(name)) }
            (lines(&format!("{name} by {across}"), [across, ""], &series(name)))
        }
    }
}

/// The loss on validation scenes of a line of a history: the mean absolute error in metres, or one
/// minus IoU.
fn validation_loss(line: &Value) -> Option<f64> {
    let found = &line["validation"];
    if is_own(line) {
        // Its loss is its objective.
        return line["loss"].as_f64();
    }
    let mae = found["mae_m"].as_f64();
    mae.or_else(|| Some(1.0 - found["iou"].as_f64()?))
}

/// An evaluation, with the scenes in the order of their errors, worst first.
fn evaluated(
    listed: &Listing,
    store: &str,
    model: &ModelManifest,
    evaluation: &Evaluation,
    position: usize,
) -> Markup {
    let metrics = &evaluation.metrics;
    let set = format!("{store}/{}", evaluation.dataset);
    let set = listed
        .sets
        .iter()
        .any(|found| found.id == set)
        .then_some(set);
    let shown = [
        "examples",
        "by_scene",
        "by_scene_index",
        "baselines",
        "released",
    ];
    let figures = metrics.as_object().into_iter().flatten();
    let figures = figures.filter(|(name, value)| !shown.contains(&&***name) && value.is_number());
    let (figure, scenes) = by_error(metrics);
    html! {
        section id={ "evaluation-" (position) } {
            h2 { "On " (thousands(evaluation.scenes)) " scenes of " (safe(&evaluation.dataset)) ", side "
                (safe(&evaluation.side)) }
            p { (verdict(&Verdict::of_evaluation(&model.kind, metrics))) }
            dl.line { @for (name, value) in figures {
                div { dt { (safe(name)) } dd { (safe(plain(value))) } }
            } }
            @if !scenes.is_empty() {
                h3 { "Scenes by " (figure) ", worst first" }
                (scroll("Table of scenes", html! { table.narrow {
                    thead { tr { th.number { "scene" } th.number { (figure) } th { "look" } } }
                    tbody { @for (scene, error) in scenes.iter().take(WORST) { tr {
                        td.number { (scene) }
                        td.number { (format!("{error:.4}")) }
                        td { @if let Some(set) = &set {
                            @let id = SceneId { set: set.clone(), scene: *scene };
                            a href={ "/data/scene?" (id.encode(&[])) } { "images" } " · "
                            a href=(flight_path(set, *scene)) { "light in flight" }
                        } }
                    } } }
                } }))
                @if scenes.len() > WORST { p.hint { (scenes.len() - WORST) " more scenes have smaller errors." } }
            }
        }
    }
}

/// The scenes of an evaluation with their errors, the largest first, and the name of the error.
fn by_error(metrics: &Value) -> (&'static str, Vec<(u64, f64)>) {
    let values = |name: &str| metrics[name].as_array().map_or(&[][..], Vec::as_slice);
    let (scenes, figures) = (values("by_scene_index"), values("by_scene"));
    let depth = figures.iter().any(|figure| figure["mae_m"].is_number());
    let error = |figure: &Value| match depth {
        true => figure["mae_m"].as_f64(),
        false => Some(1.0 - figure["iou"].as_f64()?),
    };
    let pairs = scenes.iter().zip(figures);
    let mut found: Vec<(u64, f64)> = pairs
        .filter_map(|(scene, figure)| Some((scene.as_u64()?, error(figure)?)))
        .collect();
    found.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    (if depth { "MAE, m" } else { "1 − IoU" }, found)
}

fn pretty(value: &Value) -> String {
    serde_json::to_string_pretty(value).unwrap_or_default()
}

fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Object(parts) => {
            let parts = parts
                .iter()
                .map(|(name, value)| format!("{name} {}", plain(value)));
            parts.collect::<Vec<_>>().join(", ")
        }
        Value::Number(number) if number.is_f64() => number
            .as_f64()
            .map(picofarm_figures::number::short)
            .unwrap_or_default(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn each_metric_of_an_own_training_has_a_curve() {
        let line = |epoch: u64| json!({"epoch": epoch, "step": null, "metrics": {"mae_m": 1.0 / epoch as f64, "<b>": 2}});
        let drawn = curve(&[line(1), line(2)]).into_string();
        assert_eq!(drawn.matches("<polyline").count(), 2, "{drawn}");
        assert!(
            drawn.contains("<h3>mae_m</h3>") && !drawn.contains("<b>"),
            "{drawn}"
        );
        let steps = [json!({"epoch": null, "step": 5, "metrics": {"a": 1.0}})];
        assert!(curve(&steps).into_string().contains("a by step"));
    }

    #[test]
    fn scenes_are_in_the_order_of_their_errors() {
        let depth = json!({"by_scene_index": [4, 7, 9], "by_scene": [{"mae_m": 0.1}, {"mae_m": 0.3}, {"mae_m": 0.2}]});
        assert_eq!(
            by_error(&depth),
            ("MAE, m", vec![(7, 0.3), (9, 0.2), (4, 0.1)])
        );
        let mask = json!({"by_scene_index": [1, 2], "by_scene": [{"iou": 0.75}, {"iou": 0.5}]});
        assert_eq!(by_error(&mask), ("1 − IoU", vec![(2, 0.5), (1, 0.25)]));
        assert!(by_error(&json!({"mae_m": 0.1})).1.is_empty());
    }
}
