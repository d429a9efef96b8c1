//! A trained network that answers queries. Its weights file contains the description of the
//! network.

use burn::tensor::Device;

use crate::{
    ModelError,
    device::computes,
    input::{Batch, Question, Target, Visit, example},
    net::Net,
    parameters::Parameters,
    scene::Scene,
    train::{Plan, predict},
    weights,
};

/// A trained network.
#[derive(Debug, Clone)]
pub struct Model {
    plan: Plan,
    net: Net,
    parameters: Parameters,
}

/// The metadata entry of a weights file that contains the [`Plan`] as JSON.
pub const PLAN: &str = "plan";

impl Model {
    /// Reads the bytes that [`crate::train::Training::finish`] returned.
    ///
    /// # Errors
    /// [`ModelError::File`] if the bytes are damaged, [`ModelError::Weights`] if they contain no
    /// plan, [`ModelError::Values`] if no network can compute with them.
    pub fn read(bytes: &[u8], device: &Device) -> Result<Self, ModelError> {
        let (named, metadata) = weights::read(bytes)?;
        let plan = metadata.get(PLAN).ok_or_else(|| {
            ModelError::weights(
                "the weights do not say what network they are of: no \"plan\" in their metadata",
            )
        })?;
        let plan: Plan = serde_json::from_str(plan)
            .map_err(|e| ModelError::weights(format!("the weights' plan: {e}")))?;
        computes(&plan.net, device)?;
        let net = Net::new(plan.net.clone())?;
        let named = weights::from_torch(named, net.declared(), plan.question.part())?;
        weights::check(&named)?;
        let parameters = Parameters::from_named(net.declared().to_vec(), named, device)?;
        Ok(Self {
            plan,
            net,
            parameters,
        })
    }

    /// Converts weights that were trained elsewhere, with PyTorch's names, to bytes for
    /// [`Model::read`]. They must be the weights of a network of `plan`. If a file contains a depth
    /// and a shadow network, the plan decides which one is read.
    ///
    /// # Errors
    /// [`ModelError::File`] if the bytes are damaged, [`ModelError::Weights`] if a tensor is
    /// missing or has another shape, [`ModelError::Values`] if one contains a non-finite
    /// number or a negative variance.
    pub fn import(bytes: &[u8], plan: &Plan, device: &Device) -> Result<Vec<u8>, ModelError> {
        let net = Net::new(plan.net.clone())?;
        let declared = net.declared();
        let (named, _) = weights::read(bytes)?;
        let named = weights::from_torch(named, declared, plan.question.part())?;
        weights::check(&named)?;
        let parameters = Parameters::from_named(declared.to_vec(), named, device)?;
        let named = weights::to_torch(parameters.to_named());
        Ok(weights::write(
            &named,
            &[(PLAN.to_owned(), plan.text())].into(),
        ))
    }

    /// Returns the plan by which the network was trained.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Returns the question that the network answers.
    pub fn question(&self) -> &Question {
        &self.plan.question
    }

    /// Returns the number of learned values.
    pub fn learned(&self) -> usize {
        self.parameters.learned()
    }

    /// Returns the network's output for a batch: (N, outputs, H, W), row by row.
    pub fn answer(&self, batch: &Batch) -> Vec<f32> {
        predict(&self.net, &self.parameters, batch)
    }

    /// Like [`Self::answer`], but checks that all numbers are finite. `spot` is the spot that the
    /// batch asks about.
    ///
    /// # Errors
    /// [`ModelError::Answer`] naming the first non-finite number.
    pub(crate) fn finite_answer(
        &self,
        batch: &Batch,
        spot: Option<usize>,
    ) -> Result<Vec<f32>, ModelError> {
        let said = self.answer(batch);
        match said.iter().position(|value| !value.is_finite()) {
            None => Ok(said),
            Some(at) => Err(not_finite(&said, at, batch, spot)),
        }
    }

    /// Returns the depths of a scene in metres: `[row][column]`.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] if the model is not a depth network or the scene does not fit it;
    /// [`ModelError::Answer`] if the output contains a non-finite number.
    pub fn depth_m(&self, scene: &Scene) -> Result<Vec<f32>, ModelError> {
        if self.question().target != Target::Tof {
            let what = "two-bounce times follow from depths; this model predicts none";
            return Err(ModelError::invalid("shadow.times", what));
        }
        let mut batch = Batch::default();
        example(&mut batch, self.question(), scene, Visit::default())?;
        let scaled = self.finite_answer(&batch, None)?;
        let scale = self.question().depth_scale_m;
        let depth = scaled.iter().map(|z| z.clamp(0.0, 1.0) * scale);
        Ok(depth.collect())
    }
}

/// Returns the error for an output with non-finite numbers. The error names the input or the
/// weights as the likely cause.
pub(crate) fn not_finite(
    said: &[f32],
    at: usize,
    batch: &Batch,
    spot: Option<usize>,
) -> ModelError {
    let (value, pixel) = (said[at], at % (batch.height * batch.width).max(1));
    let (row, column) = (pixel / batch.width.max(1), pixel % batch.width.max(1));
    let of = spot.map_or_else(String::new, |spot| format!(" of spot {spot}"));
    let fault = match batch.dense.iter().find(|x| !x.is_finite()) {
        Some(x) => format!("its input holds {x}; import or render the scene again"),
        None => "its input is finite, so its weights are at fault; train it again, or import it again from a file that works"
            .to_owned(),
    };
    ModelError::Answer {
        scene: None,
        what: format!("the network answers {value} at row {row}, column {column}{of}: {fault}"),
    }
}
