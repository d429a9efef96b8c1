//! Reports: collects the stored results of models for a page, and implements the task that stores
//! such a page.
//!
//! The page of a task is a pure function of the store's contents: models, evaluations and training
//! speeds. It has no date.

use std::{collections::BTreeMap, time::Duration};

use picofarm_model::{Device, Evaluated, Model, cpu, metric::Metrics, train::Line};
use picofarm_proto::{
    key::report_key,
    spec::{ReportTask, train::TRUTH},
};
use picofarm_report::{Data, Entry, Report, Speed, html, json};
use picofarm_results::{
    Evaluation, ModelManifest, Models, ReportManifest, ReportedModel, Reports, TrainingSpeed,
};
use picofarm_store::StorageError;
use picofarm_store::published::Manifest as _;
use serde_json::Value;
use tokio::runtime::Handle;
use tracing::warn;

mod gallery;

use crate::{
    errors::{in_field, model_error},
    input::models::{WEIGHTS, model_version},
    stores::Stores,
    task::{Context, Control, Output, RunTask, Task, TaskError},
};

/// Collects the stored results of models.
pub struct Collector {
    stores: Stores,
}

impl Collector {
    /// Creates a collector. `runtime` serves store requests and must not own the calling thread.
    pub fn new(runtime: Handle) -> Self {
        Self {
            stores: Stores::new(runtime, Duration::ZERO),
        }
    }

    /// Returns a report's entry for a model, with pictures of its predictions for `pictures` scenes
    /// if it was evaluated.
    ///
    /// # Errors
    /// [`TaskError::User`] if there is no such model, or its data set or split no longer exists.
    pub fn entry(
        &self,
        store: &str,
        name: &str,
        pictures: usize,
        control: &Control,
    ) -> Result<Entry, TaskError> {
        let models = self.stores.source_models(store, control)?;
        let subject = Subject::find(&self.stores, &models, name, control)?;
        subject.entry(&self.stores, (store, &models), (pictures, &cpu()), control)
    }
}

impl RunTask for ReportTask {
    fn code_version() -> String {
        format!("{}/{}", model_version(), picofarm_report::VERSION)
    }

    /// Makes and stores the report that `task` names; with `force`, even if it exists.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let stores = &context.stores;
        let (force, device) = (task.spec.force, context.device(task)?);
        let task = self;
        let settings = &task.report;
        let (store, prefix) = stores
            .probed(&settings.store, control)
            .map_err(|e| in_field("report.store", e))?;
        let (models, reports) = (
            Models::new(store.clone(), &prefix),
            Reports::new(store, &prefix),
        );
        let mut subjects = Vec::new();
        for (i, name) in settings.models.iter().enumerate() {
            let found = Subject::find(stores, &models, name, control);
            subjects.push(found.map_err(|e| in_field(&format!("report.models[{i}]"), e))?);
        }
        let reported: Vec<ReportedModel> = subjects.iter().map(Subject::reported).collect();
        let pins = reported.iter().map(|model| {
            let evaluation = model.evaluation.as_deref().unwrap_or_default();
            let speed = model.speed.as_deref().unwrap_or_default();
            format!("{} {evaluation} {speed}", model.manifest_sha256)
        });
        let key = report_key(settings, &pins.collect::<Vec<_>>()).to_string();
        let finished = match force {
            true => None,
            false => finished(stores, &reports, &settings.name, &key, control)?,
        };
        if let Some(manifest) = finished {
            return Ok(output(&manifest, true));
        }
        let mut report = Report {
            title: settings.title.clone(),
            ..Report::default()
        };
        let (place, count) = (&settings.store, subjects.len());
        for (i, subject) in subjects.iter().enumerate() {
            let text = format!("{} ({} of {count})", subject.manifest.name, i + 1);
            control.say(text, &[]);
            let entry = subject.entry(
                stores,
                (place, &models),
                (settings.pictures as usize, &device),
                control,
            )?;
            report.models.push(entry);
            if !control.at((i + 1) as f32 / (count + 1) as f32) {
                return Err(TaskError::Stopped);
            }
        }
        let manifest = ReportManifest {
            name: settings.name.clone(),
            task_key: key,
            code: settings.version.clone(),
            models: reported,
            ..ReportManifest::default()
        };
        let objects = [
            ("report.html", html(&report).into()),
            ("report.json", json(&report).into()),
        ];
        let published = stores.patiently(control, async || {
            reports.publish(manifest.clone(), &objects).await
        })?;
        control.at(1.0);
        Ok(output(&published, false))
    }
}

