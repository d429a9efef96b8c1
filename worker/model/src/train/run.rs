//! Runs a training from its current position to its end.

use std::{
    ops::Range,
    sync::Arc,
    time::{Duration, Instant},
};

use burn::tensor::Device;

use super::{
    Plan,
    checkpoint::{self, Snapshot},
    group::{Group, Member, Next, Standing},
    learner::{Gradients, Learner},
    load::{Course, Loading, Making, Ready},
    position::{Line, Position},
    schedule,
};
use crate::{
    ModelError,
    device::computes,
    input::Visit,
    metric::{Metrics, Tally},
    model::{PLAN, not_finite},
    net::Net,
    parameters::Parameters,
    scene::Scenes,
    weights,
};

/// An event of a training.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// A finished optimiser step.
    Step {
        /// The number of finished steps.
        step: u64,
        /// The number of steps of the whole training.
        of: u64,
        /// The current epoch, from 1.
        epoch: u64,
        /// The mean loss of the step.
        loss: f32,
        /// Training examples per second, over all processes of the training, since this process
        /// started or resumed.
        samples_per_s: f64,
        /// The share of that time in which the network waited for data.
        data_wait_share: f64,
    },
    /// A validation within an epoch.
    Validated(Line),
    /// The end of an epoch.
    Epoch(Line),
}

/// Whether to continue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Continue.
    Continue,
    /// Stop after this step.
    Stop,
}

/// The reason why a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// The training is finished.
    Finished,
    /// The caller stopped the training; it can resume from a checkpoint.
    Stopped,
    /// The training is finished, and another process stores the result.
    Elsewhere,
}

/// The scenes of a training.
pub struct Sources {
    /// The training scenes.
    pub train: Arc<dyn Scenes>,
    /// The validation scenes, evaluated after each epoch; may be empty.
    pub validation: Arc<dyn Scenes>,
}

/// A training.
pub struct Training {
    plan: Plan,
    learner: Learner,
    position: Position,
    /// With `early_stop`: the values at the best validation.
    kept: Option<Parameters>,
    sources: Sources,
    loading: Loading,
    device: Device,
    leads: bool,
}

/// The result of a training.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The weights as safetensors, by PyTorch's names.
    pub weights: Vec<u8>,
    /// A line for each epoch, and for each validation within one.
    pub history: Vec<Line>,
    /// Whether the training ended before its last epoch.
    pub stopped_early: bool,
    /// The step that produced these weights: with `early_stop` the one with the best validation,
    /// else the last.
    pub kept_step: u64,
}

impl Trained {
    /// Returns the line with the metrics of these weights.
    pub fn kept(&self) -> Option<&Line> {
        self.history.iter().find(|line| line.step == self.kept_step)
    }

    /// Returns the number of whole epochs.
    pub fn epochs(&self) -> usize {
        self.history.iter().filter(|line| !line.within).count()
    }
}

impl Training {
    /// Starts a training from random weights or from `from` (safetensors). A frozen encoder
    /// requires `from`. Other parameters that are missing in `from` start at random.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] for a plan that cannot be used, [`ModelError::Weights`] if `from`
    /// belongs to another network.
    pub fn start(
        plan: Plan,
        from: Option<&[u8]>,
        sources: Sources,
        device: &Device,
    ) -> Result<Self, ModelError> {
        plan.check(sources.train.len())?;
        computes(&plan.net, device)?;
        let net = Net::new(plan.net.clone())?;
        let mut parameters = Parameters::begin(net.declared().to_vec(), plan.seed, device);
        if plan.net.frozen && from.is_none() {
            let what = "a frozen encoder is another network's; name the trained ToF network";
            return Err(ModelError::invalid("specular.on", what));
        }
        if let Some(bytes) = from {
            let (named, _) = weights::read(bytes)?;
            let named = weights::from_torch(named, net.declared(), plan.question.part())?;
            parameters = match plan.net.frozen {
                false => Parameters::from_named(net.declared().to_vec(), named, device)?,
                true => parameters.with_encoder_of(named, device)?,
            };
        }
        let learner = learner(&plan, net, parameters);
        Ok(Self {
            plan,
            learner,
            position: Position::default(),
            kept: None,
            sources,
            loading: Loading::default(),
            device: device.clone(),
            leads: true,
        })
    }

