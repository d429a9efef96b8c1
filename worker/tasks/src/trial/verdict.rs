//! Decides whether a trial continues, by the losses of other trials at the same rung. Pure;
//! [`picofarm_proto::spec::Stop`] documents the rules.

use std::cmp::Ordering;

use picofarm_proto::spec::Stop;
use picofarm_results::Rung;

/// The decision on a trial.
pub(super) struct Verdict {
    pub(super) goes_on: bool,
    /// The reason, as the middle of a sentence about the trial.
    pub(super) why: String,
}

/// Judges a trial by the trials `there` at the same rung, which include itself. `best` is its
/// lowest loss so far.
pub(super) fn verdict(stop: &Stop, ours: &Rung, best: f64, there: &[Rung]) -> Verdict {
    match stop {
        Stop::Halving(halving) | Stop::Hyperband(halving) => {
            let (place, goes_on) = among_the_best(ours, there, halving.factor);
            let why = format!("is number {place} of {}", there.len());
            Verdict { goes_on, why }
        }
        Stop::Median(rule) => {
            let others = there.iter().filter(|other| other.index != ours.index);
            let mut losses: Vec<f64> = others.map(|other| other.loss).collect();
            if losses.len() < rule.least as usize {
                let why = format!("is one of {}, too few to compare", losses.len() + 1);
                return Verdict { goes_on: true, why };
            }
            let median = median(&mut losses);
            let why = format!(
                "has come to {best:.4} at best, and the median of {} others is {median:.4}",
                losses.len()
            );
            Verdict {
                goes_on: best <= median,
                why,
            }
        }
    }
}

/// Returns the rank of a trial, from 1, among those that have reached a rung, and whether it
/// continues. The best 1/factor of them do, and at least one.
fn among_the_best(ours: &Rung, there: &[Rung], factor: u32) -> (usize, bool) {
    let better = |other: &&Rung| {
        other.index != ours.index
            && (other.loss, other.index).partial_cmp(&(ours.loss, ours.index))
                == Some(Ordering::Less)
    };
    let place = 1 + there.iter().filter(better).count();
    (place, place <= (there.len() / factor as usize).max(1))
}

/// Returns the median of some numbers. For an even count, this is the mean of the two middle
/// values.
fn median(numbers: &mut [f64]) -> f64 {
    numbers.sort_by(f64::total_cmp);
    let middle = numbers.len() / 2;
    match numbers.len() % 2 {
        1 => numbers[middle],
        _ => numbers[middle - 1].midpoint(numbers[middle]),
    }
}

#[cfg(test)]
mod tests {
    use picofarm_proto::spec::{Halving, Median};
    use proptest::prelude::*;

    use super::*;

    fn rungs(losses: &[f64]) -> Vec<Rung> {
        let rung = |(index, loss): (usize, &f64)| Rung {
            index: index as u64,
            epochs: 3,
            loss: *loss,
        };
        losses.iter().enumerate().map(rung).collect()
    }

    fn halving(ours: &Rung, there: &[Rung], factor: u32) -> bool {
        let stop = Stop::Halving(Halving { first: 3, factor });
        verdict(&stop, ours, ours.loss, there).goes_on
    }

    fn median_of(least: u32) -> Stop {
        Stop::Median(Median {
            first: 3,
            every: 1,
            least,
        })
    }

    #[test]
    fn the_first_goes_on_and_then_the_best_of_so_many() {
        let there = rungs(&[0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.1]);
        let on: Vec<bool> = (0..7)
            .map(|i| halving(&there[i], &there[..=i], 3))
            .collect();
        assert_eq!(on, [true, true, false, true, false, true, true]);
        // The two best of seven.
        let late: Vec<bool> = there.iter().map(|r| halving(r, &there, 3)).collect();
        assert_eq!(late, [false, false, false, false, false, true, true]);
        assert_eq!(among_the_best(&there[0], &there, 3).0, 5);
    }

    #[test]
    fn equals_are_told_apart_by_their_number() {
        let there = rungs(&[0.5; 6]);
        let on = there.iter().filter(|r| halving(r, &there, 3)).count();
        assert_eq!(on, 2);
    }

    #[test]
    fn who_is_worse_than_the_median_of_the_others_stops_once_there_are_enough() {
        let there = rungs(&[0.1, 0.2, 0.4, 0.5, 0.3]);
        let on = |i: usize, best: f64, least: u32| {
            verdict(&median_of(least), &there[i], best, &there).goes_on
        };
        // The median of the trials other than 4 is 0.3.
        assert!(on(4, 0.3, 4));
        assert!(!on(4, 0.3001, 4));
        assert!(on(4, 0.3001, 5), "four others are too few");
        // The best loss so far counts, not the latest.
        assert!(on(3, 0.25, 4) && !on(3, 0.5, 4));
        let alone = &there[..1];
        assert!(verdict(&median_of(1), &alone[0], 9.0, alone).goes_on);
    }

    proptest! {
        #[test]
        fn by_the_median_the_better_half_always_goes_on(losses in prop::collection::vec(0.0..1.0f64, 2..40)) {
            let there = rungs(&losses);
            let mut sorted = losses.clone();
            let middle = median(&mut sorted);
            for ours in &there {
                let goes_on = verdict(&median_of(1), ours, ours.loss, &there).goes_on;
                if ours.loss < middle {
                    prop_assert!(goes_on);
                }
                if ours.loss > sorted[sorted.len() / 2] {
                    prop_assert!(!goes_on);
                }
            }
        }

        #[test]
        fn of_all_that_have_come_to_a_rung_one_in_so_many_goes_on(losses in prop::collection::vec(0.0..1.0f64, 1..60), factor in 2u32..5) {
            let there = rungs(&losses);
            let on = there.iter().filter(|r| halving(r, &there, factor)).count();
            prop_assert_eq!(on, (there.len() / factor as usize).max(1));
        }
    }
}
