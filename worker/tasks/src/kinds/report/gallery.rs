//! Pictures of the predictions of trained models, for reports. The scenes are those of the models'
//! evaluations.

use std::sync::Arc;

use picofarm_model::{Device, Model};
use picofarm_proto::spec::Histogram;
use picofarm_report::{Picture, pictures};
use picofarm_results::Evaluation;

use crate::{
    errors::model_error,
    input::{
        examples::Examples,
        models::{Known, pin, trained},
        sides::sides,
        times::{Taken, Times},
        truth,
    },
    stores::Stores,
    task::{Control, TaskError},
};

/// A model's pictures and the size of its images.
pub(super) struct ExampleScenes {
    /// The model read from the store.
    pub(super) model: Arc<Model>,
    /// Rows of the images.
    pub(super) side: usize,
    /// Pictures of its predictions.
    pub(super) pictures: Vec<Picture>,
}

/// Computes a model's predictions on `device` for the first `count` scenes of its evaluation.
///
/// # Errors
/// [`TaskError::User`] if the model, its data set or its split no longer exists.
pub(super) fn show(
    stores: &Stores,
    store: &str,
    evaluation: &Evaluation,
    (count, device): (usize, &Device),
    control: &Control,
) -> Result<ExampleScenes, TaskError> {
    let dataset = stores.open_source(store, &evaluation.dataset, control)?;
    let models = stores.source_models(store, control)?;
    let split = ("report", &*evaluation.split.name);
    let found = sides(stores, &dataset, split, [&*evaluation.side], control)?;
    let [mut scenes] = found.scenes;
    scenes.truncate(count);
    let model = ("report", &*evaluation.model);
    let known = Known::read(stores, &models, model, (dataset.spec(), device), control)?;
    let settings = trained(&known.manifest.settings)
        .map_err(|what| TaskError::User(format!("{}: its settings: {what}", evaluation.model)))?;
    let pinned = pin(stores, &dataset, &scenes, control)?;
    let at_times = ("report", &*evaluation.times);
    let times = Taken::by(known.model.question())
        .map(|taken| Times::open(stores, store, &dataset, at_times, taken, control))
        .transpose()?;
    truth::check(
        &dataset.place(),
        &truth::of_training(&settings, times.as_ref().is_some_and(Times::are_true)),
        &pinned.missing,
    )?;
    let times = times.as_ref();
    let histogram = Histogram::parse(&evaluation.histogram).map_err(TaskError::User)?;
    let indices: Vec<usize> = (0..scenes.len()).collect();
    let histogram = (histogram, &*settings.spots);
    let sensor = settings.sensor.filter(|_| evaluation.sensor);
    let examples = Examples::new(stores, &dataset, histogram, scenes, "report")?
        .through(sensor.map(|sensor| (*sensor, settings.seed)))?
        .timed_by(times.and_then(Times::depths))
        .seeing(times.and_then(Times::evidence), "report")?
        .with_light();
    let pictures = pictures(&known.model, &examples, &indices, 2).map_err(model_error)?;
    Ok(ExampleScenes {
        side: dataset.spec().height as usize,
        model: known.model,
        pictures,
    })
}
