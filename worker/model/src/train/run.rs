//! Runs a training from its current position to its end.

use std::{cell::RefCell, ops::Range, sync::Arc, time::Instant};

use burn::tensor::Device;

use super::{
    Plan,
    checkpoint::{self, Snapshot},
    clock::Clock,
    engine::Engine,
    event::{Control, Ended, Event, Sources, Trained},
    gradients::Gradients,
    group::{Group, Member, Next, Standing},
    learner::{Brought, Learner},
    load::{Course, Loading, Making, Ready},
    position::Position,
    schedule,
};
use crate::{ModelError, device::computes, model::PLAN, net::Net, parameters::Parameters, weights};

/// A training.
pub struct Training {
    pub(super) plan: Plan,
    pub(super) learner: Learner,
    pub(super) position: Position,
    /// With `early_stop`: the values at the best validation.
    pub(super) kept: Option<Parameters>,
    pub(super) sources: Sources,
    pub(super) loading: Loading,
    device: Device,
    pub(super) leads: bool,
    /// The program that computes the steps, if it is not this one.
    pub(super) engine: Option<RefCell<Box<dyn Engine>>>,
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
            engine: None,
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
            engine: None,
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
    ///
    /// # Errors
    /// Those of the engine, if there is one.
    pub fn snapshot(&self) -> Result<Snapshot, ModelError> {
        let Some(engine) = &self.engine else {
            return Ok(self.own_snapshot());
        };
        let state = engine.borrow_mut().state(true)?;
        let part = self.plan.question.part();
        let parts = self.learner.parts_of(&state, part)?;
        Ok(self.own_snapshot().replaced(parts))
    }

    fn own_snapshot(&self) -> Snapshot {
        Snapshot::take(
            &self.learner,
            &self.position,
            self.kept.as_ref(),
            &self.plan.text(),
        )
    }

    /// Returns the training's state as bytes, from which it can resume. An engine's state is not in
    /// it: see [`Self::snapshot`].
    pub fn checkpoint(&self) -> Vec<u8> {
        let mut pieces = self.own_snapshot().pieces(usize::MAX);
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
        if let Some(engine) = &self.engine {
            engine.borrow_mut().rewind();
        }
        let share = 0..self.plan.accumulate;
        let ended = self.go(&share, None, say)?;
        Ok(ended.expect("nobody else is lost"))
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
                let loss = match self.engine.take() {
                    Some(engine) => {
                        let loss = self.step_outside(&engine, ready, &mut clock);
                        self.engine = Some(engine);
                        loss?
                    }
                    None => {
                        let parts = (share, &mut group, &mut ahead);
                        match self.step_here(ready, parts, &mut clock)? {
                            Some(loss) => loss,
                            None => return Ok(None),
                        }
                    }
                };
                clock.samples += batches * self.plan.batch;
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
        self.mirror()?;
        Ok(Some(Ended::Finished))
    }

    /// Takes a step with this crate's networks, and returns its loss, or `None` if the group has
    /// changed. `ahead` is the next batch, transferred to a graphics processor while it computes.
    fn step_here(
        &mut self,
        ready: &Ready<'_>,
        (share, group, ahead): (
            &Range<usize>,
            &mut Option<&mut (dyn Group + '_)>,
            &mut Option<Brought>,
        ),
        clock: &mut Clock,
    ) -> Result<Option<f32>, ModelError> {
        let batches = self.plan.accumulate;
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
                *ahead = Some(next()?);
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
        let pace = self.pace(self.learner.steps());
        self.learner.finish(sum, batches, pace).map(Some)
    }

    /// Returns the optimiser's settings at a step.
    pub(super) fn pace(&self, step: u64) -> schedule::Pace {
        schedule::pace(&self.plan, step, self.sources.train.len())
    }

    fn is_over(&self) -> bool {
        self.position.epoch == self.plan.epochs || self.position.stopped_early
    }

    pub(super) fn ends_epoch(&self) -> bool {
        self.position.batches == self.plan.batches(self.sources.train.len())
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
