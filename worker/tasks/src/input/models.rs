//! Trained models, read from a store and prepared for predictions.

use std::sync::Arc;

use bytes::Bytes;
use picofarm_dataset::{Dataset, DatasetSpec, Gate, Pinned};
use picofarm_model::{Device, Model, train::Plan};
use picofarm_proto::spec::TrainSettings;
use picofarm_results::{ModelManifest, Models};
use picofarm_sensor::SENSOR_VERSION;
use serde::{Deserialize, Serialize};

use crate::{
    errors::{in_field, model_error},
    stores::Stores,
    task::{Control, TaskError},
};

/// Name of the object with a model's weights.
pub(crate) const WEIGHTS: &str = "weights.safetensors";

/// Returns the version of networks, training, metrics and the sensor model.
pub fn model_version() -> String {
    format!("{}/{SENSOR_VERSION}", picofarm_model::VERSION)
}

/// A model from a store.
pub(crate) struct Known {
    pub(crate) manifest: ModelManifest,
    pub(crate) model: Arc<Model>,
    pub(crate) weights: Bytes,
}

/// The part of a model's manifest that describes its input, for checks before its weights are read.
#[derive(Serialize, Deserialize)]
struct ExpectedInput {
    /// The plan, which is also stored with the weights.
    plan: Plan,
    /// The bins of the model's histograms.
    gate: Gate,
}

/// Returns the description of a model's input for its manifest.
pub(crate) fn expected_input(plan: &Plan, spec: &DatasetSpec) -> serde_json::Value {
    let input = ExpectedInput {
        plan: plan.clone(),
        gate: spec.gate,
    };
    serde_json::to_value(input).expect("plain data")
}

/// Returns the histogram bins that a model expects, and the divisor of the image's width and
/// height, in pixels.
///
/// # Errors
/// Returns a message if another version of the networks made the model.
pub fn takes(manifest: &ModelManifest) -> Result<(Gate, u32), String> {
    let asked = serde_json::from_value(manifest.plan.clone());
    let ExpectedInput { plan, gate } = asked.map_err(|e| {
        format!(
            "{:?} was made by {}, and this version does not know how to ask it: {e}",
            manifest.name, manifest.lineage.code
        )
    })?;
    Ok((gate, plan.net.multiple() as u32))
}

/// A stored model that fits a data set. Its weights are not read yet.
pub(crate) struct CheckedModel {
    pub(crate) manifest: ModelManifest,
    pub(crate) plan: Plan,
}

impl CheckedModel {
    /// Checks a model: it must have been trained on histograms like those of `spec`, and accept
    /// images of that size.
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` if there is no model of this name, or it does not fit.
    pub(crate) fn look(
        stores: &Stores,
        models: &Models,
        (field, name): (&str, &str),
        spec: &DatasetSpec,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let manifest = stores.wait(control, models.manifest(name));
        let manifest = manifest.map_err(|e| in_field(field, e))?;
        let asked = serde_json::from_value(manifest.plan.clone());
        let ExpectedInput { plan, gate } = asked.map_err(|e| {
            TaskError::User(format!(
                "{field}: {name:?} was made by {}, and this version does not know how to ask it: {e}",
                manifest.lineage.code
            ))
        })?;
        if gate != spec.gate {
            let shown = |g: &Gate| {
                format!(
                    "{} bins of {} m from {} m",
                    g.bins, g.bin_width_m, g.start_m
                )
            };
            return Err(TaskError::User(format!(
                "{field}: {name:?} was trained on {}, but the data set has {}",
                shown(&gate),
                shown(&spec.gate)
            )));
        }
        let multiple = plan.net.multiple() as u32;
        if !spec.height.is_multiple_of(multiple) || !spec.width.is_multiple_of(multiple) {
            return Err(TaskError::User(format!(
                "{field}: {name:?} takes images whose sides are multiples of {multiple}; the data set has {}x{} pixels",
                spec.width, spec.height
            )));
        }
        Ok(Self { manifest, plan })
    }

    /// Reads the model's weights.
    fn weights(
        &self,
        stores: &Stores,
        models: &Models,
        field: &str,
        control: &Control,
    ) -> Result<Bytes, TaskError> {
        let weights = stores.wait(control, models.read(&self.manifest, WEIGHTS));
        weights.map_err(|e| in_field(field, e))
    }

    /// Loads the model on a device.
    pub(crate) fn model(
        &self,
        stores: &Stores,
        models: &Models,
        (field, device): (&str, &Device),
        control: &Control,
    ) -> Result<Model, TaskError> {
        let weights = self.weights(stores, models, field, control)?;
        Model::read(&weights, device).map_err(model_error)
    }
}

impl Known {
    /// Reads a model and loads it on a device. See [`CheckedModel::look`].
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` if there is no model of this name, or it does not fit.
    pub(crate) fn read(
        stores: &Stores,
        models: &Models,
        (field, name): (&str, &str),
        (spec, device): (&DatasetSpec, &Device),
        control: &Control,
    ) -> Result<Self, TaskError> {
        let checked = CheckedModel::look(stores, models, (field, name), spec, control)?;
        let weights = checked.weights(stores, models, field, control)?;
        let model = Model::read(&weights, device).map_err(model_error)?;
        Ok(Self {
            model: Arc::new(model),
            weights,
            manifest: checked.manifest,
        })
    }
}

/// Returns the settings that a model was trained with.
pub(crate) fn trained(settings: &serde_json::Value) -> Result<TrainSettings, String> {
    let mut settings = settings.clone();
    // The manifest stores the model's name separately.
    if let Some(table) = settings.as_object_mut() {
        table.insert("model".into(), "model".into());
    }
    serde_json::from_value(settings).map_err(|e| e.to_string())
}

/// Returns the hash of the given scenes, in this order, and the quantities that each lacks.
pub(crate) fn pin(
    stores: &Stores,
    dataset: &Dataset,
    scenes: &[u64],
    control: &Control,
) -> Result<Pinned, TaskError> {
    let pinned = stores.wait(control, dataset.pin(scenes));
    pinned.map_err(|e| in_field("source", e))
}
