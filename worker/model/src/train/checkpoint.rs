//! A training, stopped anywhere between two steps, as bytes: weights, moments, statistics, position, curves. What goes on
//! from them is to the bit what would have gone on without stopping.

use std::collections::BTreeMap;

use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use super::{
    learner::Learner,
    position::{Line, Position},
};
use crate::{
    ModelError,
    model::PLAN,
    parameters::{Named, Parameters, download, upload},
    weights,
};

const FORMAT: &str = "picofarm-checkpoint-3";

/// Before the names of kept values, and of averages.
const KEPT: &str = "kept/";
const AVERAGE: &str = "average/";

/// What a checkpoint holds beside tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Header {
    format: String,
    steps: u64,
    pub(super) position: Position,
    /// The plan's text: a checkpoint goes on only with the plan it was made with.
    pub(super) plan: String,
}

/// `kept` are the values after the epoch whose validation was the best, where those count at the end.
pub(super) fn write(
    learner: &Learner,
    position: &Position,
    kept: Option<&Parameters>,
    plan: &str,
) -> Vec<u8> {
    let mut named = Named::new();
    for (name, value) in learner.parameters.to_named() {
        named.insert(format!("weights/{name}"), value);
    }
    for (name, value) in kept.into_iter().flat_map(Parameters::to_named) {
        named.insert(format!("{KEPT}{name}"), value);
    }
    let average = learner.average.iter().flat_map(|a| a.values.to_named());
    for (name, value) in average {
        named.insert(format!("{AVERAGE}{name}"), value);
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

/// Puts a learner where a checkpoint was made, and gives the values that were kept.
pub(super) fn read(
    bytes: &[u8],
    learner: &mut Learner,
    device: &Device,
) -> Result<(Header, Option<Parameters>), ModelError> {
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
    let [mut weights, mut kept, mut averaged] = [(); 3].map(|()| Named::new());
    for (name, value) in named {
        let (to, name) = match (name.strip_prefix(KEPT), name.strip_prefix(AVERAGE)) {
            (Some(name), _) => (&mut kept, name),
            (_, Some(name)) => (&mut averaged, name),
            _ => (&mut weights, name.trim_start_matches("weights/")),
        };
        to.insert(name.to_owned(), value);
    }
    let declared = || learner.net.declared().to_vec();
    let kept = match kept.is_empty() {
        true => None,
        false => Some(Parameters::from_named(declared(), kept, device)?),
    };
    if let Some(average) = &mut learner.average {
        average.values = Parameters::from_named(declared(), averaged, device)?;
    }
    learner.parameters = Parameters::from_named(declared(), weights, device)?;
    learner.steps = header.steps;
    Ok((header, kept))
}

/// What a training would leave if it ended where a checkpoint was made: the weights, as safetensors, and the line of each epoch.
///
/// # Errors
/// [`ModelError::Weights`] where it is no checkpoint.
pub fn left_by(bytes: &[u8]) -> Result<(Vec<u8>, Vec<Line>), ModelError> {
    let (named, metadata) = weights::read(bytes)?;
    let none = || ModelError::weights("these are no checkpoint of a training, only weights");
    let header = metadata.get("checkpoint").ok_or_else(none)?;
    let header: Header = serde_json::from_str(header)
        .map_err(|e| ModelError::weights(format!("the checkpoint's header: {e}")))?;
    let there = |part: &&str| named.keys().any(|name| name.starts_with(part));
    let part = [KEPT, AVERAGE]
        .into_iter()
        .find(there)
        .unwrap_or("weights/");
    let of_part = named.into_iter();
    let of_part = of_part.filter_map(|(name, v)| Some((name.strip_prefix(part)?.to_owned(), v)));
    let named = weights::to_torch(of_part.collect());
    let plan = BTreeMap::from([(PLAN.to_owned(), header.plan)]);
    Ok((weights::write(&named, &plan), header.position.history))
}
