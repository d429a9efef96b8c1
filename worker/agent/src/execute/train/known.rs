//! Trained models, read from a store and made ready.

use burn::tensor::Device;
use bytes::Bytes;
use picofarm_dataset::{DatasetSpec, Gate, ModelManifest, Models};
use picofarm_model::{
    input::Question,
    net::{Net, NetSpec},
    parameters::Parameters,
    train::{Guide, Plan},
    weights,
};
use serde::{Deserialize, Serialize};

use super::{WEIGHTS, at, of_model};
use crate::execute::{Control, TaskError, output::Stores};

/// A model as it lies in a store.
pub(in crate::execute) struct Known {
    pub(in crate::execute) manifest: ModelManifest,
    pub(in crate::execute) question: Question,
    pub(in crate::execute) net: NetSpec,
    pub(super) weights: Bytes,
}

/// What a manifest holds of a model for those who ask it.
#[derive(Serialize, Deserialize)]
struct Asked {
    question: Question,
    net: NetSpec,
    gate: Gate,
}

/// What a manifest holds of a model for those who ask it.
pub(super) fn asked(plan: &Plan, spec: &DatasetSpec) -> serde_json::Value {
    let asked = Asked {
        question: plan.question.clone(),
        net: plan.net.clone(),
        gate: spec.gate,
    };
    serde_json::to_value(asked).expect("plain data")
}

impl Known {
    /// Reads a model, which must have been trained on histograms like those of `spec`.
    ///
    /// # Errors
    /// [`TaskError::User`] at `field` where there is none of this name, or it was trained on other bins.
    pub(in crate::execute) fn read(
        stores: &Stores,
        models: &Models,
        (field, name): (&str, &str),
        spec: &DatasetSpec,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let manifest = stores.wait(control, models.manifest(name));
        let manifest = manifest.map_err(|e| at(field, e))?;
        let asked = serde_json::from_value(manifest.plan.clone());
        let Asked {
            question,
            net,
            gate,
        } = asked.map_err(|e| {
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
        let weights = stores.wait(control, models.read(&manifest, WEIGHTS));
        Ok(Self {
            weights: weights.map_err(|e| at(field, e))?,
            manifest,
            question,
            net,
        })
    }

    /// The network and its numbers.
    pub(in crate::execute) fn ready(
        &self,
        device: &Device,
    ) -> Result<(Net, Parameters), TaskError> {
        let ready = || {
            let net = Net::new(self.net.clone())?;
            let (named, _) = weights::read(&self.weights)?;
            let named = weights::from_torch(named, net.declared(), self.question.part())?;
            let parameters = Parameters::from_named(net.declared().to_vec(), named, device)?;
            Ok((net, parameters))
        };
        ready().map_err(of_model)
    }

    /// As what two-bounce times follow from.
    pub(super) fn guide(&self, device: &Device) -> Result<Guide, TaskError> {
        let (net, parameters) = self.ready(device)?;
        Ok(Guide::new(net, parameters, self.question.clone()))
    }
}
