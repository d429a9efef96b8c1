//! Optimisation of the logits on the transmittance of rays, by stochastic gradients.
//!
//! Along a ray, ∂T/∂σ is the same everywhere, so gradients need no graph: one march collects the
//! optical depth and the positions, and a second pass over them distributes the derivative. The
//! loss of a free ray is its optical depth s, with saturation: 10·ln(1 + s/10). The loss of a
//! stopped ray is −ln(1 − T + 0.02). Both classes and the camera's rays make up a third of a batch
//! each. Gradients are summed in fixed point, because integer sums are the same in any order.
//!
//! One ray in twenty is held out. The loss of the held-out rays is evaluated every ten iterations.
//! When it has hardly decreased twice in a row, half as many further iterations follow at a lower
//! rate, and then the optimisation ends.

mod adam;
mod cast;

use rayon::prelude::*;

use crate::{
    Depth, Measured, ReconstructError,
    field::{EMPTY, Field, Skip},
    progress::{Phase, Progress},
    rays::Rays,
    rng::{Rng, Stream},
    start::State,
};

pub(crate) use crate::saved::Moments;
pub use cast::{Cast, cast_ray};

/// Gradients are multiples of 2⁻²⁴.
const UNIT: f32 = 16_777_216.0;
/// The distance around unseen space in which nodes may change too, voxels.
const REACH: usize = 2;
/// The emptiness from which a node that no ray contradicts starts as empty.
const SURELY: f32 = 0.9;
/// The emptiness at which a node starts half full.
const EVEN: f32 = 0.35;

/// The number of iterations between evaluations of the held-out rays.
const LOOK: u32 = 10;
/// The share of the held-out loss by which it must decrease to count as lower.
const GAIN: f64 = 0.01;
/// The number of consecutive evaluations without such a decrease after which the rate is lowered.
const PATIENCE: u32 = 2;
/// The least number of iterations at the lower rate.
const SETTLE: u32 = 10;

/// The way in which a node may change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Freely, with a pull towards emptiness.
    Unknown,
    /// Near its start, because the camera saw a surface there.
    Anchored,
}

/// A field during optimisation.
pub(crate) struct Optimiser<'a> {
    rays: Rays<'a>,
    skip: Skip,
    nodes: Vec<u32>,
    kinds: Vec<Kind>,
    start: Vec<f32>,
    /// Node → index in `nodes`; `u32::MAX` if fixed.
    slot: Vec<u32>,
    moments: Moments,
    settings: Steps,
    /// The number of finished iterations.
    pub done: u32,
    /// The loss per ray of the last iteration.
    pub loss: f64,
    /// The least loss per held-out ray so far.
    pub held_out: f64,
    /// The number of evaluations since then without a decrease.
    pub misses: u32,
    /// The iteration from which the rate is lower.
    pub settles: Option<u32>,
}

/// The settings of the optimisation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Steps {
    /// The greatest number of iterations.
    pub iterations: u32,
    pub batch: u32,
    pub seed: u64,
}

/// Sets the start of unseen nodes from their emptiness, and returns the nodes that may change:
/// unseen ones, and those within two voxels.
pub(crate) fn trainable(
    field: &mut Field,
    states: &[State],
    empty: &[f32],
) -> (Vec<u32>, Vec<Kind>) {
    let mut near: Vec<bool> = states.iter().map(|&s| s == State::Unseen).collect();
    let strides = field.strides();
    for _ in 0..REACH {
        let old = near.clone();
        let edge = strides[2]..old.len() - strides[2];
        near.par_iter_mut().enumerate().for_each(|(i, near)| {
            *near |= edge.contains(&i) && strides.iter().any(|s| old[i - s] || old[i + s]);
        });
    }
    let (mut nodes, mut kinds) = (Vec::new(), Vec::new());
    for i in (0..states.len()).filter(|&i| near[i]) {
        let kind = match states[i] {
            State::Unseen => {
                field.logit[i] = match empty[i] {
                    e if e > SURELY => -5.0,
                    e if e < 0.0 => -3.0,
                    e => ((EVEN - e) * 8.0).clamp(-3.0, 2.0),
                };
                Kind::Unknown
            }
            State::Free => {
                field.logit[i] = -5.0;
                Kind::Unknown
            }
            State::Band => Kind::Anchored,
            State::Outside | State::Wall => continue,
        };
        nodes.push(i as u32);
        kinds.push(kind);
    }
    (nodes, kinds)
}

impl<'a> Optimiser<'a> {
    pub fn new(
        (measured, depth): (&'a Measured, &'a Depth),
        field: &Field,
        (nodes, kinds): (Vec<u32>, Vec<Kind>),
        settings: Steps,
        progress: &dyn Progress,
    ) -> Result<Self, ReconstructError> {
        let mut slot = vec![u32::MAX; field.logit.len()];
        for (k, &i) in nodes.iter().enumerate() {
            slot[i as usize] = k as u32;
        }
        let may_change = Skip::to_nodes(field, |i| slot[i] != u32::MAX);
        let rays = Rays::choose((measured, depth), (field, &may_change), progress)?;
        let skip = Skip::to_nodes(field, |i| {
            slot[i] != u32::MAX || field.logit[i] > EMPTY + 0.1
        });
        Ok(Self {
            start: nodes.iter().map(|&i| field.logit[i as usize]).collect(),
            moments: Moments::new(nodes.len()),
            rays,
            skip,
            nodes,
            kinds,
            slot,
            settings,
            done: 0,
            loss: f64::NAN,
            held_out: f64::NAN,
            misses: 0,
            settles: None,
        })
    }

