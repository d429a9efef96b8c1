//! A network with its numbers and the optimiser's, one step at a time.

use burn::tensor::{Device, Tensor};
use rayon::{iter::ParallelIterator, slice::ParallelSlice};

use super::{
    group::{Block, Blocks},
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

/// A network that learns.
pub struct Learner {
    pub(super) net: Net,
    pub(super) parameters: Parameters,
    /// AdamW's moments of each parameter; empty for those that are not learned.
    pub(super) moments: Vec<[Tensor<1>; 2]>,
    /// Steps taken.
    pub(super) steps: u64,
    /// The average of its numbers, where one is wanted.
    pub(super) average: Option<Average>,
    /// Greatest norm of a step's gradient.
    clip_norm: Option<f64>,
    target: Target,
    decay: f64,
    pub(super) device: Device,
}

/// An exponential moving average of all numbers of a network, running statistics too.
pub struct Average {
    decay: f64,
    pub(super) values: Parameters,
}

/// Values whose squares are summed at a time.
const SQUARED: usize = 1 << 16;

/// What follows from a batch: gradients and loss, and running statistics after it.
struct OfBatch {
    summed: Summed,
    moved: Vec<(Id, Tensor<1>)>,
}

/// A pass forward.
pub(super) struct Forward {
    pub(super) leaves: Vec<Tensor<1>>,
    output: Tensor<4>,
    pub(super) losses: Loss,
    pub(super) root: Tensor<1>,
    pub(super) moved: Vec<(Id, Tensor<1>)>,
    pub(super) cuts: Vec<Cut>,
}

/// Gradients of a step's batches, summed as [`Blocks`] are.
#[derive(Default)]
pub struct Gradients {
    pub(super) blocks: Blocks<Summed>,
    /// Running statistics after the step's first batch, where that is among them.
    pub(super) moved: Vec<(Id, Tensor<1>)>,
    /// Of the batch that was added last.
    pub(super) latest: Option<Loss>,
}

/// A batch on the device of a learner.
pub struct Brought {
    input: Input,
    target: Vec<f32>,
}

/// Gradients of every parameter by declaration, none of those that are not learned, and losses; summed over batches.
pub(super) struct Summed {
    pub(super) gradients: Vec<Option<Tensor<1>>>,
    pub(super) losses: Loss,
}

impl Summed {
    /// So many numbers: gradients by declaration, and the loss.
    pub(super) fn numbers(&self, len: usize) -> Vec<f32> {
        let mut values = Vec::with_capacity(len);
        for gradient in self.gradients.iter().flatten() {
            values.extend(download(gradient));
        }
        values.push(self.losses.clone().value());
        values
    }

    pub(super) fn add(one: Self, other: Self) -> Self {
        let both = one.gradients.into_iter().zip(other.gradients);
        Self {
            gradients: both.map(|(a, b)| Some(a? + b?)).collect(),
            losses: one.losses.plus(other.losses),
        }
    }
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
            average: None,
            clip_norm: None,
            target,
            decay,
            device,
        }
    }

    /// The same whose gradients are at most so long.
    #[must_use]
    pub fn clipped(self, norm: Option<f64>) -> Self {
        Self {
            clip_norm: norm,
            ..self
        }
    }

    /// The same that keeps an average of its numbers, which begins with those it has. After step t an average is d times what it was
    /// plus (1 − d) times the numbers, with d the lesser of `decay` and (1 + t)/(10 + t).
    #[must_use]
    pub fn averaging(self, decay: Option<f64>) -> Self {
        let values = || self.parameters.clone();
        let average = decay.map(|decay| Average {
            decay,
            values: values(),
        });
        Self { average, ..self }
    }

    /// The numbers that are validated and kept: their average where there is one.
    pub fn kept(&self) -> &Parameters {
        match &self.average {
            Some(average) => &average.values,
            None => &self.parameters,
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

    /// Waits until the device has done all it was given: what is measured ends then.
    ///
    /// # Errors
    /// What its driver failed with.
    pub fn wait(&self) -> Result<(), String> {
        self.device.sync().map_err(|error| error.to_string())
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// What the network said, loss, and the gradient of every learned parameter by declaration; moves the running
    /// statistics.
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

    /// Brings a batch to the device. What a graphics processor was given before it still computes meanwhile.
    pub fn bring(&self, batch: Batch) -> Brought {
        let (input, target) = batch.into_input(&self.device.clone().autodiff());
        Brought { input, target }
    }

    /// Whether the device computes by itself, so that batches are better brought while it does.
    pub fn computes_apart(&self) -> bool {
        !ops::has_kernels(&self.device)
    }

    /// What the network says of a batch, and what its gradients are computed from; `apart` with a graph for each segment.
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

    /// One step of the optimiser over batches, whose gradients are averaged. Returns the mean loss.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; everything is then as before.
    pub fn step(&mut self, batches: Vec<Batch>, pace: Pace) -> Result<f32, ModelError> {
        let mut sum = Gradients::default();
        let count = batches.len();
        for (at, batch) in batches.into_iter().enumerate() {
            self.add(&mut sum, at, self.bring(batch))?;
        }
        self.finish(sum, count, pace)
    }

    /// A step along each of some batches, as a training takes them: a graphics processor gets the next one while it computes.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; everything is then as after the step before.
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

    /// Adds the gradients of batch `at` of a step to those before it, and lets go of the batch. Running statistics follow the
    /// first batch of a step. A graphics processor has then begun with it, and is done with the batch before.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; everything is then as before.
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

    /// Where a loss is known already, whether it is a number.
    pub(super) fn unbroken(&self, losses: &Loss) -> Result<(), ModelError> {
        match losses.is_broken() {
            true => Err(self.not_finite(losses.clone().value())),
            false => Ok(()),
        }
    }

    /// What a loss is; waits for the device.
    pub(super) fn finite(&self, loss: Loss) -> Result<f32, ModelError> {
        let loss = loss.value();
        match loss.is_finite() {
            true => Ok(loss),
            false => Err(self.not_finite(loss)),
        }
    }

    /// Takes the step of the optimiser along the mean of the gradients of all its batches. Returns the mean loss.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; everything is then as before.
    ///
    /// # Panics
    /// Where some of them are missing.
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
        // Of all batches, those of other processes too.
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

    /// What a step's gradient, `share` times `summed`, is to be multiplied by so that it is not too long.
    fn shortened(&self, summed: &[Option<Tensor<1>>], share: f32) -> f32 {
        let Some(most) = self.clip_norm else {
            return 1.0;
        };
        let squares: f64 = summed.iter().flatten().map(squares).sum();
        // PyTorch's constant.
        let scale = most / (squares.sqrt() * f64::from(share) + 1e-6);
        match scale < 1.0 {
            true => scale as f32,
            false => 1.0,
        }
    }

    /// Moves the average after a step.
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

    /// A digest of all parameters (FNV-1a over their bits): processes that train together have the same.
    pub fn digest(&self) -> u64 {
        let values = self.parameters.values().iter().flat_map(download);
        values.fold(0xcbf2_9ce4_8422_2325, |hash, value| {
            (hash ^ u64::from(value.to_bits())).wrapping_mul(0x0100_0000_01b3)
        })
    }

    /// What the network says in evaluation: (N, outputs, H, W), row by row.
    pub fn predict(&self, batch: &Batch) -> Vec<f32> {
        predict(&self.net, self.kept(), batch)
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

/// The sum of squares, in one order whatever the threads.
fn squares(values: &Tensor<1>) -> f64 {
    let values = download(values);
    let parts: Vec<f64> = values
        .par_chunks(SQUARED)
        .map(|part| part.iter().map(|x| f64::from(*x) * f64::from(*x)).sum())
        .collect();
    parts.iter().sum()
}

/// What a network says in evaluation: (N, outputs, H, W), row by row.
pub fn predict(net: &Net, parameters: &Parameters, batch: &Batch) -> Vec<f32> {
    let device = parameters.values()[0].device();
    let mut pass = Pass::evaluation(parameters);
    let output = net.forward(&mut pass, batch.input(&device));
    let data = output.into_data_as::<f32>();
    data.try_into_vec().expect("asked for f32")
}