fn output(manifest: &ReportManifest, adopted: bool) -> Output {
    Output {
        manifest_sha256: manifest.sha256(),
        bytes: manifest.total_bytes(),
        adopted,
    }
}

/// Returns the report if this exact task has published it.
fn finished(
    stores: &Stores,
    reports: &Reports,
    name: &str,
    key: &str,
    control: &Control,
) -> Result<Option<ReportManifest>, TaskError> {
    let looked = async {
        match reports.finished(name, key).await {
            Err(error @ StorageError::Damaged { .. }) => {
                warn!(%error, "a report is damaged; it is made again to repair it");
                Ok(None)
            }
            other => other,
        }
    };
    stores.wait(control, looked)
}

/// A model in a report.
struct Subject {
    manifest: ModelManifest,
    /// The evaluation with the most scenes.
    evaluation: Option<Evaluation>,
    speed: Option<TrainingSpeed>,
}

impl Subject {
    fn find(
        stores: &Stores,
        models: &Models,
        name: &str,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let manifest = stores.wait(control, models.manifest(name))?;
        let mut evaluations = stores.wait(control, models.evaluations(name))?;
        let sha256 = manifest.sha256();
        evaluations.retain(|e| e.model_sha256 == sha256);
        let speed = stores.wait(control, models.speed(name, &manifest.training_key))?;
        Ok(Self {
            speed,
            evaluation: evaluations.into_iter().max_by_key(|e| e.scenes),
            manifest,
        })
    }

    fn reported(&self) -> ReportedModel {
        ReportedModel {
            name: self.manifest.name.clone(),
            manifest_sha256: self.manifest.sha256(),
            evaluation: self.evaluation.as_ref().map(|e| e.key.clone()),
            speed: self.speed.as_ref().map(TrainingSpeed::sha256),
        }
    }

    fn entry(
        &self,
        stores: &Stores,
        (store, models): (&str, &Models),
        (pictures, device): (usize, &Device),
        control: &Control,
    ) -> Result<Entry, TaskError> {
        let (manifest, name) = (&self.manifest, &*self.manifest.name);
        // Stored objects have checksums, so this program wrote a value that it cannot read.
        let broken = |what: String| TaskError::Crash(format!("model {name:?}: {what}"));
        let mut entry = match &self.evaluation {
            Some(evaluation) => {
                let shown = gallery::show(stores, store, evaluation, (pictures, device), control)?;
                Entry {
                    pictures: shown.pictures,
                    ..Entry::new(name, &shown.model, shown.side)
                }
            }
            None => {
                let weights = stores.wait(control, models.read(manifest, WEIGHTS))?;
                let model = Model::read(&weights, device).map_err(model_error)?;
                let mut entry = Entry::new(name, &model, 0);
                entry.multiply_adds = None;
                entry
            }
        };
        let history = stores.wait(control, models.read(manifest, "history.jsonl"))?;
        let lines = String::from_utf8_lossy(&history);
        let lines = lines.lines().map(serde_json::from_str::<Line>);
        entry.history = lines
            .collect::<Result<_, _>>()
            .map_err(|e| broken(format!("history.jsonl: {e}")))?;
        let found = self.evaluation.as_ref().map(|e| evaluated(&e.metrics));
        entry.evaluated = found
            .transpose()
            .map_err(|e| broken(format!("its evaluation: {e}")))?;
        entry.speed = self.speed.as_ref().map(|speed| Speed {
            samples_per_s: speed.samples_per_s,
            seconds: None,
        });
        describe(&mut entry, manifest, self.evaluation.as_ref());
        Ok(entry)
    }
}

