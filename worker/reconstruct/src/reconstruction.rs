//! A reconstruction from start to end: closed form → planes → start → carving → optimisation, which
//! can stop and resume.

use picofarm_scene::Vec3;
use picofarm_settings::{GridSettings as Settings, Shadows};
use rayon::prelude::*;

use crate::{
    Agreement, Depth, Measured, ReconstructError, Verdict, agreement,
    carve::carve,
    closed_form::{closed_form, smooth},
    field::{EMPTY, Field, SOLID},
    optimise::{Optimiser, Steps, trainable},
    paths::Paths,
    planes::{Plane, confine, planes, settle},
    progress::{Phase, Progress, begin},
    scale,
    start::{State, bounds, start},
    unlit,
    walls::Wall,
};

/// The kind of evidence for a node of the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Evidence {
    /// No ray passes near the node: its density is a guess.
    None = 0,
    /// A plane of the room passes the node or is in front of it.
    Plane = 1,
    /// Light paths pass the node.
    Paths = 2,
    /// The camera sees the node, or sees through it.
    Seen = 3,
}

/// A finished reconstruction.
#[derive(Debug, Clone)]
pub struct Reconstructed {
    /// The density field.
    pub field: Field,
    /// The evidence for each node, in the field's order.
    pub evidence: Vec<Evidence>,
    /// The depth of every pixel, from closed form and planes.
    pub depth: Depth,
    /// The room's planes.
    pub planes: Vec<Plane>,
    /// The measurements with refined spots.
    pub measured: Measured,
    /// The loss per ray of the last iteration, if there was one.
    pub loss: Option<f64>,
    /// The least loss per held-out ray.
    pub held_out_loss: Option<f64>,
    /// The number of iterations.
    pub iterations: u32,
    /// The agreement of the measurements with one another.
    pub agreement: Agreement,
    /// Notes that users should read before they trust the result.
    pub notes: Vec<String>,
}

/// A reconstruction in progress.
///
/// Its lengths are those of a room; [`Self::finish`] divides them by `factor`.
pub struct Reconstruction {
    settings: Settings,
    factor: f32,
    measured: Measured,
    depth: Depth,
    planes: Vec<Plane>,
    field: Field,
    evidence: Vec<Evidence>,
    trainable: Trainable,
    saved: Option<Saved>,
    agreement: Agreement,
    notes: Vec<String>,
}

type Trainable = (Vec<u32>, Vec<crate::optimise::Kind>);

/// The progress of the optimisation.
#[derive(Debug, Clone)]
pub(crate) struct Saved {
    pub done: u32,
    pub loss: f64,
    pub held_out: f64,
    pub misses: u32,
    pub settles: Option<u32>,
    pub logits: Vec<f32>,
    pub first: Vec<f32>,
    pub second: Vec<f32>,
}

