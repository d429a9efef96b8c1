//! Evaluation: one task in which trained models meet scenes that they have not seen. What it finds lies beside each model;
//! a model that has met these scenes before is not asked again.

use picofarm_dataset::{Evaluation, sha256_hex};
use picofarm_proto::{
    key::evaluation_key,
    model::{EvaluateTask, Histogram, TrainSettings},
};
use tracing::info;

use super::{
    Control, Output, TaskError,
    examples::{Examples, first, sides},
    output::Stores,
    train::{at, check_version, of_model, pin, read_model},
};

/// Evaluates the models that `task` names.
pub(super) fn run(
    stores: &Stores,
    task: &EvaluateTask,
    control: &Control,
) -> Result<Output, TaskError> {
    task.check().map_err(|e| TaskError::User(e.to_string()))?;
    let (place, settings) = (&task.source, &task.evaluate);
    check_version("evaluate", &settings.version)?;
    let dataset = stores
        .open_source(&place.store, &place.dataset, control)
        .map_err(|e| at("source", e))?;
    let models = stores
        .models(&place.store, control)
        .map_err(|e| at("source.store", e))?;
    let split = ("evaluate.split", &*settings.split);
    let sides = sides(stores, &dataset, split, [&*settings.side], control)?;
    let [mut scenes] = sides.scenes;
    first(&mut scenes, settings.scenes, "evaluate.scenes")?;
    let data = pin(stores, &dataset, &scenes, control)?;
    let (mut documents, mut computed) = (Vec::new(), false);
    for (done, name) in settings.models.iter().enumerate() {
        let field = format!("evaluate.models[{done}]");
        let (manifest, model) =
            read_model(stores, &models, name, control).map_err(|e| at(&field, e))?;
        let (histogram, spots) = match settings.histogram {
            Some(histogram) => (histogram, settings.spots.clone()),
            None => trained_on(&manifest.settings).map_err(|what| {
                TaskError::User(format!(
                    "{field}: the settings of {name:?} are not known: {what}"
                ))
            })?,
        };
        let (sha256, version) = (manifest.sha256(), &settings.version);
        let key = evaluation_key(&sha256, &data, histogram, &spots, version).to_string();
        let found = stores.wait(control, models.evaluation(name, &key))?;
        let evaluation = match found {
            Some(found) => found,
            None => {
                computed = true;
                let examples = Examples::new(
                    stores,
                    &dataset,
                    (histogram, &spots),
                    scenes.clone(),
                    "evaluate",
                )?;
                let count = settings.models.len();
                let mut tell = |scene: usize, of: usize| {
                    let share = (done as f32 + scene as f32 / of as f32) / count as f32;
                    let text = format!("{name} ({} of {count}): scene {scene}/{of}", done + 1);
                    control.say(text, &[]);
                    control.at(share * 0.99)
                };
                let metrics = picofarm_model::evaluate(&model, &*examples, &mut tell)
                    .map_err(of_model)?
                    .ok_or(TaskError::Stopped)?;
                info!("{name}: {metrics}");
                let made = Evaluation {
                    key: key.clone(),
                    model: name.clone(),
                    model_sha256: sha256,
                    dataset: place.dataset.clone(),
                    data: data.clone(),
                    split: sides.split.clone(),
                    side: settings.side.clone(),
                    scenes: scenes.len() as u64,
                    histogram: histogram.name().to_owned(),
                    code: version.clone(),
                    metrics,
                };
                match stores.patiently(control, async || models.put_evaluation(&made).await)? {
                    true => made,
                    // Somebody else was faster, and what stands is what counts.
                    false => stores
                        .wait(control, models.evaluation(name, &key))?
                        .unwrap_or(made),
                }
            }
        };
        documents.extend(evaluation.to_bytes());
    }
    control.at(1.0);
    Ok(Output {
        manifest_sha256: sha256_hex(&documents),
        bytes: documents.len() as u64,
        adopted: !computed,
    })
}

/// The histogram that a model was trained on, and which spots of it.
fn trained_on(settings: &serde_json::Value) -> Result<(Histogram, Vec<u32>), String> {
    let mut settings = settings.clone();
    // The manifest tells the name apart from the settings.
    if let Some(table) = settings.as_object_mut() {
        table.insert("model".into(), "model".into());
    }
    let settings: TrainSettings = serde_json::from_value(settings).map_err(|e| e.to_string())?;
    Ok((settings.histogram, settings.spots))
}
