//! Decides which recorded outputs are checked against a store, and which of them count. Pure.

use std::collections::BTreeMap;

use picofarm_catalog::{Gone, Recorded, ResultSet, Run};
use picofarm_proto::spec::StageSpec;
use sha2::{Digest, Sha256};

use super::{conflicts::ReusedScenes, result_reader::ResultState};
use crate::core::plan::Outputs;

/// Up to this many outputs of a stage are all checked. Beyond it, those found before are sampled.
pub(crate) const ALL: usize = 1_000;
/// Size of the sample.
const SAMPLE: usize = 64;

/// The result of checking a stage's recorded outputs against its store.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Findings {
    /// Number of recorded outputs.
    pub recorded: u64,
    /// Outputs that count, ascending.
    pub counts: Vec<Run>,
    /// Outputs missing from the store.
    pub gone: Vec<Recorded>,
    /// Outputs that differ from their record.
    pub differ: Vec<Recorded>,
    /// Number of outputs that were never checked, and could not be checked now.
    pub unseen: u64,
    /// The reason why some outputs could not be checked.
    pub why: Option<String>,
    /// Records of other jobs with the same files.
    pub elsewhere: ReusedScenes,
}

impl Findings {
    /// Returns the records to delete before these tasks can run again.
    pub(crate) fn dropped(&self, set: &ResultSet) -> Vec<Gone> {
        let lost = self.gone.iter().chain(&self.differ);
        lost.map(|output| Gone {
            set: set.clone(),
            task: output.task,
            manifest: output.manifest,
        })
        .collect()
    }

    /// The same as a plan counts it.
    pub(crate) fn outputs(&self) -> Outputs {
        let lost = self.gone.len() + self.differ.len();
        Outputs {
            there: self.counts.clone(),
            explained: lost as u64 + self.unseen + self.elsewhere.scenes,
        }
    }

    /// Whether a job that is done has lost results by what was found. `trusted`: who asks is who
    /// had the job run.
    pub(crate) fn lost(&self, tasks: u64, trusted: bool) -> bool {
        !self.gone.is_empty()
            || !self.differ.is_empty()
            || self.recorded < tasks
            || (!trusted && self.unseen > 0)
    }

    /// Describes the findings for a plan.
    pub(crate) fn words(&self, stage: &StageSpec, set: &ResultSet) -> Vec<String> {
        let what = match stage.task.writes().is_some() {
            true => "scenes",
            false => "results",
        };
        let mut words = Vec::new();
        let (recorded, place) = (self.recorded, &set.store);
        let ReusedScenes { scenes, job } = &self.elsewhere;
        if *scenes > 0 {
            let of = job.map_or_else(|| "an earlier job".into(), |id| format!("job {id}"));
            words.push(format!(
                "{scenes} of {} scenes were made by {of} of files with the same content: workers look at each, and take it over",
                stage.tasks()
            ));
        }
        if !self.gone.is_empty() {
            let gone = self.gone.len();
            words.push(format!(
                "{gone} of {recorded} {what} recorded as done are gone from {place}: they will run again"
            ));
        }
        if !self.differ.is_empty() {
            let differ = self.differ.len();
            words.push(format!(
                "{differ} of {recorded} {what} recorded as done are not what lies in {place}: they will run again"
            ));
        }
        if let Some(why) = &self.why {
            words.push(match self.unseen {
                0 => format!("{place} could not be looked into now, because {why}: {what} found there before count as done"),
                n => format!(
                    "{n} of {recorded} {what} recorded as done could not be verified in {place}, because {why}"
                ),
            });
        }
        words
    }
}

/// Returns the positions of the outputs to check: all that were never checked, and all or a sample
/// of the others. `seed` determines the sample.
pub(crate) fn choose(recorded: &[Recorded], seed: &str) -> Vec<usize> {
    let (known, unknown): (Vec<usize>, Vec<usize>) =
        (0..recorded.len()).partition(|i| recorded[*i].checked);
    let mut chosen = match recorded.len() <= ALL {
        true => known,
        false => sample(known, seed),
    };
    chosen.extend(unknown);
    chosen.sort_unstable();
    chosen
}

/// Selects the outputs with the smallest hashes under the seed.
fn sample(mut from: Vec<usize>, seed: &str) -> Vec<usize> {
    if from.len() > SAMPLE {
        from.sort_by_cached_key(|i| {
            let mut hash = Sha256::new();
            hash.update(seed);
            hash.update(i.to_le_bytes());
            <[u8; 32]>::from(hash.finalize())
        });
        from.truncate(SAMPLE);
    }
    from
}

/// Returns whether the remaining outputs must be checked too, because one of the sample is missing.
pub(crate) fn suspicious(recorded: &[Recorded], found: &BTreeMap<u64, ResultState>) -> bool {
    recorded
        .iter()
        .any(|o| o.checked && found.get(&o.task).is_some_and(|f| *f != ResultState::Equal))
}

