//! Checkpoints: a training stopped between two steps, as bytes with its weights, moments,
//! statistics, position and curves. A training that resumes from a checkpoint gives the same bits
//! as one that never stopped.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor};
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

const FORMAT: &str = "picofarm-checkpoint-4";

/// The prefixes of the names of kept values and of averages.
const KEPT: &str = "kept/";
const AVERAGE: &str = "average/";

/// The contents of a checkpoint other than tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Header {
    format: String,
    steps: u64,
    pub(super) position: Position,
    /// The plan's text. A checkpoint can only be resumed with the plan that made it.
    pub(super) plan: String,
}

/// The state of a training between two steps. It shares its tensors with the training, which
/// continues meanwhile: changing a shared tensor in place makes a copy first.
pub struct Snapshot {
    header: String,
    /// The tensors, in the order of their names.
    tensors: BTreeMap<String, (Vec<usize>, Tensor<1>)>,
}

impl Snapshot {
    /// Takes a snapshot. `kept` contains the values at the best validation, if the training returns
    /// those.
    pub(super) fn take(
        learner: &Learner,
        position: &Position,
        kept: Option<&Parameters>,
        plan: &str,
    ) -> Self {
        let mut tensors = BTreeMap::new();
        let average = learner.average.as_ref().map(|average| &average.values);
        let all = [
            ("weights/", Some(&learner.parameters)),
            (KEPT, kept),
            (AVERAGE, average),
        ];
        for (part, values) in all {
            let values = values.into_iter().flat_map(Parameters::named_values);
            for (d, value) in values {
                tensors.insert(
                    format!("{part}{}", d.name),
                    (d.shape.clone(), value.clone()),
                );
            }
        }
        for (d, moments) in learner.net.declared().iter().zip(&learner.moments) {
            if d.learned {
                for (part, moment) in ["m", "v"].iter().zip(moments) {
                    let name = format!("adamw.{part}/{}", d.name);
                    tensors.insert(name, (d.shape.clone(), moment.clone()));
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
        Self { header, tensors }
    }

    /// Returns the snapshot with the tensors of an engine, by prefix.
    pub(super) fn replaced(mut self, parts: BTreeMap<String, Named>) -> Self {
        let device = crate::cpu();
        for (part, named) in parts {
            for (name, (shape, value)) in named {
                let value = upload(value, &device);
                self.tensors
                    .insert(format!("{part}/{name}"), (shape, value));
            }
        }
        self
    }

    /// Returns the checkpoint as safetensors of at most `most` bytes each, excluding their headers.
    /// A tensor larger than `most` has a piece of its own. The first piece contains the training's
    /// position.
    pub fn pieces(self, most: usize) -> impl Iterator<Item = Vec<u8>> + Send {
        let mut tensors = self.tensors.into_iter().peekable();
        let mut header = Some(self.header);
        std::iter::from_fn(move || {
            if header.is_none() && tensors.peek().is_none() {
                return None;
            }
            let (mut named, mut bytes) = (Named::new(), 0_usize);
            let size = |shape: &[usize]| 4 * shape.iter().product::<usize>();
            while let Some((name, (shape, value))) = tensors
                .next_if(|(_, (shape, _))| bytes == 0 || bytes.saturating_add(size(shape)) <= most)
            {
                bytes += size(&shape);
                named.insert(name, (shape, download(&value)));
            }
            let metadata = header
                .take()
                .map(|header| ("checkpoint".to_owned(), header));
            Some(weights::write(&named, &metadata.into_iter().collect()))
        })
    }
}

/// Returns all tensors of a checkpoint's pieces, and its header.
fn gathered(pieces: &[impl AsRef<[u8]>]) -> Result<(Named, Header), ModelError> {
    let none = || ModelError::weights("these are no checkpoint of a training, only weights");
    let (mut named, mut header) = (Named::new(), None);
    for piece in pieces {
        let (part, metadata) = weights::read(piece.as_ref())?;
        named.extend(part);
        header = header.or_else(|| metadata.get("checkpoint").cloned());
    }
    let header: Header = serde_json::from_str(&header.ok_or_else(none)?)
        .map_err(|e| ModelError::weights(format!("the checkpoint's header: {e}")))?;
    Ok((named, header))
}

/// Restores a learner to the state of a checkpoint, and returns the kept values.
pub(super) fn read(
    pieces: &[impl AsRef<[u8]>],
    learner: &mut Learner,
    device: &Device,
) -> Result<(Header, Option<Parameters>), ModelError> {
    let (mut named, header) = gathered(pieces)?;
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

/// Returns the result of a training that ends at a checkpoint: the weights as safetensors, and the
/// line of each epoch.
///
/// # Errors
/// [`ModelError::Weights`] if the bytes are not a checkpoint.
pub fn left_by(pieces: &[impl AsRef<[u8]>]) -> Result<(Vec<u8>, Vec<Line>), ModelError> {
    let (named, header) = gathered(pieces)?;
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