    /// Resumes a training from the pieces of a checkpoint of the same plan, in any order.
    ///
    /// # Errors
    /// [`ModelError::Weights`] for a checkpoint that is damaged or of another plan; those of
    /// [`Self::start`].
    pub fn resume(
        plan: Plan,
        checkpoint: &[impl AsRef<[u8]>],
        sources: Sources,
        device: &Device,
    ) -> Result<Self, ModelError> {
        plan.check(sources.train.len())?;
        computes(&plan.net, device)?;
        let net = Net::new(plan.net.clone())?;
        let parameters = Parameters::begin(net.declared().to_vec(), plan.seed, device);
        let mut learner = learner(&plan, net, parameters);
        let (position, kept) = restored(&plan, checkpoint, &mut learner, device)?;
        Ok(Self {
            plan,
            learner,
            position,
            kept,
            sources,
            loading: Loading::default(),
            device: device.clone(),
            leads: true,
        })
    }

    /// Changes the resources for loading scenes. They affect the time and memory of the training,
    /// but no bit of its result.
    #[must_use]
    pub fn loading(mut self, loading: Loading) -> Self {
        self.loading = loading;
        self
    }

    /// Returns the training's current state, which can be written while it continues.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot::of(
            &self.learner,
            &self.position,
            self.kept.as_ref(),
            &self.plan.text(),
        )
    }

    /// Returns the training's state as bytes, from which it can resume.
    pub fn checkpoint(&self) -> Vec<u8> {
        let mut pieces = self.snapshot().pieces(usize::MAX);
        pieces.next().expect("there is a first piece")
    }

    /// Returns the training's position.
    pub fn position(&self) -> &Position {
        &self.position
    }

    /// Returns the network and its parameters.
    pub fn learner(&self) -> &Learner {
        &self.learner
    }

    /// Returns the number of steps of the whole training.
    pub fn steps(&self) -> u64 {
        self.plan.steps(self.sources.train.len())
    }

    /// Returns whether this process validates and stores the result. It is `false` if another
    /// process leads.
    pub fn leads(&self) -> bool {
        self.leads
    }

    /// Runs until the end, or until `say` returns [`Control::Stop`]. `say` receives the training,
    /// so that it can take a checkpoint.
    ///
    /// # Errors
    /// [`ModelError::Scene`] if a scene cannot be read, [`ModelError::NotFinite`].
    pub fn run(
        &mut self,
        say: &mut dyn FnMut(&Self, &Event) -> Control,
    ) -> Result<Ended, ModelError> {
        let share = 0..self.plan.accumulate;
        self.go(&share, None, say)
            .map(|ended| ended.expect("nobody else is lost"))
    }

    /// Like [`Self::run`], but together with other processes. The result has the same bits.
    ///
    /// # Errors
    /// Those of [`Self::run`], and any reason why this process cannot continue with the others.
    pub fn run_among(
        &mut self,
        group: &mut dyn Group,
        say: &mut dyn FnMut(&Self, &Event) -> Control,
    ) -> Result<Ended, ModelError> {
        loop {
            let share = match group.agree(self)? {
                Next::Over => return Ok(Ended::Elsewhere),
                Next::Stop => return Ok(Ended::Stopped),
                Next::Train { share, leads } => {
                    self.leads = leads;
                    share
                }
            };
            if self.is_over() && !self.leads {
                // The leading process stores the result and announces the end.
                continue;
            }
            if let Some(ended) = self.go(&share, Some(group), say)? {
                match ended {
                    Ended::Finished if !self.leads => {}
                    ended => return Ok(ended),
                }
            }
        }
    }

    /// Trains with a share of each step's batches. Returns `None` if the group has changed.
    fn go(
        &mut self,
        share: &Range<usize>,
        group: Option<&mut (dyn Group + '_)>,
        say: &mut dyn FnMut(&Self, &Event) -> Control,
    ) -> Result<Option<Ended>, ModelError> {
        if self.is_over() {
            return Ok(Some(Ended::Finished));
        }
        let plan = self.plan.clone();
        let train = Arc::clone(&self.sources.train);
        let course = Course::new(&plan, train.len(), &self.position, share);
        let making = Making {
            plan: &plan,
            scenes: &*train,
            visit: &|which| course.visit(which),
            count: course.len(),
            loading: self.loading,
        };
        making.ahead(|ready| self.learn(ready, share, group, say))
    }

    fn learn(
        &mut self,
        ready: &Ready<'_>,
        share: &Range<usize>,
        mut group: Option<&mut (dyn Group + '_)>,
        say: &mut dyn FnMut(&Self, &Event) -> Control,
    ) -> Result<Option<Ended>, ModelError> {
        let mut clock = Clock::new();
        let of = self.steps();
        let batches = self.plan.accumulate;
        // The next batch, transferred to a graphics processor while it computes.
        let mut ahead = None;
        while !self.is_over() {
            let mut events = Vec::new();
            if !self.line_is_due() {
                if let Some(group) = group.as_deref_mut()
                    && !group.go_on()?
                {
                    return Ok(None);
                }
                let mut others = group.as_deref_mut().filter(|group| !group.is_alone());
                let mut sum = Gradients::default();
                let mut last = None;
                for at in share.clone() {
                    let mut next = || {
                        let since = Instant::now();
                        let batch = ready.next()?;
                        clock.waited += since.elapsed();
                        Ok::<_, ModelError>(self.learner.bring(batch))
                    };
                    let batch = ahead.take().map_or_else(&mut next, Ok)?;
                    if others.is_some() && at + 1 == share.end {
                        last = Some((at, batch));
                        break;
                    }
                    self.learner.add(&mut sum, at, batch)?;
                    if self.learner.computes_apart() && !ready.is_over() {
                        ahead = Some(next()?);
                    }
                }
                if let Some(group) = &mut others {
                    let mut own = Some((sum, last));
                    let whole = group.sum(self.learner.steps(), &mut |each| {
                        let (sum, last) = own.take().expect("computed once");
                        self.learner.parts(sum, last, each)
                    })?;
                    let Some(whole) = whole else {
                        return Ok(None);
                    };
                    sum = self.learner.gradients_of(whole, batches)?;
                }
                clock.samples += batches * self.plan.batch;
                let pace = self.pace(self.learner.steps());
                let loss = self.learner.finish(sum, batches, pace)?;
                let position = &mut self.position;
                position.batches += batches as u64;
                position.losses += f64::from(loss);
                position.steps += 1;
                events.push(Event::Step {
                    step: self.learner.steps(),
                    of,
                    epoch: position.epoch + 1,
                    loss,
                    samples_per_s: clock.samples as f64 / clock.began.elapsed().as_secs_f64(),
                    data_wait_share: clock.share(),
                });
            }
            if self.line_is_due() {
                let since = Instant::now();
                let Some(line) = self.write_line(group.as_deref_mut())? else {
                    return Ok(None);
                };
                events.push(match line.within {
                    true => Event::Validated(line),
                    false => Event::Epoch(line),
                });
                clock.began += since.elapsed();
            }
            for event in &events {
                if say(self, event) == Control::Stop && !self.is_over() {
                    return Ok(Some(Ended::Stopped));
                }
            }
        }
        Ok(Some(Ended::Finished))
    }

    /// Returns the optimiser's settings at a step.
    fn pace(&self, step: u64) -> schedule::Pace {
        schedule::pace(&self.plan, step, self.sources.train.len())
    }

    fn is_over(&self) -> bool {
        self.position.epoch == self.plan.epochs || self.position.stopped_early
    }

    fn ends_epoch(&self) -> bool {
        self.position.batches == self.plan.batches(self.sources.train.len())
    }

    /// Returns whether an epoch has just ended, or a validation within it is due.
    fn line_is_due(&self) -> bool {
        let (step, every) = (self.learner.steps(), self.plan.validate_every);
        let validate =
            every > 0 && step.is_multiple_of(every) && !self.sources.validation.is_empty();
        self.ends_epoch() || (validate && self.position.steps > 0)
    }

    /// Validates if this process leads, or else receives the line from the leading process. Returns
    /// `None` if that process was lost.
    fn write_line(
        &mut self,
        group: Option<&mut (dyn Group + '_)>,
    ) -> Result<Option<Line>, ModelError> {
        let line = match group {
            Some(group) if !self.leads => match group.hear(self.learner.digest())? {
                Some(line) => line,
                None => return Ok(None),
            },
            group => {
                let line = self.line()?;
                if let Some(group) = group
                    && !group.is_alone()
                {
                    group.tell(&line, self.learner.digest());
                }
                line
            }
        };
        let validation = line.validation;
        let position = &mut self.position;
        position.history.push(line);
        (position.losses, position.steps) = (0.0, 0);
        if !line.within {
            position.epoch += 1;
            position.batches = 0;
        }
        if let Some(loss) = validation.map(|m| m.loss()) {
            // A NaN or infinite loss is never the best.
            if loss.is_finite() && position.best.is_none_or(|best| loss < best) {
                position.best = Some(loss);
                position.since_best = 0;
                if self.plan.early_stop > 0 {
                    position.kept_step = line.step;
                    self.kept = Some(self.learner.kept().clone());
                }
            } else {
                position.since_best += 1;
            }
            let patience = self.plan.early_stop;
            position.stopped_early = patience > 0 && position.since_best >= patience;
        }
        Ok(Some(line))
    }

    /// Returns the line of the current position, with metrics on the validation scenes.
    fn line(&self) -> Result<Line, ModelError> {
        let validation = match self.sources.validation.is_empty() {
            true => None,
            false => Some(self.validate()?),
        };
        let (position, step) = (&self.position, self.learner.steps());
        Ok(Line {
            epoch: position.epoch + 1,
            within: !self.ends_epoch(),
            step,
            loss: position.losses / position.steps as f64,
            learning_rate: self.pace(step - 1).learning_rate,
            validation,
        })
    }

    /// Returns the metrics on the unmodified validation scenes. The spot of a scene depends only on
    /// the scene's index.
    fn validate(&self) -> Result<Metrics, ModelError> {
        let scenes = &*self.sources.validation;
        let mut tally = Tally::default();
        let question = &self.plan.question;
        let visit = |which: u64| {
            let index = which as usize;
            let spot = match question.by_spot() {
                true => index % question.spots,
                false => 0,
            };
            let visit = Visit {
                spot,
                ..Visit::default()
            };
            (index, visit, None)
        };
        let making = Making {
            plan: &self.plan,
            scenes,
            visit: &visit,
            count: scenes.len() as u64,
            loading: self.loading,
        };
        making.ahead(|ready| {
            for at in 0..scenes.len().div_ceil(self.plan.batch) {
                let batch = ready.next()?;
                let said = self.learner.predict(&batch);
                if let Some(odd) = said.iter().position(|value| !value.is_finite()) {
                    let scene = at * self.plan.batch + odd / (said.len() / batch.images.max(1));
                    let step = self.learner.steps();
                    let why = not_finite(&said, odd, &batch, None);
                    let what = format!("validation scene {scene} (counted from 0): {why}");
                    return Err(ModelError::NotFinite { step, what });
                }
                tally.add(question, &said, &batch.target, [batch.height, batch.width]);
            }
            Ok::<(), ModelError>(())
        })?;
        Ok(tally.metrics(self.plan.question.target))
    }

    /// Returns the result.
    pub fn finish(self) -> Trained {
        let parameters = self.kept.as_ref().unwrap_or(self.learner.kept());
        let named = weights::to_torch(parameters.to_named());
        let kept_step = match self.kept {
            Some(_) => self.position.kept_step,
            None => self.learner.steps(),
        };
        Trained {
            kept_step,
            weights: weights::write(&named, &[(PLAN.to_owned(), self.plan.text())].into()),
            history: self.position.history,
            stopped_early: self.position.stopped_early,
        }
    }
}

/// Returns the learner of a plan.
fn learner(plan: &Plan, net: Net, parameters: Parameters) -> Learner {
    Learner::new(net, parameters, plan.question.target, plan.decay)
        .clipped(plan.clip_norm)
        .averaging(plan.ema)
}

impl Member for Training {
    fn standing(&self) -> Standing {
        Standing {
            step: self.learner.steps(),
            lines: self.position.history.len() as u64,
        }
    }

    fn batches(&self) -> usize {
        self.plan.accumulate
    }

    fn state(&self) -> Vec<u8> {
        self.checkpoint()
    }

    fn become_state(&mut self, state: &[u8]) -> Result<(), ModelError> {
        let (position, kept) = restored(&self.plan, &[state], &mut self.learner, &self.device)?;
        (self.position, self.kept) = (position, kept);
        Ok(())
    }
}

/// Restores a learner from a checkpoint of the same plan. Returns its position and the kept values.
fn restored(
    plan: &Plan,
    checkpoint: &[impl AsRef<[u8]>],
    learner: &mut Learner,
    device: &Device,
) -> Result<(Position, Option<Parameters>), ModelError> {
    let (header, kept) = checkpoint::read(checkpoint, learner, device)?;
    if header.plan != plan.text() {
        let what = "the checkpoint was made with other settings; remove it, or train with those";
        return Err(ModelError::weights(what));
    }
    Ok((header.position, kept))
}

/// Measures the time for which the network waited.
struct Clock {
    began: Instant,
    waited: Duration,
    samples: usize,
}

impl Clock {
    fn new() -> Self {
        Self {
            began: Instant::now(),
            waited: Duration::ZERO,
            samples: 0,
        }
    }

    fn share(&self) -> f64 {
        self.waited.as_secs_f64() / self.began.elapsed().as_secs_f64().max(f64::MIN_POSITIVE)
    }
}
