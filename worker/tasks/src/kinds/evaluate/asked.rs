//! A model under evaluation, and its input.

use picofarm_proto::{key::evaluation_key, spec::Histogram};
use picofarm_sensor::Sensor;
use picofarm_store::published::Manifest as _;

use super::EvaluationRun;
use crate::{
    input::{
        models::{Known, trained},
        times::{Taken, Times},
        truth,
    },
    task::{Control, TaskError},
};

/// A model under evaluation.
pub(super) struct EvaluatedModel {
    /// Index of the model in the evaluation.
    pub(super) which: usize,
    pub(super) model: Known,
    /// Two-bounce times for a shadow network that takes them.
    pub(super) times: Option<Times>,
    pub(super) histogram: Histogram,
    pub(super) spots: Vec<u32>,
    /// The sensor that histograms pass through, and the seed of its noise.
    pub(super) sensor: Option<(Sensor, u64)>,
    pub(super) sha256: String,
    /// Key of the evaluation of this model.
    pub(super) key: String,
}

impl EvaluationRun<'_> {
    /// Prepares one of the models and its input.
    pub(super) fn open_model(
        &self,
        which: usize,
        control: &Control,
    ) -> Result<EvaluatedModel, TaskError> {
        let (stores, models, settings) = (self.stores, &self.models, &self.task.evaluate);
        let name = &settings.models[which];
        let field = format!("evaluate.models[{which}]");
        let spec = self.dataset.spec();
        let model = Known::read(
            stores,
            models,
            (&field, name),
            (spec, &self.device),
            control,
        )?;
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
        let at_times = match &*settings.times {
            "" => (
                format!("{field}: its two-bounce times (evaluate.times gives others)"),
                &*trained.shadow.times,
            ),
            name => ("evaluate.times".to_owned(), name),
        };
        let store = &self.task.source.store;
        let at_times = (&*at_times.0, at_times.1);
        let times = Taken::by(model.model.question());
        let times =
            times.map(|taken| Times::open(stores, store, &self.dataset, at_times, taken, control));
        let times = times.transpose()?;
        let from_truth = times.as_ref().is_some_and(Times::are_true);
        truth::check(
            &place,
            &truth::of_training(&trained, from_truth),
            &self.data.missing,
        )?;
        // Trivial baselines are fitted to the training scenes and need no times.
        truth::check(
            &place,
            &truth::of_training(&trained, false),
            &self.known_data.missing,
        )?;
        let pinned = match &times {
            None => String::new(),
            Some(times) => times
                .pin(stores, at_times.0, &self.scenes, &self.data, control)?
                .map_or_else(|| times.name.clone(), |depths| depths.id),
        };
        let sensor = trained.sensor.filter(|_| settings.sensor);
        let sensor = sensor.map(|sensor| (*sensor, trained.seed));
        let (sha256, version) = (model.manifest.sha256(), &settings.version);
        let data = [&*self.data.id, &self.known_data.id];
        Ok(EvaluatedModel {
            key: evaluation_key(
                &sha256,
                data,
                &pinned,
                (histogram, &spots),
                sensor.is_some(),
                version,
            )
            .to_string(),
            which,
            model,
            times,
            histogram,
            spots,
            sensor,
            sha256,
        })
    }
}
