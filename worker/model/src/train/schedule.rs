//! How fast is learned, step by step.

use picofarm_settings::Schedule;

use crate::ModelError;

/// Where the rate and the first moment stand at a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pace {
    /// Learning rate.
    pub learning_rate: f64,
    /// β₁ of AdamW. PyTorch's one cycle moves it too, against the rate.
    pub beta1: f64,
}

/// Steps of the released code's cycle.
const PAPER_STEPS: u64 = 1_000_000;
/// Share of the warm-up.
const WARM_UP: f64 = 0.01;
/// The cycle begins at the greatest rate over this …
const START: f64 = 25.0;
/// … and ends at its beginning over this.
const END: f64 = 1e4;
/// β₁ between these (PyTorch's `base_momentum` and `max_momentum`).
const BETA1: (f64, f64) = (0.85, 0.95);

/// Checks the run's length.
///
/// # Errors
/// [`ModelError::Invalid`] where a cycle is shorter than the run.
pub(super) fn check(schedule: Schedule, steps: u64) -> Result<(), ModelError> {
    if schedule == Schedule::OnecyclePaper && steps > PAPER_STEPS {
        let what = format!(
            "the paper's cycle has {PAPER_STEPS} steps, the run {steps}; use \"onecycle\", which fits the run"
        );
        return Err(ModelError::invalid("optimise.schedule", what));
    }
    Ok(())
}

/// The pace at a step (from 0) of a run of `steps`, with the greatest rate `learning_rate`.
pub(super) fn pace(schedule: Schedule, step: u64, steps: u64, learning_rate: f64) -> Pace {
    let constant = |learning_rate| Pace {
        learning_rate,
        beta1: 0.9,
    };
    match schedule {
        Schedule::Constant => constant(learning_rate),
        Schedule::Cosine => constant(between(
            learning_rate,
            0.0,
            step as f64 / steps.max(1) as f64,
        )),
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
        // Of a run of 100 steps the first is the top.
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

/// From `a` to `b` on half a cosine.
fn between(a: f64, b: f64, at: f64) -> f64 {
    b + (a - b) / 2.0 * (libm::cos(std::f64::consts::PI * at) + 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_cycle_begins_at_4e_4_peaks_at_1e_2_and_stands_at_9_9e_3_where_the_real_run_ends()
    {
        let at = |step| pace(Schedule::OnecyclePaper, step, 68_500, 1e-2).learning_rate;
        assert!((at(0) - 4e-4).abs() < 1e-12);
        assert!((at(9_999) - 1e-2).abs() < 1e-12);
        assert!((at(68_499) - 9.9e-3).abs() < 1e-4, "{}", at(68_499));
    }

    #[test]
    fn a_fitted_cycle_ends_near_zero_and_short_runs_have_one_too() {
        for steps in [1, 2, 5, 99, 100, 101, 1_000] {
            for step in 0..steps {
                let pace = pace(Schedule::Onecycle, step, steps, 1e-2);
                assert!(
                    pace.learning_rate > 0.0 && pace.learning_rate <= 1e-2,
                    "{steps} {step} {pace:?}"
                );
                assert!((0.85..=0.95).contains(&pace.beta1));
            }
            let last = pace(Schedule::Onecycle, steps - 1, steps, 1e-2).learning_rate;
            assert!((last - 4e-8).abs() < 1e-12 || steps == 1, "{steps}: {last}");
        }
    }
}
