//! A network with its parameters and the optimiser's state, trained step by step.

use burn::tensor::{Device, Tensor};

use rayon::{iter::ParallelIterator, slice::ParallelSlice};

use super::{
    gradients::{Gradients, Summed},
    group::Block,
    loss::{Loss, loss},
    schedule::Pace,
};
use crate::{
    ModelError,
    input::{Batch, Target},
    kernel::AdamW,
    net::{Cut, Input, Net, Pass},
    ops,
    parameters::{Declared, Id, Parameters, download, upload},
};

/// AdamW's decay of the second moment: PyTorch's default.
const BETA2: f64 = 0.999;
/// AdamW's epsilon: PyTorch's default.
const EPSILON: f64 = 1e-8;

/// A network in training.
pub struct Learner {
    pub(super) net: Net,
    pub(super) parameters: Parameters,
    /// AdamW's moments of each parameter; empty for parameters that are not learned.
    pub(super) moments: Vec<[Tensor<1>; 2]>,
    /// The number of steps taken.
    pub(super) steps: u64,
    /// The average of the parameters, if the plan requires one.
    pub(super) average: Option<Average>,
    /// The greatest norm of a step's gradient.
    clip_norm: Option<f64>,
    target: Target,
    decay: f64,
    pub(super) device: Device,
}

/// An exponential moving average of all parameters of a network, running statistics included.
pub struct Average {
    decay: f64,
    pub(super) values: Parameters,
}

/// The number of values in a partial sum of squares.
const SQUARED: usize = 1 << 16;

/// The results of a batch: gradients, loss, and the running statistics after it.
struct OfBatch {
    summed: Summed,
    moved: Vec<(Id, Tensor<1>)>,
}

/// The result of a forward pass.
pub(super) struct Forward {
    pub(super) leaves: Vec<Tensor<1>>,
    output: Tensor<4>,
    pub(super) losses: Loss,
    pub(super) root: Tensor<1>,
    pub(super) moved: Vec<(Id, Tensor<1>)>,
    pub(super) cuts: Vec<Cut>,
}

/// A batch on a learner's device.
pub struct Brought {
    input: Input,
    target: Vec<f32>,
}