/// Reason why results in a folder missing from this machine cannot be checked.
pub(super) const NO_FOLDER: &str = "the coordinator's machine has no such folder (mount the store there, or name the stores it reaches with --check-stores)";

/// Derives the findings from the store's answers by task.
pub(crate) fn judge(
    recorded: &[Recorded],
    found: &BTreeMap<u64, ResultState>,
    why: Option<String>,
) -> Findings {
    let mut findings = Findings {
        recorded: recorded.len() as u64,
        why,
        ..Findings::default()
    };
    let absent = |f: &ResultState| matches!(f, ResultState::NoFolder | ResultState::NoStore);
    if findings.why.is_none()
        && recorded
            .iter()
            .any(|o| !o.checked && found.get(&o.task).is_some_and(absent))
    {
        findings.why = Some(NO_FOLDER.into());
    }
    for output in recorded {
        match found.get(&output.task) {
            // The output was found in this folder before.
            Some(ResultState::NoFolder | ResultState::NoStore) if output.checked => {
                findings.gone.push(*output)
            }
            Some(ResultState::NoFolder | ResultState::NoStore) => findings.unseen += 1,
            Some(ResultState::Gone) => findings.gone.push(*output),
            Some(ResultState::Differs) => findings.differ.push(*output),
            None if !output.checked => findings.unseen += 1,
            Some(ResultState::Equal) | None => match findings.counts.last_mut() {
                Some(run) if run.hi == output.task => run.hi += 1,
                _ => findings.counts.push(Run {
                    lo: output.task,
                    hi: output.task + 1,
                }),
            },
        }
    }
    findings
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn recorded(n: u64, checked: impl Fn(u64) -> bool) -> Vec<Recorded> {
        let one = |task| Recorded {
            task,
            manifest: [task as u8; 32],
            checked: checked(task),
        };
        (0..n).map(one).collect()
    }

    #[test]
    fn few_outputs_are_all_looked_at_and_of_many_a_sample_and_what_nobody_has_seen() {
        assert_eq!(choose(&recorded(1_000, |_| true), "a").len(), 1_000);
        let many = recorded(5_000, |task| task >= 100);
        let chosen = choose(&many, "a");
        assert_eq!(chosen.len(), 100 + SAMPLE);
        assert!((0..100).all(|i| chosen.contains(&i)));
        assert_eq!(chosen, choose(&many, "a"), "the seed decides");
        assert_ne!(chosen, choose(&many, "b"));
    }

    #[test]
    fn without_the_folder_only_results_that_were_found_in_it_are_gone() {
        let outputs = recorded(3, |task| task < 2);
        let found: BTreeMap<u64, ResultState> =
            (0..3).map(|task| (task, ResultState::NoFolder)).collect();
        let findings = judge(&outputs, &found, None);
        assert_eq!((findings.gone.len(), findings.unseen), (2, 1));
        assert!(
            findings
                .why
                .is_some_and(|why| why.contains("no such folder"))
        );
        let never = recorded(3, |_| false);
        assert!(
            !judge(&never, &found, None).lost(3, true),
            "it may be on another machine"
        );
    }

    #[test]
    fn a_reported_output_that_nobody_could_look_at_does_not_count() {
        let outputs = recorded(4, |task| task < 2);
        let findings = judge(&outputs, &BTreeMap::new(), Some("it is far".into()));
        assert_eq!(findings.counts, [Run { lo: 0, hi: 2 }]);
        assert_eq!(findings.unseen, 2);
        assert!(!findings.lost(4, true));
        assert!(findings.lost(4, false), "another's job is not believed");
        assert!(findings.lost(5, true), "one is not recorded at all");
    }

    proptest! {
        #[test]
        fn every_output_counts_or_is_gone_or_differs_or_was_not_seen(
            all in prop::collection::vec((any::<bool>(), prop::option::of(0..3u8)), 0..50),
        ) {
            let outputs = recorded(all.len() as u64, |task| all[task as usize].0);
            let of = |n| [ResultState::Equal, ResultState::Gone, ResultState::Differs][usize::from(n)];
            let found: BTreeMap<u64, ResultState> = (0u64..)
                .zip(&all)
                .filter_map(|(task, (_, found))| Some((task, of((*found)?))))
                .collect();
            let findings = judge(&outputs, &found, None);
            let counts: u64 = findings.counts.iter().map(|r| r.hi - r.lo).sum();
            let lost = (findings.gone.len() + findings.differ.len()) as u64;
            prop_assert_eq!(counts + lost + findings.unseen, outputs.len() as u64);
            for run in &findings.counts {
                for task in run.lo..run.hi {
                    let seen = found.get(&task) == Some(&ResultState::Equal);
                    prop_assert!(seen || (outputs[task as usize].checked && !found.contains_key(&task)));
                }
            }
        }
    }
}
