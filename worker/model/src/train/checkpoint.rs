//! A training, stopped anywhere between two steps, as bytes: weights, moments, statistics, position, curves. What goes on
//! from them is to the bit what would have gone on without stopping.

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

/// What a training is between two steps. It shares its numbers with the training, which goes on meanwhile: whatever changes
/// them in place makes a copy first.
pub struct Snapshot {
    header: String,
    /// In the order of their names.
    tensors: BTreeMap<String, (Vec<usize>, Tensor<1>)>,
}

impl Snapshot {
    /// `kept` are the values at the best validation, where those count at the end.
    pub(super) fn of(
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

    /// The checkpoint as safetensors of at most `most` bytes each, but for a tensor that is larger, and their headers. The first
    /// says where the training stands.
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

/// All tensors of a checkpoint's pieces, and its header.
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

/// Puts a learner where a checkpoint was made, and gives the values that were kept.
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

/// What a training would leave if it ended where a checkpoint was made: the weights, as safetensors, and the line of each epoch.
///
/// # Errors
/// [`ModelError::Weights`] where it is no checkpoint.
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