/// Parses the stored figures of an evaluation: those of all scenes, those of the trivial baselines
/// by name, and those of each scene.
fn evaluated(found: &Value) -> serde_json::Result<Evaluated> {
    let part = |name: &str| found.get(name).cloned().unwrap_or_default();
    let baselines: BTreeMap<String, Metrics> = serde_json::from_value(part("baselines"))?;
    Ok(Evaluated {
        metrics: serde_json::from_value(found.clone())?,
        released: serde_json::from_value(part("released"))?,
        baselines: baselines.into_iter().collect(),
        scenes: serde_json::from_value(part("by_scene"))?,
        examples: serde_json::from_value(part("examples"))?,
    })
}

fn known(n: u32) -> Option<u32> {
    (n > 0).then_some(n)
}

/// Returns the settings beyond the plan in which models differ.
fn conditions(manifest: &ModelManifest, evaluation: Option<&Evaluation>) -> Vec<(String, String)> {
    let mut out = Vec::new();
    let mut differs = |name: &str, value: &str| out.push((name.to_owned(), value.to_owned()));
    if let Some(histogram) = setting(manifest, "/histogram") {
        differs("histogram", histogram);
    }
    let times = evaluation
        .map(|e| &*e.times)
        .filter(|times| !times.is_empty());
    if let Some(times) = times.or_else(|| setting(manifest, "/shadow/times")) {
        let from = match times {
            TRUTH => "the truth",
            _ => "a depth network",
        };
        differs("two-bounce times from", from);
    }
    if setting(manifest, "/from").is_some() {
        differs("begins", "trained");
    }
    if let Some(runtime) = manifest.lineage.runtime.get("program") {
        differs("runtime", runtime);
    }
    out
}

fn setting<'a>(manifest: &'a ModelManifest, path: &str) -> Option<&'a str> {
    manifest.settings.pointer(path).and_then(Value::as_str)
}

/// Fills in the model's origin.
fn describe(entry: &mut Entry, manifest: &ModelManifest, evaluation: Option<&Evaluation>) {
    let from = &manifest.lineage;
    entry.data = Data {
        name: from.dataset.clone(),
        // The training of an imported model is unknown.
        scenes: (from.training_scenes > 0).then_some(from.training_scenes),
        max_bounces: from.measurement.max_bounces,
        images: known(from.measurement.rows)
            .zip(known(from.measurement.columns))
            .map(<[u32; 2]>::from),
        spots: known(from.measurement.spots),
        noise: from.measurement.photon_noise,
    };
    entry.conditions = conditions(manifest, evaluation);
    let line = |name: &str, value: String| (name.to_owned(), value);
    entry.lineage = vec![
        line("data", format!("{} ({})", from.dataset, from.data)),
        line(
            "split",
            format!("{} version {}", from.split.name, from.split.version),
        ),
        line("code", from.code.clone()),
        line("training key", manifest.training_key.clone()),
        line("manifest SHA-256", manifest.sha256()),
    ];
    if let Some(augment) = manifest.settings["augment"].as_bool() {
        let numbered = matches!(setting(manifest, "/shadow/variant"), Some("index" | "all"));
        let how = match (augment, numbered) {
            (false, _) => "not shown",
            (true, false) => "shown",
            (true, true) => "not shown: spots are known by their number",
        };
        entry.lineage.push(line("mirrored scenes", how.into()));
    }
    if !from.runtime.is_empty() {
        let parts = from
            .runtime
            .iter()
            .map(|(name, value)| format!("{name} {value}"));
        let runtime = parts.collect::<Vec<_>>().join(", ");
        entry.lineage.push(line("runtime", runtime));
    }
    for (name, sha256) in &from.models {
        entry
            .lineage
            .push(line("builds on", format!("{name} ({sha256})")));
    }
    if let Some(e) = evaluation {
        let on = format!("{} {} scenes of {}", e.scenes, e.side, e.dataset);
        entry.lineage.push(line("evaluated on", on));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trainings_by_another_runtime_are_an_experiment_of_their_own() {
        let embedded = ModelManifest {
            settings: serde_json::json!({"histogram": "transient"}),
            ..ModelManifest::default()
        };
        let mut torch = embedded.clone();
        torch.lineage.runtime = [("program".to_owned(), "torch".to_owned())].into();
        let line = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        let common = line("histogram", "transient");
        assert_eq!(conditions(&embedded, None), std::slice::from_ref(&common));
        let apart = [common, line("runtime", "torch")];
        assert_eq!(conditions(&torch, None), apart);
    }
}
