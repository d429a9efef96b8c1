//! Training steps that another program computes, in place of this crate's networks.
//!
//! The training keeps everything else: the order of visits, the batches, the schedule, the history
//! and the decision to stop. Its learner mirrors the engine's state when that is needed.

use std::{cell::RefCell, collections::BTreeMap, time::Instant};

use super::{clock::Clock, learner::Learner, load::Ready, run::Training, schedule::Pace};
use crate::{
    ModelError,
    input::Batch,
    parameters::{Named, Parameters},
    weights,
};

/// Computes the steps of a training. A state is safetensors whose tensors have PyTorch's names and
/// shapes behind a prefix: `weights/`, `adamw.m/`, `adamw.v/` and, if the plan requires an average,
/// `average/`.
pub trait Engine {
    /// Takes over a state after the given number of steps.
    ///
    /// # Errors
    /// Any reason why the engine cannot continue.
    fn load(&mut self, state: &[u8], steps: u64) -> Result<(), ModelError>;

    /// Returns the current state; the moments of AdamW only if `moments` is set.
    ///
    /// # Errors
    /// As for [`Self::load`].
    fn state(&mut self, moments: bool) -> Result<Vec<u8>, ModelError>;

    /// Takes a step along the mean of the gradients of the plan's `accumulate` next batches, and
    /// returns their mean loss. The engine may take a batch of the following step ahead. `next`
    /// returns `None` after the last batch.
    ///
    /// # Errors
    /// As for [`Self::load`], and errors of `next`.
    fn step(
        &mut self,
        pace: Pace,
        next: &mut dyn FnMut() -> Result<Option<Batch>, ModelError>,
    ) -> Result<f32, ModelError>;

    /// Drops batches that were taken ahead: the next step begins elsewhere.
    fn rewind(&mut self);

    /// Returns the network's output in evaluation: (N, outputs, H, W), row by row. It is that of
    /// the average of the weights if there is one.
    ///
    /// # Errors
    /// As for [`Self::load`].
    fn predict(&mut self, batch: &Batch) -> Result<Vec<f32>, ModelError>;
}

impl Training {
    /// Computes the following steps with an engine.
    ///
    /// # Errors
    /// Those of [`Engine::load`].
    pub fn on(mut self, mut engine: Box<dyn Engine>) -> Result<Self, ModelError> {
        let state = weights::write(&self.learner.state(), &BTreeMap::new());
        engine.load(&state, self.learner.steps())?;
        self.engine = Some(RefCell::new(engine));
        Ok(self)
    }

    /// Takes a step with the engine. Returns its loss.
    pub(super) fn step_outside(
        &mut self,
        engine: &RefCell<Box<dyn Engine>>,
        ready: &Ready<'_>,
        clock: &mut Clock,
    ) -> Result<f32, ModelError> {
        let pace = self.pace(self.learner.steps());
        let mut next = || {
            if ready.is_over() {
                return Ok(None);
            }
            let since = Instant::now();
            let batch = ready.next()?;
            clock.waited += since.elapsed();
            Ok(Some(batch))
        };
        let loss = engine.borrow_mut().step(pace, &mut next)?;
        if !loss.is_finite() {
            let step = self.learner.steps();
            let what = format!("the loss is {loss}");
            return Err(ModelError::NotFinite { step, what });
        }
        self.learner.steps += 1;
        Ok(loss)
    }

    /// Copies the engine's weights to the learner. Without an engine they are there.
    pub(super) fn mirror(&mut self) -> Result<(), ModelError> {
        let Some(engine) = &self.engine else {
            return Ok(());
        };
        let state = engine.borrow_mut().state(false)?;
        self.learner.adopt(&state, self.plan.question.part())
    }

    /// Returns the network's output in evaluation.
    pub(super) fn predict(&self, batch: &Batch) -> Result<Vec<f32>, ModelError> {
        match &self.engine {
            Some(engine) => engine.borrow_mut().predict(batch),
            None => Ok(self.learner.predict(batch)),
        }
    }
}

impl Learner {
    /// Returns the state for an engine.
    fn state(&self) -> Named {
        let named = |values: &Parameters| weights::to_torch(values.to_named());
        let average = self.average.as_ref().map(|average| named(&average.values));
        let [m, v] = self.moments_named().map(weights::to_torch);
        let parts = [
            ("weights", Some(named(&self.parameters))),
            ("adamw.m", Some(m)),
            ("adamw.v", Some(v)),
            ("average", average),
        ];
        let parts = parts.into_iter();
        let parts = parts.filter_map(|(part, named)| Some((part, named?)));
        parts
            .flat_map(|(part, named)| {
                let prefixed = move |(name, value)| (format!("{part}/{name}"), value);
                named.into_iter().map(prefixed)
            })
            .collect()
    }

    /// Takes over the weights of an engine's state, and their average.
    fn adopt(&mut self, state: &[u8], part: &str) -> Result<(), ModelError> {
        let mut parts = self.parts_of(state, part)?;
        let declared = || self.net.declared().to_vec();
        let mut take = |part: &str| {
            let named = parts.remove(part).unwrap_or_default();
            Parameters::from_named(declared(), named, &self.device)
        };
        let weights = take("weights")?;
        if let Some(average) = &mut self.average {
            average.values = take("average")?;
        }
        self.parameters = weights;
        Ok(())
    }

    /// Returns the tensors of an engine's state by prefix, with this crate's names.
    pub(super) fn parts_of(
        &self,
        state: &[u8],
        part: &str,
    ) -> Result<BTreeMap<String, Named>, ModelError> {
        let mut parts: BTreeMap<String, Named> = BTreeMap::new();
        for (name, value) in weights::read(state)?.0 {
            let Some((prefix, name)) = name.split_once('/') else {
                let what = format!("{name:?} is no tensor of a state");
                return Err(ModelError::weights(what));
            };
            let of = parts.entry(prefix.to_owned()).or_default();
            of.insert(name.to_owned(), value);
        }
        let ours = |named| weights::from_torch(named, self.net.declared(), part);
        let parts = parts.into_iter();
        parts
            .map(|(prefix, named)| Ok((prefix, ours(named)?)))
            .collect()
    }

    /// Returns both moments of each learned parameter.
    fn moments_named(&self) -> [Named; 2] {
        [0, 1].map(|which| {
            let each = self.net.declared().iter().zip(&self.moments);
            let learned = each.filter(|(d, _)| d.learned);
            learned
                .map(|(d, moments)| {
                    let value = crate::parameters::download(&moments[which]);
                    (d.name.clone(), (d.shape.clone(), value))
                })
                .collect()
        })
    }
}
