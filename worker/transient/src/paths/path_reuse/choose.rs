//! Selects shared vertices among candidates.

use crate::{
    numeric::{rng::Rng, systematic::draw},
    paths::{path_reuse::sharing::Sharing, scratch::Scratch, tracer::Walk},
};

/// The constant added to the direct light of a candidate, in means of that light over all
/// candidates, because the light of walks is not predicted. 0.3 and 2 give the same medians.
const REST: f32 = 1.0;

impl Sharing {
    /// Selects `kept` of the candidates. `drawn` are the numbers of candidates drawn from the
    /// gather points and from the spots.
    pub(crate) fn choose(
        &mut self,
        walk: &Walk,
        (kept, drawn): (u32, (u32, u32)),
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        if self.shared.len() <= kept as usize {
            return;
        }
        let c = &mut self.candidates;
        c.look_at(&self.gathers);
        c.lit.resize(walk.emitters.list.len(), 0.0);
        c.worth.clear();
        for y in &self.shared {
            let worth = c.direct(walk, y, (&self.gathers, drawn), rng, scratch);
            c.worth.push(worth);
        }
        let mean = c.worth.iter().sum::<f32>() / c.worth.len() as f32;
        let rest = if mean > 0.0 { REST * mean } else { 1.0 };
        for w in &mut c.worth {
            *w += rest;
        }
        count(&c.worth, (kept, rng.uniform()), &mut c.counts);
        let mut counts = c.counts.iter();
        self.shared.retain_mut(|y| {
            y.counts = counts.next().copied().unwrap_or(0.0);
            y.counts > 0.0
        });
    }
}

/// Selects `kept` candidates in proportion to their worth, and writes the number of candidates that
/// each counts for, 0 for rejected ones. If the worths have no usable sum, all are selected,
/// because a rejected candidate must be compensated for.
fn count(worth: &[f32], (kept, u): (u32, f32), counts: &mut Vec<f32>) {
    counts.clear();
    counts.resize(worth.len(), 0.0);
    let mut any = false;
    draw(worth, kept, u, |k, share| {
        counts[k] = share / worth[k];
        any = true;
    });
    if !any {
        counts.fill(1.0);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use crate::paths::path_reuse::choose::count;

    proptest! {
        #[test]
        fn every_candidate_counts_for_one_on_average(
            worth in prop::collection::vec(0.01f32..10.0, 2..60), kept in 1u32..20,
        ) {
            const STEPS: usize = 4000;
            let (mut sums, mut counts) = (vec![0.0f64; worth.len()], vec![]);
            for k in 0..STEPS {
                count(&worth, (kept, (k as f32 + 0.5) / STEPS as f32), &mut counts);
                prop_assert!(counts.iter().filter(|&&c| c > 0.0).count() <= kept as usize + 1);
                for (sum, c) in sums.iter_mut().zip(&counts) {
                    *sum += f64::from(*c) / STEPS as f64;
                }
            }
            // A count is a step of the sum over the candidate's own part of it. The average over
            // STEPS is no more precise than that.
            let step = worth.iter().sum::<f32>() / kept as f32;
            for (sum, w) in sums.iter().zip(&worth) {
                let grain = 2.0 * f64::from(step / w) / STEPS as f64 + 1e-3;
                prop_assert!((sum - 1.0).abs() < grain, "{sum} of {w}");
            }
        }
    }

    #[test]
    fn none_is_dropped_where_worths_have_no_sum() {
        for worth in [
            [0.0; 3],
            [1e-35; 3],
            [f32::MAX; 3],
            [f32::INFINITY, 1.0, 1.0],
        ] {
            let mut counts = vec![];
            count(&worth, (2, 0.5), &mut counts);
            assert_eq!(counts, [1.0; 3], "{worth:?}");
        }
    }
}