    /// Runs until all iterations are finished (`true`) or `progress` stops it (`false`).
    pub fn run(&mut self, field: &mut Field, progress: &dyn Progress) -> bool {
        let threads = rayon::current_num_threads().max(1);
        let mut sums = vec![vec![0i64; self.nodes.len()]; threads];
        while self.done < self.end() {
            let share = self.done as f32 / self.end() as f32;
            let loss = self.loss.is_finite().then_some(self.loss);
            if !progress.at(Phase::Optimise, share, loss) {
                return false;
            }
            if self.settles.is_none() && self.done > 0 && self.done.is_multiple_of(LOOK) {
                self.look(field);
            }
            self.iterate(field, &mut sums);
        }
        true
    }

    /// Returns the iteration at which the optimisation ends, as far as is known.
    fn end(&self) -> u32 {
        let all = self.settings.iterations;
        match self.settles {
            Some(from) => all.min(from + SETTLE.max(from / 2)),
            None => all,
        }
    }

    /// Evaluates the held-out rays. The rate is lowered when their loss hardly decreases, or after
    /// two thirds of the iterations.
    fn look(&mut self, field: &Field) {
        let loss = |q: &u32| -> i64 {
            let ray = self.rays.get(*q).expect("candidates are rays that exist");
            let mut cast = Cast::default();
            fixed(cast.march(field, &self.skip, &ray, 0.0) as f32)
        };
        let classes = self.rays.held_out.iter().filter(|c| !c.is_empty());
        let means: Vec<f64> = classes
            .map(|class| class.par_iter().map(loss).sum::<i64>() as f64 / class.len() as f64)
            .collect();
        let held_out = means.iter().sum::<f64>() / f64::from(UNIT) / means.len().max(1) as f64;
        if self.held_out.is_nan() || held_out < self.held_out * (1.0 - GAIN) {
            (self.held_out, self.misses) = (held_out, 0);
        } else {
            self.misses += 1;
        }
        if self.misses >= PATIENCE || self.done * 3 >= self.settings.iterations * 2 {
            self.settles = Some(self.done);
        }
    }

    fn iterate(&mut self, field: &mut Field, sums: &mut [Vec<i64>]) {
        let pools: Vec<&Vec<u32>> = self.rays.classes.iter().filter(|c| !c.is_empty()).collect();
        if pools.is_empty() || self.nodes.is_empty() {
            self.done = self.settings.iterations;
            return;
        }
        let (this, shown, parts) = (&*self, &*field, sums.len());
        let batch = this.settings.batch as usize;
        let part = |(part, sums): (usize, &mut Vec<i64>)| -> i64 {
            let mut cast = Cast::default();
            let mut loss = 0i64;
            for k in part * batch / parts..(part + 1) * batch / parts {
                let index = u64::from(this.done) * batch as u64 + k as u64;
                let mut rng = Rng::new(this.settings.seed, Stream::Rays, index);
                let pool = pools[k % pools.len()];
                let ray = this.rays.get(pool[rng.below(pool.len())]);
                let ray = ray.expect("candidates are rays that exist");
                let offset = rng.unit() - 0.5;
                loss += fixed(cast.march(shown, &this.skip, &ray, offset) as f32);
                cast.spread(shown, |node, g| {
                    if let Some(sum) = sums.get_mut(this.slot[node] as usize) {
                        *sum += fixed(g);
                    }
                });
            }
            loss
        };
        let loss: i64 = sums.par_iter_mut().enumerate().map(part).sum();
        self.loss = loss as f64 / f64::from(UNIT) / batch as f64;
        self.update(field, sums);
        sums.par_iter_mut().for_each(|s| s.fill(0));
        self.done += 1;
    }

    fn update(&mut self, field: &mut Field, sums: &[Vec<i64>]) {
        let late = self.settles.is_some() || self.done * 3 > self.settings.iterations * 2;
        let scale = 1e4 / (self.settings.batch as f32 * UNIT);
        let rate = adam::Rate::new(self.done, late);
        let (nodes, kinds, start, logit) = (&self.nodes, &self.kinds, &self.start, &field.logit);
        let step = |(k, (m, v)): (usize, (&mut f32, &mut f32))| -> f32 {
            let sum: i64 = sums.iter().map(|s| s[k]).sum();
            let u = logit[nodes[k] as usize];
            let g = sum as f32 * scale + adam::pull(kinds[k], u, start[k]);
            adam::step(u, g, (m, v), &rate)
        };
        let moments = self
            .moments
            .first
            .par_iter_mut()
            .zip(self.moments.second.par_iter_mut());
        let new: Vec<f32> = moments.enumerate().map(step).collect();
        for (&i, u) in self.nodes.iter().zip(new) {
            field.logit[i as usize] = u;
        }
    }

    /// Returns the nodes that may change, and the moments of their gradients.
    pub fn state(&mut self) -> (&[u32], &mut Moments) {
        (&self.nodes, &mut self.moments)
    }
}

/// Converts a number to a multiple of 2⁻²⁴; `as` saturates, and NaN becomes 0.
#[inline(always)]
fn fixed(x: f32) -> i64 {
    (x * UNIT) as i64
}
