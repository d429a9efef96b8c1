//! Evaluation: one task in which trained models meet scenes that they have not seen. What it finds lies beside each model;
//! a model that was evaluated on these scenes before is not asked again.

use picofarm_dataset::{Dataset, Evaluation, Models, Pinned, SplitUsed, sha256_hex};
use picofarm_model::{baseline::Baseline, evaluate};
use picofarm_proto::{
    key::evaluation_key,
    model::{EvaluateTask, Histogram, TaskSpec, TrainSettings, train::TRUTH},
};
use serde_json::json;
use tracing::info;

use crate::execute::{
    Context, Control, Output, RunTask, Task, TaskError,
    examples::{Examples, first, sides},
    output::Stores,
    train::{Known, at, model_version, of_model, pin},
    truth,
};

/// Training scenes that answers without a network are fitted to, at most.
const BASELINE: usize = 64;

impl RunTask for EvaluateTask {
    fn code_version() -> String {
        model_version()
    }

    /// Evaluates the models that `task` names.
    fn run(&self, context: &Context, _task: &Task, control: &Control) -> Result<Output, TaskError> {
        let stores = &context.stores;
        let task = self;
        let (place, settings) = (&task.source, &task.evaluate);
        let dataset = stores
            .open_source(&place.store, &place.dataset, control)
            .map_err(|e| at("source", e))?;
        stores.fits(TaskSpec::Evaluate(task.clone()), Some(dataset.spec()))?;
        let models = stores
            .models(&place.store, control)
            .map_err(|e| at("source.store", e))?;
        let split = ("evaluate.split", &*settings.split);
        let sides = sides(stores, &dataset, split, [&*settings.side, "train"], control)?;
        let [mut scenes, mut known] = sides.scenes;
        first(&mut scenes, settings.scenes, "evaluate.scenes")?;
        known.truncate(BASELINE);
        let evaluation = EvaluationRun {
            data: pin(stores, &dataset, &scenes, control)?,
            known_data: pin(stores, &dataset, &known, control)?,
            known,
            stores,
            task,
            dataset,
            models,
            split: sides.split,
            scenes,
        };
        let (mut documents, mut computed) = (Vec::new(), false);
        for which in 0..settings.models.len() {
            let (found, new) = evaluation.of(which, control)?;
            computed |= new;
            documents.extend(found.to_bytes());
        }
        control.at(1.0);
        Ok(Output {
            manifest_sha256: sha256_hex(&documents),
            bytes: documents.len() as u64,
            adopted: !computed,
        })
    }
}

/// One evaluation: the scenes, and the models that it asks.
struct EvaluationRun<'a> {
    stores: &'a Stores,
    task: &'a EvaluateTask,
    dataset: Dataset,
    models: Models,
    split: SplitUsed,
    scenes: Vec<u64>,
    /// What pins their bytes.
    data: Pinned,
    /// Training scenes that the answers which need no model are fitted to, and what pins their bytes.
    known: Vec<u64>,
    known_data: Pinned,
}

