//! The fit of both networks to the measurements of one scene, which can stop and resume.
//!
//! Batches, samples and first weights depend only on the seed and the step. A batch is computed in
//! parts of a fixed number of rays, and their gradients are added in order, so the bits depend
//! neither on the number of threads nor on stops. They may differ between kinds of processors with
//! matrix products that add in another order.

use burn::tensor::Device;
use picofarm_reconstruct::{Measured, Phase, Progress, ReconstructError, saved::Moments};

use crate::{
    adam,
    loss::{AllDraws, Counts, Stage, loss},
    network::{Network, Shape, host},
    random::{Purpose, Random},
    rays::{Batch, Pool},
    sample::Draws,
    settings::{Settings, invalid},
};

/// The number of rays that are computed at once: their memory is small, and their matrices are
/// large enough.
const AT_ONCE: usize = 64;
/// The ratio of the work of a step of stage 2 to one of stage 1: it renders light paths of two
/// depths in addition to camera rays.
const SHADOW_WORK: f32 = 3.0;
/// The number of steps in which a network without any gradient is initialised again. Later, a batch
/// that happens to have no gradient must not discard the learned weights.
const WATCHED: u32 = 1000;
/// The greatest number of initialisations.
const DRAWS: u32 = 100;

/// The state that learning changes, first of the coarse and then of the fine network.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// The weights: see [`crate::network`].
    pub weights: [Vec<f32>; 2],
    /// Adam's moments.
    pub moments: [Moments; 2],
    /// The number of steps taken.
    pub step: u32,
    /// The number of times that the weights were initialised again.
    pub draw: u32,
    /// The loss of the last step.
    pub loss: f32,
}

impl State {
    /// Returns the state before the first step.
    pub fn begin(settings: &Settings, draw: u32) -> Self {
        let shape = shape(settings);
        let count = shape.weights();
        Self {
            weights: [0, 1].map(|which| shape.begin(settings.seed, draw, which)),
            moments: [Moments::new(count), Moments::new(count)],
            step: 0,
            draw,
            loss: f32::NAN,
        }
    }
}

/// A fit in progress.
#[derive(Debug)]
pub struct Training {
    pub(crate) settings: Settings,
    pub(crate) pool: Pool,
    pub(crate) state: State,
    notes: Vec<String>,
    device: Device,
}

pub(crate) fn shape(settings: &Settings) -> Shape {
    Shape {
        width: settings.width,
        layers: settings.layers,
    }
}

impl Training {
    /// Creates a fit in its initial state.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] naming a setting or a measurement that cannot be used.
    pub fn begin(measured: Measured, settings: Settings) -> Result<Self, ReconstructError> {
        settings.check()?;
        let (pool, notes) = Pool::new(measured)?;
        Ok(Self {
            state: State::begin(&settings, 0),
            settings,
            pool,
            notes,
            device: Device::flex(),
        })
    }

    /// Returns the settings.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Returns the number of finished steps.
    pub fn step(&self) -> u64 {
        self.state.step.into()
    }

