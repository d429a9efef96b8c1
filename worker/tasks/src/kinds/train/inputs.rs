//! Opens and checks the inputs of a training: its scenes, the models that it builds on, and its
//! key.

use std::{collections::BTreeMap, sync::Arc};

use picofarm_dataset::DatasetSpec;
use picofarm_model::cpu;
use picofarm_proto::{
    key::training_key,
    spec::{TaskSpec, TrainSettings, TrainTask, train::Target},
};
use picofarm_results::{Lineage, Measurement, Models};
use picofarm_store::published::Manifest as _;

use super::{TrainingRun, results};
use crate::{
    errors::in_field,
    input::{
        examples::Examples,
        models::{Known, pin},
        sides::{first, sides},
        times::{Taken, Times},
        truth,
    },
    stores::Stores,
    task::{Control, TaskError},
};

impl<'a> TrainingRun<'a> {
    pub(super) fn open(
        stores: &Stores,
        task: &'a TrainTask,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let (place, settings) = (&task.source, &task.train);
        let dataset = stores
            .open_source(&place.store, &place.dataset, control)
            .map_err(|e| in_field("source", e))?;
        let left_mib = stores.fits(TaskSpec::Train(task.clone()), Some(dataset.spec()))?;
        let models = stores
            .models(&place.store, control)
            .map_err(|e| in_field("source.store", e))?;
        let split = ("train.split", &*settings.split);
        let sides = sides(stores, &dataset, split, ["train", "validation"], control)?;
        let [mut training, validation] = sides.scenes;
        first(&mut training, settings.scenes, "train.scenes")?;
        if validation.is_empty() && settings.optimise.early_stop > 0 {
            return Err(TaskError::User(format!(
                "train.optimise.early_stop: the split {:?} has no validation scenes to tell when; give it some, or 0",
                settings.split
            )));
        }
        let spec = *dataset.spec();
        let built = read_models(stores, &models, settings, &spec, control)?;
        let pin = |scenes: &[u64]| pin(stores, &dataset, scenes, control);
        let pins = [pin(&training)?, pin(&validation)?];
        let named = ("train.shadow.times", &*settings.shadow.times);
        let taken = match settings.takes_evidence() {
            true => Taken::Evidence(None),
            false => Taken::Times,
        };
        let times = Times::open(stores, &place.store, &dataset, named, taken, control)?;
        let needs = truth::of_training(settings, times.are_true());
        for pinned in &pins {
            truth::check(&dataset.place(), &needs, &pinned.missing)?;
        }
        let mut used: Vec<u64> = training.iter().chain(&validation).copied().collect();
        used.sort_unstable();
        let data = pin(&used)?;
        let depths = times.pin(stores, named.0, &used, &data, control)?;
        let histogram = (settings.histogram, &*settings.spots);
        let examples = |scenes| {
            let sensor = settings.sensor.clone();
            let scenes = Examples::new(stores, &dataset, histogram, scenes, "train")?
                .through(sensor.map(|sensor| (*sensor, settings.seed)))?;
            let scenes = scenes
                .timed_by(times.depths())
                .seeing(times.evidence(), named.0)?;
            Ok(Arc::new(scenes.staying(left_mib)))
        };
        let shown = training.first().copied();
        let [training_scenes, validation_scenes] = [&training, &validation].map(|s| s.len() as u64);
        let (training, validation) = (examples(training)?, examples(validation)?);
        let measurement = match shown {
            Some(scene) => {
                let manifest = stores.wait(control, dataset.manifest(scene))?;
                let mut found = results::measurement(&spec, training.spots() as u32, &manifest);
                found.photon_noise |= settings.sensor.as_ref().is_some_and(|s| s.poisson);
                found
            }
            None => Measurement::default(),
        };
        let manifests = built.iter().map(|(field, known)| (*field, &known.manifest));
        let by_field = manifests.clone().map(|(field, m)| (field, m.sha256()));
        let predicted = depths.iter().map(|depths| (named.0, depths.id.clone()));
        let by_field: BTreeMap<&str, String> = by_field.chain(predicted).collect();
        let tof = depths.as_ref().and_then(|depths| depths.model.as_ref());
        let key = training_key(settings, [&pins[0].id, &pins[1].id], &by_field).to_string();
        let lineage = Lineage {
            dataset: place.dataset.clone(),
            data: data.id,
            split: sides.split,
            measurement,
            training_scenes,
            validation_scenes,
            code: settings.version.clone(),
            seed: settings.seed,
            models: manifests
                .map(|(_, m)| (m.name.clone(), m.sha256()))
                .chain(tof.map(|tof| (tof.name.clone(), tof.manifest_sha256.clone())))
                .collect(),
            times: times.used(depths.as_ref()),
            promoted: None,
            runtime: BTreeMap::new(),
        };
        Ok(Self {
            task,
            spec,
            evidence: times
                .evidence()
                .and_then(|there| there.spec().evidence.clone()),
            models,
            training,
            validation,
            built,
            lineage,
            key,
            left_mib,
            device: cpu(),
            gpu: None,
            peers: "",
            python: None,
        })
    }
}

/// Reads the models that a training builds on, by field.
fn read_models(
    stores: &Stores,
    models: &Models,
    settings: &TrainSettings,
    spec: &DatasetSpec,
    control: &Control,
) -> Result<BTreeMap<&'static str, Known>, TaskError> {
    let mut built = BTreeMap::new();
    for (field, name) in settings.models() {
        let known = Known::read(stores, models, (field, name), (spec, &cpu()), control)?;
        let wanted = match field {
            "train.from" => settings.target.name(),
            _ => Target::Tof.name(),
        };
        if known.manifest.kind != wanted {
            return Err(TaskError::User(format!(
                "{field}: {name:?} predicts {:?}, but one that predicts {wanted:?} is needed",
                known.manifest.kind
            )));
        }
        built.insert(field, known);
    }
    Ok(built)
}