impl Reconstruction {
    /// Runs all steps before the optimisation, which takes a few seconds.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] for settings or measurements that cannot be used;
    /// [`ReconstructError::Stopped`].
    pub fn begin(
        mut measured: Measured,
        settings: Settings,
        progress: &dyn Progress,
    ) -> Result<Self, ReconstructError> {
        settings
            .check()
            .map_err(|(field, what)| ReconstructError::invalid(field, what))?;
        let mut notes = measured.check()?;
        let factor = scale::factor(&measured);
        measured.scale(factor);
        begin(progress, Phase::Depth)?;
        let (mut raw, times) = closed_form(&mut measured);
        if !raw.range.iter().any(|r| r.is_finite()) {
            let what = "no time gives a depth: all are shorter than the way by the spot; check the gate and the laser's place";
            return Err(ReconstructError::invalid("tau", what));
        }
        let lit = smooth(&measured, &raw);
        begin(progress, Phase::Planes)?;
        let (walls, seen) = match settings.planes {
            true => planes(&measured, &lit, (settings.seed, factor)),
            false => (Vec::new(), Vec::new()),
        };
        notes.extend(seen);
        let agreement = agreement::check(&measured, &lit, &times, factor);
        let mut depth = match unlit::add(&measured, &mut raw) {
            0 => lit,
            _ => smooth(&measured, &raw),
        };
        if agreement.verdict == Verdict::Contradicts && !settings.accept_inconsistent {
            let reasons = agreement.reasons;
            return Err(ReconstructError::Inconsistent { reasons });
        }
        settle(&measured, &mut depth, &walls);
        let behind = confine(&mut measured, &mut depth, &walls);
        if behind > 0 {
            notes.push(format!(
                "{behind} pixels ({:.1} %) were behind a wall that their neighbours see, and are placed on it",
                100.0 * behind as f32 / measured.pixels() as f32
            ));
        }
        if settings.planes && walls.is_empty() {
            notes.push(
                "no plane of a room was found: what lies outside the view stays empty".into(),
            );
        }
        begin(progress, Phase::Start)?;
        let (lo, hi) = bounds(&measured, &depth, settings.nodes as usize);
        let mut field = Field::over(lo, hi, settings.nodes as usize);
        let states = start(&mut field, &measured, &depth, &walls);
        begin(progress, Phase::Carve)?;
        let paths = Paths::new(&measured, &depth);
        let carved = match settings.shadows {
            Shadows::Ignore => None,
            _ => Some(carve(&field, &states, &paths, progress)?),
        };
        let evidence = evidence(&field, &states, carved.as_ref().map(|c| &*c.empty), &walls);
        let mut these = (Vec::new(), Vec::new());
        match (&carved, settings.shadows) {
            (Some(c), Shadows::Optimise) => {
                these = trainable(&mut field, &states, &c.empty);
            }
            _ => without_optimisation(&mut field, &states, carved.as_ref().map(|c| &*c.empty)),
        }
        Ok(Self {
            settings,
            factor,
            measured,
            depth,
            planes: walls.iter().map(|w| w.plane).collect(),
            field,
            evidence,
            trainable: these,
            saved: None,
            agreement,
            notes,
        })
    }

    /// Optimises until it is finished (`true`) or `progress` stops it (`false`). Call it again to
    /// continue. The bits of the result depend neither on stops nor on the number of threads.
    ///
    /// # Errors
    /// [`ReconstructError::Stopped`] if it was stopped before the first iteration;
    /// [`ReconstructError::Invalid`] if a density is NaN or infinite.
    pub fn run(&mut self, progress: &dyn Progress) -> Result<bool, ReconstructError> {
        if self.settings.shadows != Shadows::Optimise || self.trainable.0.is_empty() {
            return Ok(true);
        }
        let steps = Steps {
            iterations: self.settings.iterations,
            batch: self.settings.batch,
            seed: self.settings.seed,
        };
        let of = (&self.measured, &self.depth);
        let mut optimiser =
            Optimiser::new(of, &self.field, self.trainable.clone(), steps, progress)?;
        // The choice of rays depends on the start, so the start is left unchanged until the end.
        let mut field = self.field.clone();
        if let Some(saved) = self.saved.take() {
            let (nodes, moments) = optimiser.state();
            for (&i, u) in nodes.iter().zip(&saved.logits) {
                field.logit[i as usize] = *u;
            }
            moments.first = saved.first;
            moments.second = saved.second;
            (optimiser.done, optimiser.loss) = (saved.done, saved.loss);
            (optimiser.held_out, optimiser.misses) = (saved.held_out, saved.misses);
            optimiser.settles = saved.settles;
        }
        let ended = optimiser.run(&mut field, progress);
        if let Some(odd) = field.logit.iter().find(|u| !u.is_finite()) {
            let what = format!(
                "holds {odd} after iteration {}; check the measurements for values that are far too large",
                optimiser.done
            );
            return Err(ReconstructError::invalid("field", what));
        }
        let (done, loss) = (optimiser.done, optimiser.loss);
        let (held_out, misses, settles) = (optimiser.held_out, optimiser.misses, optimiser.settles);
        let (nodes, moments) = optimiser.state();
        self.saved = Some(Saved {
            done,
            loss,
            held_out,
            misses,
            settles,
            logits: nodes.iter().map(|&i| field.logit[i as usize]).collect(),
            first: std::mem::take(&mut moments.first),
            second: std::mem::take(&mut moments.second),
        });
        Ok(ended)
    }