    /// Returns weights, moments and counts.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Returns notes that users should read before they trust the result.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = self.notes.clone();
        if self.state.draw > 0 {
            notes.push(format!(
                "the first weights gave no density anywhere, and were drawn anew {} times",
                self.state.draw
            ));
        }
        notes
    }

    /// Learns until the fit is finished (`true`) or `progress` stops it (`false`). Call it again to
    /// continue.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] if the loss becomes NaN or infinite, or if no initial weights
    /// give any density.
    pub fn run(&mut self, progress: &dyn Progress) -> Result<bool, ReconstructError> {
        self.run_with(progress, &mut |_| ())
    }

    /// Like [`Training::run`], and calls `after` after each step.
    ///
    /// # Errors
    /// As for [`Training::run`].
    pub fn run_with(
        &mut self,
        progress: &dyn Progress,
        after: &mut dyn FnMut(&Self),
    ) -> Result<bool, ReconstructError> {
        while self.state.step < self.settings.steps() {
            let Some((loss, gradients)) = self.gradients(progress) else {
                return Ok(false);
            };
            if !loss.is_finite() {
                let what = format!(
                    "is {loss} at step {}; lower learning_rate, or check the measurements",
                    self.state.step
                );
                return Err(invalid("loss", what));
            }
            let dead = |g: &Vec<f32>| g.iter().all(|x| *x == 0.0);
            if self.state.step < WATCHED && gradients.iter().any(dead) {
                self.draw_anew()?;
                continue;
            }
            self.apply(&gradients);
            self.state.loss = loss;
            after(self);
        }
        Ok(true)
    }

    /// Starts again with other weights. A network without any density has no gradient, and never
    /// gets one. The paper's code checks only the coarse network.
    fn draw_anew(&mut self) -> Result<(), ReconstructError> {
        if self.state.draw + 1 >= DRAWS {
            let what = format!(
                "give no density anywhere in {DRAWS} draws; check near_m and far_m, or give another seed"
            );
            return Err(invalid("first weights", what));
        }
        self.state = State::begin(&self.settings, self.state.draw + 1);
        Ok(())
    }

    pub(crate) fn apply(&mut self, gradients: &[Vec<f32>; 2]) {
        let rate = self.settings.rate(self.state.step);
        self.state.step += 1;
        let each = self.state.weights.iter_mut().zip(&mut self.state.moments);
        for ((weights, moments), gradient) in each.zip(gradients) {
            adam::step(moments, weights, gradient, rate, self.state.step);
        }
    }

    /// Returns the loss of the next step and its gradients, or `None` if `progress` stopped it.
    fn gradients(&self, progress: &dyn Progress) -> Option<(f32, [Vec<f32>; 2])> {
        let (s, step) = (&self.settings, self.state.step);
        let stage = match step < s.distance_steps {
            true => Stage::Distance,
            false => Stage::Shadow,
        };
        let begun = if stage == Stage::Distance {
            0
        } else {
            s.distance_steps
        };
        let place = u64::from(step - begun) * s.batch as u64;
        let batch = self
            .pool
            .batch(stage == Stage::Distance, s.seed, place, s.batch);
        let shown = self
            .state
            .loss
            .is_finite()
            .then_some(f64::from(self.state.loss));
        let watch = |part: f32| progress.at(Phase::Optimise, self.share(part), shown);
        gradients(
            s,
            stage,
            &self.state.weights,
            &batch,
            step,
            &self.device,
            &watch,
        )
    }

    /// Returns the finished share of the work when the share `part` of the next step is finished.
    fn share(&self, part: f32) -> f32 {
        let (s, step) = (&self.settings, self.state.step as f32 + part);
        let early = s.distance_steps as f32;
        let work = |step: f32| step.min(early) + SHADOW_WORK * (step - early).max(0.0);
        work(step) / work(s.steps() as f32)
    }
}

/// Returns the loss of a batch and its gradient for the weights of both networks, or `None` if
/// `watch` stopped it. `watch` receives the finished share.
pub(crate) fn gradients(
    settings: &Settings,
    stage: Stage,
    weights: &[Vec<f32>; 2],
    batch: &Batch,
    step: u32,
    device: &Device,
    watch: &dyn Fn(f32) -> bool,
) -> Option<(f32, [Vec<f32>; 2])> {
    let device = device.clone().autodiff();
    let counts = Counts::of(batch);
    let mut sum = 0.0f32;
    let mut sums = [0, 1].map(|k| vec![0.0f32; weights[k].len()]);
    for from in (0..batch.rays()).step_by(AT_ONCE) {
        if !watch(from as f32 / batch.rays() as f32) {
            return None;
        }
        let to = (from + AT_ONCE).min(batch.rays());
        let networks = [0, 1].map(|k| Network::new(shape(settings), &weights[k], &device));
        let draws = draws(settings, step, from, to - from);
        let part = batch.part(from, to);
        let root = loss(settings, stage, &networks, &part, counts, &draws, &device);
        let mut of = root.backward();
        sum += host(root)[0];
        for (sums, network) in sums.iter_mut().zip(&networks) {
            let each = sums.iter_mut().zip(network.gradient(&mut of));
            each.for_each(|(a, b)| *a += b);
        }
    }
    Some((sum, sums))
}

/// Returns the random numbers of some rays of a step.
pub(crate) fn draws(settings: &Settings, step: u32, from: usize, rays: usize) -> AllDraws {
    [0u64, 1, 2].map(|time| {
        let mut draws = Draws::default();
        for ray in from..from + rays {
            let name = (ray as u64) << 2 | time;
            let mut random = Random::new(settings.seed, Purpose::Samples, u64::from(step), name);
            let mut some = |n| (0..n).map(|_| random.unit()).collect::<Vec<_>>();
            draws.jitter.extend(some(settings.coarse));
            draws.share.extend(some(settings.fine));
        }
        draws
    })
}
