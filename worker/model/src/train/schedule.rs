//! The schedule of the learning rate.

use picofarm_settings::Schedule;

use super::Plan;
use crate::ModelError;

/// The optimiser settings at a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pace {
    /// The learning rate.
    pub learning_rate: f64,
    /// β₁ of AdamW. PyTorch's one-cycle schedule varies it too, in the opposite direction to the
    /// rate.
    pub beta1: f64,
}

/// The number of steps of the released code's cycle.
const PAPER_STEPS: u64 = 1_000_000;
/// The share of the steps in which the rate rises.
const WARM_UP: f64 = 0.01;
/// The ratio of the greatest rate to the first one.
const START: f64 = 25.0;
/// The ratio of the first rate to the last one.
const END: f64 = 1e4;
/// The range of β₁ (PyTorch's `base_momentum` and `max_momentum`).
const BETA1: (f64, f64) = (0.85, 0.95);

/// Checks the run's length and its cycles.
///
/// # Errors
/// [`ModelError::Invalid`] if a cycle is shorter than the run, or its length is not known.
pub(super) fn check(plan: &Plan, scenes: usize) -> Result<(), ModelError> {
    let steps = plan.steps(scenes);
    if plan.schedule == Schedule::OnecyclePaper && steps > PAPER_STEPS {
        let what = format!(
            "the paper's cycle has {PAPER_STEPS} steps, the run {steps}; use \"onecycle\", which fits the run"
        );
        return Err(ModelError::invalid("optimise.schedule", what));
    }
    let cycles = plan
        .restarts
        .is_some_and(|(first, factor)| first.min(factor) > 0);
    if cycles != (plan.schedule == Schedule::Restarts) {
        let what = "belongs to schedule = \"restarts\", which has cycles of at least one epoch";
        return Err(ModelError::invalid("optimise.restarts", what));
    }
    Ok(())
}

/// Returns the settings at a step (from 0) of a plan's run over the given number of scenes.
pub(super) fn pace(plan: &Plan, step: u64, scenes: usize) -> Pace {
    let (steps, learning_rate) = (plan.steps(scenes), plan.learning_rate);
    let constant = |learning_rate| Pace {
        learning_rate,
        beta1: 0.9,
    };
    let fall =
        |at: u64, of: u64| constant(between(learning_rate, 0.0, at as f64 / of.max(1) as f64));
    match plan.schedule {
        Schedule::Constant => constant(learning_rate),
        Schedule::Cosine => fall(step, steps),
        Schedule::Restarts => {
            let (first, factor) = plan.restarts.unwrap_or((plan.epochs, 1));
            let per_epoch = plan.batches(scenes) / plan.accumulate as u64;
            let (mut at, mut cycle) = (step, (first * per_epoch).max(1));
            while at >= cycle {
                at -= cycle;
                cycle = cycle.saturating_mul(factor);
            }
            fall(at, cycle)
        }
        Schedule::Onecycle => cycle(step, steps, learning_rate),
        Schedule::OnecyclePaper => cycle(step, PAPER_STEPS, learning_rate),
    }
}

fn cycle(step: u64, steps: u64, learning_rate: f64) -> Pace {
    let (first, step) = (learning_rate / START, step as f64);
    let (slow, fast) = BETA1;
    // The last steps of the two phases, counted from 0, as PyTorch counts them.
    let top = WARM_UP * steps as f64 - 1.0;
    let end = steps as f64 - 1.0;
    if step <= top {
        // In a run of 100 steps, the first step has the greatest rate.
        let at = if top > 0.0 { step / top } else { 1.0 };
        return Pace {
            learning_rate: between(first, learning_rate, at),
            beta1: between(fast, slow, at),
        };
    }
    let at = if end > top {
        (step - top) / (end - top)
    } else {
        1.0
    };
    Pace {
        learning_rate: between(learning_rate, first / END, at.min(1.0)),
        beta1: between(slow, fast, at.min(1.0)),
    }
}

/// Interpolates from `a` to `b` along half a cosine.
fn between(a: f64, b: f64, at: f64) -> f64 {
    b + (a - b) / 2.0 * (libm::cos(std::f64::consts::PI * at) + 1.0)
}

#[cfg(test)]
mod tests {
    use picofarm_settings::{Schedule, ShadowVariant, Target};

    use super::{Plan, cycle, pace};
    use crate::{
        input::{Normalise, Question},
        net::NetSpec,
    };

    /// Returns a plan with steps of one scene each.
    fn plan(schedule: Schedule, epochs: u64) -> Plan {
        Plan {
            question: Question {
                target: Target::Tof,
                variant: ShadowVariant::Concat,
                normalise: Normalise::MinMax,
                bins: 8,
                intensity_only: false,
                spots: 0,
                depth_scale_m: 4.5,
                evidence: None,
            },
            net: NetSpec::released(8, 0, 1),
            epochs,
            batch: 1,
            accumulate: 1,
            learning_rate: 1e-2,
            decay: 0.0,
            schedule,
            restarts: None,
            clip_norm: None,
            ema: None,
            augment: false,
            early_stop: 0,
            validate_every: 0,
            seed: 0,
        }
    }

    #[test]
    fn the_papers_cycle_begins_at_4e_4_peaks_at_1e_2_and_stands_at_9_9e_3_where_the_real_run_ends()
    {
        let plan = plan(Schedule::OnecyclePaper, 68_500);
        let at = |step| pace(&plan, step, 1).learning_rate;
        assert!((at(0) - 4e-4).abs() < 1e-12);
        assert!((at(9_999) - 1e-2).abs() < 1e-12);
        assert!((at(68_499) - 9.9e-3).abs() < 1e-4, "{}", at(68_499));
    }

    #[test]
    fn a_fitted_cycle_ends_near_zero_and_short_runs_have_one_too() {
        for steps in [1, 2, 5, 99, 100, 101, 1_000] {
            for step in 0..steps {
                let pace = cycle(step, steps, 1e-2);
                assert!(
                    pace.learning_rate > 0.0 && pace.learning_rate <= 1e-2,
                    "{steps} {step} {pace:?}"
                );
                assert!((0.85..=0.95).contains(&pace.beta1));
            }
            let last = cycle(steps - 1, steps, 1e-2).learning_rate;
            assert!((last - 4e-8).abs() < 1e-12 || steps == 1, "{steps}: {last}");
        }
    }

    /// The expected values are those of the documented formula of PyTorch's
    /// `CosineAnnealingWarmRestarts` with T_0 = 4 and T_mult = 2, computed in Python.
    #[test]
    fn restarts_are_pytorchs() {
        let mut plan = plan(Schedule::Restarts, 14);
        plan.restarts = Some((4, 2));
        let expected = [
            0.01,
            0.008_535_533_905_932_738,
            0.005,
            0.001_464_466_094_067_262_4,
            0.01,
            0.009_619_397_662_556_434,
            0.008_535_533_905_932_738,
            0.006_913_417_161_825_449,
            0.005,
            0.003_086_582_838_174_551,
            0.001_464_466_094_067_262_4,
            0.000_380_602_337_443_566_4,
            0.01,
            0.009_903_926_402_016_154,
        ];
        for (step, expected) in expected.into_iter().enumerate() {
            let found = pace(&plan, step as u64, 1).learning_rate;
            assert!((found - expected).abs() < 1e-15, "{step}: {found}");
        }
    }
}