    /// Returns the current result.
    pub fn finish(mut self) -> Reconstructed {
        let back = 1.0 / self.factor;
        self.measured.scale(back);
        self.depth.scale(back);
        let mut field = self.field;
        field.scale(back);
        let (mut loss, mut held_out_loss, mut iterations) = (None, None, 0);
        if let Some(saved) = self.saved {
            for (&i, u) in self.trainable.0.iter().zip(&saved.logits) {
                field.logit[i as usize] = *u;
            }
            let known = |x: f64| x.is_finite().then_some(x);
            (loss, held_out_loss) = (known(saved.loss), known(saved.held_out));
            iterations = saved.done;
        }
        Reconstructed {
            field,
            evidence: self.evidence,
            depth: self.depth,
            planes: self.planes.iter().map(|p| p.scaled(back)).collect(),
            measured: self.measured,
            loss,
            held_out_loss,
            iterations,
            agreement: self.agreement,
            notes: self.notes,
        }
    }

    /// Returns the agreement of the measurements with one another.
    pub fn agreement(&self) -> &Agreement {
        &self.agreement
    }

    /// Returns the settings.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    pub(crate) fn saved(&self) -> Option<&Saved> {
        self.saved.as_ref()
    }

    pub(crate) fn trainable_nodes(&self) -> &[u32] {
        &self.trainable.0
    }

    pub(crate) fn start_field(&self) -> &Field {
        &self.field
    }

    pub(crate) fn set_saved(&mut self, saved: Saved) {
        self.saved = Some(saved);
    }
}

/// Runs a whole reconstruction on the caller's rayon pool. The bits are the same for any number of
/// threads.
///
/// # Errors
/// As for [`Reconstruction::begin`]; [`ReconstructError::Stopped`] if it was stopped.
pub fn reconstruct(
    measured: Measured,
    settings: Settings,
    progress: &dyn Progress,
) -> Result<Reconstructed, ReconstructError> {
    let mut reconstruction = Reconstruction::begin(measured, settings, progress)?;
    match reconstruction.run(progress)? {
        true => Ok(reconstruction.finish()),
        false => Err(ReconstructError::Stopped),
    }
}

/// Sets unseen nodes by carving alone, or makes all of them empty.
fn without_optimisation(field: &mut Field, states: &[State], empty: Option<&[f32]>) {
    for (i, u) in field.logit.iter_mut().enumerate() {
        if states[i] == State::Unseen {
            *u = match empty.map(|e| e[i]) {
                None => EMPTY,
                Some(e) if !(0.0..=0.9).contains(&e) => EMPTY,
                Some(e) => ((0.35 - e) * 12.0).clamp(EMPTY, SOLID),
            };
        }
    }
}

fn evidence(
    field: &Field,
    states: &[State],
    empty: Option<&[f32]>,
    walls: &[Wall],
) -> Vec<Evidence> {
    let near = |x: Vec3| walls.iter().any(|p| p.inside(x) < 1.5 * field.spacing);
    let of = |i: usize| match states[i] {
        State::Free | State::Band => Evidence::Seen,
        State::Wall => Evidence::Plane,
        State::Unseen if empty.is_some_and(|e| e[i] >= 0.0) => Evidence::Paths,
        State::Outside if near(field.at(i)) => Evidence::Plane,
        State::Unseen | State::Outside => Evidence::None,
    };
    (0..states.len()).into_par_iter().map(of).collect()
}
