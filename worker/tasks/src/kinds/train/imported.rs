//! Import of networks that were trained elsewhere: released checkpoints, and one's own.

use std::fmt;

use picofarm_dataset::{DatasetSpec, Manifest};
use picofarm_model::{Model, ModelError, cpu, train::Plan};
use picofarm_proto::spec::{Histogram, TrainSettings, train::Normalise};
use picofarm_results::{Lineage, ModelManifest, NewModel, SplitUsed};
use picofarm_store::sha256_hex;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::{plan, results::measurement, results::pretty, trial};
use crate::{
    input::{
        models::{WEIGHTS, expected_input, model_version},
        quantity,
    },
    task::TaskError,
};

/// The data set with the kind of histograms that an imported network takes.
#[derive(Debug, Clone, Copy)]
pub struct ImportFor<'a> {
    /// Folder of the data set.
    pub dataset: &'a str,
    /// Properties of the data set.
    pub spec: &'a DatasetSpec,
    /// One of its scenes.
    pub scene: &'a Manifest,
}

/// The reason why a network is not imported.
#[derive(Debug)]
pub enum NotImported {
    /// The settings cannot be used.
    Settings(String),
    /// The file is not in safetensors format, or stores numbers in an unsupported format.
    File(String),
    /// A tensor is missing, superfluous, or has another shape than the settings require.
    Tensors(String),
    /// A tensor contains values that no network can compute with.
    Values(String),
}

impl fmt::Display for NotImported {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self::Settings(what) | Self::File(what) | Self::Tensors(what) | Self::Values(what)) =
            self;
        f.write_str(what)
    }
}

/// Converts a network that was trained elsewhere into a model.
///
/// `weights` is a safetensors file with PyTorch's tensor names, of a plain, wrapped or combined
/// network. `settings` describe the network, as `train` in a job file does. `from` is the name of
/// the file. Training settings that do not affect predictions (rates, epochs) may be omitted.
///
/// # Errors
/// [`NotImported`] naming the setting or the tensor. The tensor is missing, or has another shape or
/// invalid values.
pub fn imported(
    weights: &[u8],
    settings: Value,
    of: ImportFor<'_>,
    from: &str,
) -> Result<NewModel, NotImported> {
    let unusable = NotImported::Settings;
    let settings: TrainSettings =
        serde_json::from_value(settings).map_err(|e| unusable(e.to_string()))?;
    if settings.takes_evidence() {
        let what = "train.shadow.variant: networks of variant \"evidence\" begin from a demultiplex stage, and none made \
                    elsewhere does; train one";
        return Err(unusable(what.into()));
    }
    settings.check().map_err(|e| unusable(e.to_string()))?;
    for (field, given) in [
        ("from", !settings.from.is_empty()),
        ("trial", settings.trial.is_some()),
        ("specular.on", !settings.specular.on.is_empty()),
        ("shadow.times", settings.times().is_some()),
    ] {
        if given {
            return Err(unusable(format!(
                "train.{field}: says what a training begins with or learns from, and nothing is trained here; remove it"
            )));
        }
    }
    let quantity = quantity(settings.histogram);
    if !of.spec.quantities().contains(&quantity) {
        return Err(unusable(format!(
            "train.histogram: {} has no {}",
            of.dataset,
            quantity.name()
        )));
    }
    let spots = match settings.histogram {
        Histogram::Transient => of.spec.spots as usize,
        Histogram::TransientSpots => settings.spots.len(),
        _ => quantity.spots_of_100().len(),
    };
    let greatest = match (settings.input.normalise, settings.input.max) {
        (Normalise::Log, 0.0) => {
            return Err(unusable(
                "train.input.max: is missing; with normalise = \"log\" it is the largest bin of the scenes that were learnt from"
                    .into(),
            ));
        }
        (_, max) => max as f32,
    };
    let plan: Plan =
        plan::plan(&settings, of.spec, (spots, None), greatest).map_err(|e| match e {
            TaskError::User(what) => unusable(what),
            other => unusable(other.to_string()),
        })?;
    let ours = Model::import(weights, &plan, &cpu()).map_err(|e| match e {
        ModelError::File { what } => NotImported::File(what),
        ModelError::Weights { what } => NotImported::Tensors(what),
        ModelError::Values { what } => NotImported::Values(what),
        other => unusable(other.to_string()),
    })?;
    let sha256 = sha256_hex(weights);
    let key = json!({"import": sha256, "settings": settings.shaping(), "gate": of.spec.gate, "code": model_version()});
    let metrics = json!({"imported": {"file": from, "sha256": sha256}});
    Ok(NewModel {
        manifest: ModelManifest {
            name: settings.model.clone(),
            kind: settings.target.name().to_owned(),
            training_key: hex::encode(Sha256::digest(key.to_string())),
            settings: settings.shaping(),
            plan: expected_input(&plan, of.spec),
            lineage: Lineage {
                dataset: of.dataset.to_owned(),
                split: SplitUsed::default(),
                measurement: measurement(of.spec, spots as u32, of.scene),
                code: model_version(),
                ..Lineage::default()
            },
            metrics: metrics.clone(),
            ..ModelManifest::default()
        },
        objects: vec![
            (WEIGHTS.into(), ours.into()),
            (trial::HISTORY.into(), Vec::new().into()),
            ("metrics.json".into(), pretty(&metrics).into()),
        ],
    })
}
