//! A network with its numbers and the optimiser's, one step at a time.

use burn::tensor::{Device, Tensor};

use super::{loss::loss, schedule::Pace};
use crate::{
    ModelError,
    input::{Batch, Target},
    kernel::AdamW,
    net::{Net, Pass},
    ops,
    parameters::{Declared, Id, Parameters, upload},
};

/// AdamW's decay of the second moment: PyTorch's default.
const BETA2: f64 = 0.999;
/// AdamW's epsilon: PyTorch's default.
const EPSILON: f64 = 1e-8;

/// A network that learns.
pub struct Learner {
    pub(super) net: Net,
    pub(super) parameters: Parameters,
    /// AdamW's moments of each parameter; empty for those that are not learned.
    pub(super) moments: Vec<[Tensor<1>; 2]>,
    /// Steps taken.
    pub(super) steps: u64,
    target: Target,
    decay: f64,
    device: Device,
}

/// Gradients of a step's batches, summed in their order: as much memory as one batch's.
#[derive(Default)]
pub struct Gradients {
    /// Of every parameter by declaration; none of those that are not learned.
    sums: Vec<Option<Tensor<1>>>,
    losses: f32,
    batches: usize,
}

impl Learner {
    /// A learner that has taken no step; without autodiff on `device`.
    pub fn new(net: Net, parameters: Parameters, target: Target, decay: f64) -> Self {
        let device = parameters.values()[0].device();
        let zeros = |d: &Declared| {
            let len = if d.learned { d.len() } else { 0 };
            [(); 2].map(|()| upload(vec![0.0; len], &device))
        };
        let moments = net.declared().iter().map(zeros).collect();
        Self {
            net,
            parameters,
            moments,
            steps: 0,
            target,
            decay,
            device,
        }
    }

    /// The network.
    pub fn net(&self) -> &Net {
        &self.net
    }

    /// Its numbers.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// What the network said, loss, and the gradient of every learned parameter by declaration; moves the running
    /// statistics.
    pub(crate) fn gradients(&mut self, batch: Batch) -> (Vec<f32>, f32, Vec<Option<Tensor<1>>>) {
        let (output, loss, gradients) = self.backward(batch);
        let said = output.into_data_as::<f32>();
        (said.try_into_vec().expect("asked for f32"), loss, gradients)
    }

    fn backward(&mut self, batch: Batch) -> (Tensor<4>, f32, Vec<Option<Tensor<1>>>) {
        let device = self.device.clone().autodiff();
        let leaves: Vec<Tensor<1>> = self
            .net
            .declared()
            .iter()
            .zip(self.parameters.values())
            .map(|(d, value)| match d.learned {
                true => value.clone().autodiff().require_grad(),
                false => value.clone().autodiff(),
            })
            .collect();
        let mut pass = Pass::training(self.net.declared(), &leaves);
        let (input, target) = batch.into_input(&device);
        let output = self.net.forward(&mut pass, input);
        let moved = pass.into_moved();
        let (loss, root) = loss(self.target, output.clone(), &target);
        let mut gradients = root.backward();
        let of = leaves.iter().map(|leaf| leaf.grad_remove(&mut gradients));
        let of = of.collect();
        for (id, value) in moved {
            self.parameters.set(id, value);
        }
        (output.inner(), loss, of)
    }

    /// One step of the optimiser over batches, whose gradients are averaged. Returns the mean loss.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; the parameters are then as before, the running statistics are not.
    pub fn step(&mut self, batches: &[Batch], pace: Pace) -> Result<f32, ModelError> {
        let mut sum = Gradients::default();
        for batch in batches {
            self.add(&mut sum, batch.clone())?;
        }
        Ok(self.finish(sum, pace))
    }

    /// Adds a batch's gradients to those of a step, and lets go of the batch.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; the parameters are then as before, the running statistics are not.
    pub fn add(&mut self, sum: &mut Gradients, batch: Batch) -> Result<(), ModelError> {
        let (_, loss, gradients) = self.backward(batch);
        if !loss.is_finite() {
            return Err(self.not_finite(loss));
        }
        sum.losses += loss;
        sum.sums = match sum.batches {
            0 => gradients,
            _ => std::mem::take(&mut sum.sums)
                .into_iter()
                .zip(gradients)
                .map(|(a, b)| Some(a? + b?))
                .collect(),
        };
        sum.batches += 1;
        Ok(())
    }

    /// Takes the step of the optimiser along the mean of gradients. Returns the mean loss.
    ///
    /// # Panics
    /// Where there are none.
    pub fn finish(&mut self, sum: Gradients, pace: Pace) -> f32 {
        assert!(sum.batches > 0, "a step has a batch");
        let share = 1.0 / sum.batches as f32;
        self.steps += 1;
        let settings = AdamW {
            learning_rate: pace.learning_rate,
            beta1: pace.beta1,
            beta2: BETA2,
            eps: EPSILON,
            decay: self.decay,
            step: u32::try_from(self.steps).unwrap_or(u32::MAX),
        };
        for (i, gradient) in sum.sums.into_iter().enumerate() {
            let Some(mut gradient) = gradient else {
                continue;
            };
            if sum.batches > 1 {
                gradient = gradient.mul_scalar(share);
            }
            let value = self.parameters.take(Id(i));
            let empty = [(); 2].map(|()| Tensor::empty([0], &self.device));
            let moments = std::mem::replace(&mut self.moments[i], empty);
            let (value, moments) = ops::adamw(settings, value, gradient, moments);
            self.parameters.set(Id(i), value);
            self.moments[i] = moments;
        }
        sum.losses * share
    }

    /// What the network says in evaluation: (N, outputs, H, W), row by row.
    pub fn predict(&self, batch: &Batch) -> Vec<f32> {
        predict(&self.net, &self.parameters, batch)
    }

    /// The name of the first parameter that is not finite.
    pub fn broken(&self) -> Option<&str> {
        let each = self.net.declared().iter().zip(self.parameters.values());
        for (d, value) in each {
            let sum = value.clone().abs().sum().into_scalar::<f32>();
            if !sum.is_finite() {
                return Some(&d.name);
            }
        }
        None
    }

    fn not_finite(&self, loss: f32) -> ModelError {
        let first = match self.broken() {
            Some(name) => format!("{name} is not finite"),
            None => "every parameter is finite, so it arose in this batch".to_owned(),
        };
        ModelError::NotFinite {
            step: self.steps,
            what: format!("the loss is {loss}; {first}"),
        }
    }
}

/// What a network says in evaluation: (N, outputs, H, W), row by row.
pub fn predict(net: &Net, parameters: &Parameters, batch: &Batch) -> Vec<f32> {
    let device = parameters.values()[0].device();
    let mut pass = Pass::evaluation(parameters);
    let output = net.forward(&mut pass, batch.input(&device));
    let data = output.into_data_as::<f32>();
    data.try_into_vec().expect("asked for f32")
}