impl EvaluationRun<'_> {
    /// What one of the models has found or finds now; and whether it is new.
    fn of(&self, which: usize, control: &Control) -> Result<(Evaluation, bool), TaskError> {
        let (stores, models, settings) = (self.stores, &self.models, &self.task.evaluate);
        let name = &settings.models[which];
        let field = format!("evaluate.models[{which}]");
        let spec = self.dataset.spec();
        let model = Known::read(stores, models, (&field, name), spec, control)?;
        let trained = trained(&model.manifest.settings).map_err(|what| {
            TaskError::User(format!(
                "{field}: the settings of {name:?} are not known: {what}"
            ))
        })?;
        let (histogram, spots) = match settings.histogram {
            Some(histogram) => (histogram, settings.spots.clone()),
            None => (trained.histogram, trained.spots.clone()),
        };
        let place = self.dataset.place();
        // Trivial answers are fitted to the training scenes.
        for missing in [&self.data.missing, &self.known_data.missing] {
            truth::check(&place, &truth::of_training(&trained), missing)?;
        }
        let (sha256, version) = (model.manifest.sha256(), &settings.version);
        let data = [&*self.data.id, &self.known_data.id];
        let key = evaluation_key(&sha256, data, histogram, &spots, version).to_string();
        if let Some(found) = stores.wait(control, models.evaluation(name, &key))? {
            return Ok((found, false));
        }
        let guide = match &*trained.shadow.tof {
            TRUTH => None,
            tof => {
                let field = format!("{field}: its two-bounce times");
                Some(Known::read(stores, models, (&field, tof), spec, control)?)
            }
        };
        let metrics = self.ask(which, &model, guide.as_ref(), (histogram, &spots), control)?;
        info!("{name}: {}", summary(&metrics));
        let made = Evaluation {
            key: key.clone(),
            model: name.clone(),
            model_sha256: sha256,
            dataset: self.task.source.dataset.clone(),
            data: self.data.id.clone(),
            split: self.split.clone(),
            side: settings.side.clone(),
            scenes: self.scenes.len() as u64,
            histogram: histogram.name().to_owned(),
            code: version.clone(),
            metrics,
        };
        if stores.patiently(control, async || models.put_evaluation(&made).await)? {
            return Ok((made, true));
        }
        // Somebody else was faster, and what stands is what counts.
        let stands = stores.wait(control, models.evaluation(name, &key))?;
        Ok((stands.unwrap_or(made), true))
    }

    /// Shows every scene to a model.
    fn ask(
        &self,
        which: usize,
        model: &Known,
        guide: Option<&Known>,
        histogram: (Histogram, &[u32]),
        control: &Control,
    ) -> Result<serde_json::Value, TaskError> {
        let scenes = self.scenes.clone();
        let examples = Examples::new(self.stores, &self.dataset, histogram, scenes, "evaluate")?;
        let spots = model.model.question().spots;
        if spots > 0 && spots != examples.spots() {
            return Err(TaskError::User(format!(
                "evaluate.models[{which}]: {:?} was trained on histograms of {spots} spots, these are of {}",
                model.manifest.name,
                examples.spots()
            )));
        }
        let known = self.known.clone();
        let known = Examples::new(self.stores, &self.dataset, histogram, known, "evaluate")?;
        let target = model.model.question().target;
        let baseline = Baseline::fit(target, &*known, BASELINE).map_err(of_model)?;
        let (name, count) = (&model.manifest.name, self.task.evaluate.models.len());
        let mut tell = |scene: usize, of: usize| {
            let share = (which as f32 + scene as f32 / of as f32) / count as f32;
            let text = format!("{name} ({} of {count}): scene {scene}/{of}", which + 1);
            control.say(text, &[]);
            control.at(share * 0.99)
        };
        let guide = guide.map(|guide| &*guide.model);
        let found = evaluate(&model.model, guide, &baseline, &*examples, &mut tell)
            .map_err(of_model)?
            .ok_or(TaskError::Stopped)?;
        let baselines = found
            .baselines
            .iter()
            .map(|(name, m)| (name.clone(), json!(m)));
        let mut metrics = json!(found.metrics);
        metrics["released"] = json!(found.released);
        metrics["baselines"] = baselines.collect();
        metrics["examples"] = json!(found.examples);
        metrics["by_scene"] = json!(found.scenes);
        metrics["by_scene_index"] = json!(self.scenes);
        Ok(metrics)
    }
}

/// The figures of all scenes together, for people.
fn summary(metrics: &serde_json::Value) -> String {
    let all = metrics.as_object().into_iter().flatten();
    let numbers = all.filter(|(name, _)| *name != "examples");
    let numbers = numbers.filter_map(|(name, x)| Some(format!("{name} {:.4}", x.as_f64()?)));
    numbers.collect::<Vec<_>>().join(", ")
}

/// The settings that a model was trained with.
pub(in crate::execute) fn trained(settings: &serde_json::Value) -> Result<TrainSettings, String> {
    let mut settings = settings.clone();
    // The manifest tells the name apart from them.
    if let Some(table) = settings.as_object_mut() {
        table.insert("model".into(), "model".into());
    }
    serde_json::from_value(settings).map_err(|e| e.to_string())
}