impl Learner {
    /// Creates a learner that has taken no step. `device` has no autodiff.
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
            average: None,
            clip_norm: None,
            target,
            decay,
            device,
        }
    }

    /// Limits the norm of the learner's gradients.
    #[must_use]
    pub fn clipped(self, norm: Option<f64>) -> Self {
        Self {
            clip_norm: norm,
            ..self
        }
    }

    /// Makes the learner maintain an average of its parameters, starting with their current values.
    /// After step t the average is d times its previous value plus (1 − d) times the parameters,
    /// with d the lesser of `decay` and (1 + t)/(10 + t).
    #[must_use]
    pub fn averaging(self, decay: Option<f64>) -> Self {
        let values = || self.parameters.clone();
        let average = decay.map(|decay| Average {
            decay,
            values: values(),
        });
        Self { average, ..self }
    }

    /// Returns the parameters that are validated and stored: their average if there is one.
    pub fn kept(&self) -> &Parameters {
        match &self.average {
            Some(average) => &average.values,
            None => &self.parameters,
        }
    }

    /// Returns the network.
    pub fn net(&self) -> &Net {
        &self.net
    }

    /// Returns the parameters.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Waits until the device has finished all its work, so that a measurement of time is complete.
    ///
    /// # Errors
    /// The driver's error.
    pub fn wait(&self) -> Result<(), String> {
        self.device.sync().map_err(|error| error.to_string())
    }

    /// Returns the number of steps taken.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Returns the network's output, the loss, and the gradient of every learned parameter in the
    /// order of declaration. Updates the running statistics.
    pub(crate) fn gradients(&mut self, batch: Batch) -> (Vec<f32>, f32, Vec<Option<Tensor<1>>>) {
        let (output, of) = self.backward(self.bring(batch));
        self.move_statistics(of.moved);
        let said = output.into_data_as::<f32>();
        let said = said.try_into_vec().expect("asked for f32");
        (said, of.summed.losses.value(), of.summed.gradients)
    }

    fn move_statistics(&mut self, moved: Vec<(Id, Tensor<1>)>) {
        for (id, value) in moved {
            self.parameters.set(id, value);
        }
    }

    /// Transfers a batch to the device. A graphics processor continues its earlier work meanwhile.
    pub fn bring(&self, batch: Batch) -> Brought {
        let (input, target) = batch.into_input(&self.device.clone().autodiff());
        Brought { input, target }
    }

    /// Returns whether the device computes asynchronously, so that batches are best transferred
    /// while it computes.
    pub fn computes_apart(&self) -> bool {
        !ops::has_kernels(&self.device)
    }

    /// Computes the network's output for a batch, and the graph from which its gradients are
    /// computed. If `apart` is set, each segment has a graph of its own.
    pub(super) fn forward(&self, batch: Brought, apart: bool) -> Forward {
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
        if apart {
            pass = pass.in_segments();
        }
        let output = self.net.forward(&mut pass, batch.input);
        let (moved, cuts) = pass.into_moved();
        let (losses, root) = loss(self.target, output.clone(), &batch.target);
        Forward {
            leaves,
            output,
            losses,
            root,
            moved,
            cuts,
        }
    }

    fn backward(&self, batch: Brought) -> (Tensor<4>, OfBatch) {
        let forward = self.forward(batch, false);
        let mut gradients = forward.root.backward();
        let of = forward.leaves.iter();
        let summed = Summed {
            gradients: of.map(|leaf| leaf.grad_remove(&mut gradients)).collect(),
            losses: forward.losses,
        };
        let moved = forward.moved;
        (forward.output.inner(), OfBatch { summed, moved })
    }

    /// Takes one optimiser step along the averaged gradients of some batches. Returns the mean
    /// loss.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; the learner is then unchanged.
    pub fn step(&mut self, batches: Vec<Batch>, pace: Pace) -> Result<f32, ModelError> {
        let mut sum = Gradients::default();
        let count = batches.len();
        for (at, batch) in batches.into_iter().enumerate() {
            self.add(&mut sum, at, self.bring(batch))?;
        }
        self.finish(sum, count, pace)
    }

    /// Takes a step along each of some batches, as a training does: the next batch is transferred
    /// to a graphics processor while it computes.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; the learner is then in the state after the previous step.
    pub fn steps_along(&mut self, batches: Vec<Batch>, pace: Pace) -> Result<(), ModelError> {
        let mut batches = batches.into_iter();
        let mut ahead = None;
        while let Some(batch) = ahead.take().or_else(|| Some(self.bring(batches.next()?))) {
            let mut sum = Gradients::default();
            self.add(&mut sum, 0, batch)?;
            if self.computes_apart() {
                ahead = batches.next().map(|batch| self.bring(batch));
            }
            self.finish(sum, 1, pace)?;
        }
        Ok(())
    }

    /// Adds the gradients of batch `at` of a step to those of earlier batches, and releases the
    /// batch. Running statistics follow the first batch of a step. When this returns, a graphics
    /// processor has started this batch and finished the previous one.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; the learner is then unchanged.
    pub fn add(&self, sum: &mut Gradients, at: usize, batch: Brought) -> Result<(), ModelError> {
        if let Some(latest) = sum.latest.take() {
            self.finite(latest)?;
        }
        let (_, of) = self.backward(batch);
        self.unbroken(&of.summed.losses)?;
        sum.latest = Some(of.summed.losses.clone());
        if at == 0 {
            sum.moved = of.moved;
        }
        let block = Block {
            begin: at,
            len: 1,
            sum: of.summed,
        };
        sum.blocks.push(block, &mut Summed::add);
        Ok(())
    }

    /// If a loss is already known, checks that it is finite.
    pub(super) fn unbroken(&self, losses: &Loss) -> Result<(), ModelError> {
        match losses.is_broken() {
            true => Err(self.not_finite(losses.clone().value())),
            false => Ok(()),
        }
    }

    /// Returns the value of a loss; waits for the device.
    pub(super) fn finite(&self, loss: Loss) -> Result<f32, ModelError> {
        let loss = loss.value();
        match loss.is_finite() {
            true => Ok(loss),
            false => Err(self.not_finite(loss)),
        }
    }

    /// Takes the optimiser step along the mean of the gradients of all its batches. Returns the
    /// mean loss.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; the learner is then unchanged.
    ///
    /// # Panics
    /// If some of the batches are missing.
    pub fn finish(
        &mut self,
        sum: Gradients,
        batches: usize,
        pace: Pace,
    ) -> Result<f32, ModelError> {
        assert!(sum.blocks.is_whole(batches), "a step has all its batches");
        let summed = sum
            .blocks
            .total(&mut Summed::add)
            .expect("a step has a batch");
        // The loss over all batches, including those of other processes.
        let losses = self.finite(summed.losses)?;
        self.move_statistics(sum.moved);
        let share = 1.0 / batches as f32;
        let scale = share * self.shortened(&summed.gradients, share);
        self.steps += 1;
        let settings = AdamW {
            learning_rate: pace.learning_rate,
            beta1: pace.beta1,
            beta2: BETA2,
            eps: EPSILON,
            decay: self.decay,
            step: u32::try_from(self.steps).unwrap_or(u32::MAX),
        };
        for (i, gradient) in summed.gradients.into_iter().enumerate() {
            let Some(mut gradient) = gradient else {
                continue;
            };
            if scale != 1.0 {
                gradient = gradient.mul_scalar(scale);
            }
            let value = self.parameters.take(Id(i));
            let empty = [(); 2].map(|()| Tensor::empty([0], &self.device));
            let moments = std::mem::replace(&mut self.moments[i], empty);
            let (value, moments) = ops::adamw(settings, value, gradient, moments);
            self.parameters.set(Id(i), value);
            self.moments[i] = moments;
        }
        self.follow();
        Ok(losses * share)
    }

    /// Returns the factor that limits the norm of a step's gradient, which is `share` times
    /// `summed`.
    fn shortened(&self, summed: &[Option<Tensor<1>>], share: f32) -> f32 {
        let Some(most) = self.clip_norm else {
            return 1.0;
        };
        let squares: f64 = summed.iter().flatten().map(squares).sum();
        // The constant is PyTorch's.
        let scale = most / (squares.sqrt() * f64::from(share) + 1e-6);
        match scale < 1.0 {
            true => scale as f32,
            false => 1.0,
        }
    }

    /// Updates the average after a step.
    fn follow(&mut self) {
        let Some(average) = &mut self.average else {
            return;
        };
        let step = self.steps as f64;
        let decay = average.decay.min((1.0 + step) / (10.0 + step));
        for (i, value) in self.parameters.values().iter().enumerate() {
            let before = average.values.take(Id(i));
            let moved = before.mul_scalar(decay) + value.clone().mul_scalar(1.0 - decay);
            average.values.set(Id(i), moved);
        }
    }

    /// Returns a digest of all parameters (FNV-1a over their bits). Processes that train together
    /// have the same digest.
    pub fn digest(&self) -> u64 {
        let values = self.parameters.values().iter().flat_map(download);
        values.fold(0xcbf2_9ce4_8422_2325, |hash, value| {
            (hash ^ u64::from(value.to_bits())).wrapping_mul(0x0100_0000_01b3)
        })
    }

    /// Returns the network's output in evaluation: (N, outputs, H, W), row by row.
    pub fn predict(&self, batch: &Batch) -> Vec<f32> {
        predict(&self.net, self.kept(), batch)
    }

    /// Returns the name of the first parameter with a non-finite value.
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

/// Returns the sum of squares, in an order that does not depend on the threads.
fn squares(values: &Tensor<1>) -> f64 {
    let values = download(values);
    let parts: Vec<f64> = values
        .par_chunks(SQUARED)
        .map(|part| part.iter().map(|x| f64::from(*x) * f64::from(*x)).sum())
        .collect();
    parts.iter().sum()
}

/// Returns a network's output in evaluation: (N, outputs, H, W), row by row.
pub fn predict(net: &Net, parameters: &Parameters, batch: &Batch) -> Vec<f32> {
    let device = parameters.values()[0].device();
    let mut pass = Pass::evaluation(parameters);
    let output = net.forward(&mut pass, batch.input(&device));
    let data = output.into_data_as::<f32>();
    data.try_into_vec().expect("asked for f32")
}
