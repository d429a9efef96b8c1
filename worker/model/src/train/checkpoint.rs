//! A training, stopped anywhere between two steps, as bytes: weights, moments, statistics, position, curves. What goes on
//! from them is to the bit what would have gone on without stopping.

use std::collections::BTreeMap;

use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use super::{learner::Learner, run::Position};
use crate::{
    ModelError,
    parameters::{Named, Parameters, download, upload},
    weights,
};

const FORMAT: &str = "picofarm-checkpoint-1";

/// What a checkpoint holds beside tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Header {
    format: String,
    steps: u64,
    pub(super) position: Position,
    /// The plan's text: a checkpoint goes on only with the plan it was made with.
    pub(super) plan: String,
}

pub(super) fn write(learner: &Learner, position: &Position, plan: &str) -> Vec<u8> {
    let mut named = Named::new();
    for (name, value) in learner.parameters.to_named() {
        named.insert(format!("weights/{name}"), value);
    }
    for (d, moments) in learner.net.declared().iter().zip(&learner.moments) {
        if d.learned {
            for (part, moment) in ["m", "v"].iter().zip(moments) {
                let value = (d.shape.clone(), download(moment));
                named.insert(format!("adamw.{part}/{}", d.name), value);
            }
        }
    }
    let header = Header {
        format: FORMAT.into(),
        steps: learner.steps,
        position: position.clone(),
        plan: plan.into(),
    };
    let header = serde_json::to_string(&header).expect("plain data");
    weights::write(&named, &BTreeMap::from([("checkpoint".into(), header)]))
}

/// Puts a learner where a checkpoint was made.
pub(super) fn read(
    bytes: &[u8],
    learner: &mut Learner,
    device: &Device,
) -> Result<Header, ModelError> {
    let (mut named, metadata) = weights::read(bytes)?;
    let none = || ModelError::weights("these are no checkpoint of a training, only weights");
    let header = metadata.get("checkpoint").ok_or_else(none)?;
    let header: Header = serde_json::from_str(header)
        .map_err(|e| ModelError::weights(format!("the checkpoint's header: {e}")))?;
    if header.format != FORMAT {
        let what = format!(
            "the checkpoint has format {:?}, this program reads {FORMAT:?}",
            header.format
        );
        return Err(ModelError::weights(what));
    }
    for (i, d) in learner.net.declared().iter().enumerate() {
        if !d.learned {
            continue;
        }
        for (k, part) in ["m", "v"].iter().enumerate() {
            let name = format!("adamw.{part}/{}", d.name);
            let value = named.remove(&name).filter(|(shape, _)| *shape == d.shape);
            let Some((_, value)) = value else {
                let what = format!("the checkpoint has no {name:?} of shape {:?}", d.shape);
                return Err(ModelError::weights(what));
            };
            learner.moments[i][k] = upload(value, device);
        }
    }
    let named = named
        .into_iter()
        .map(|(name, value)| (name.trim_start_matches("weights/").to_owned(), value))
        .collect();
    learner.parameters = Parameters::from_named(learner.net.declared().to_vec(), named, device)?;
    learner.steps = header.steps;
    Ok(header)
}
