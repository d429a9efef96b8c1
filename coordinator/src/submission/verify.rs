//! Looks for reported results in their stores before they are committed.
//!
//! A report is only refused if this coordinator surely sees the store that the worker writes to: it found another result
//! there before and still finds it, or a single worker contradicts a store whose folder exists here (or, if the worker is on
//! this machine, whose folder should). If it finds nothing of what two workers report, it takes itself for the one that sees
//! another disk, and commits the results as unverified.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::{Arc, Mutex},
    time::Duration,
};

use picofarm_catalog::Recorded;
use picofarm_proto::{
    ids::{StageRef, WorkerId},
    model::JobSpec,
};

use super::{Submissions, look};
use crate::{actor::Verdict, core::Reported, stored::Found};

/// A result that is missing is looked for again after so long: a network's file system may show it late.
const AGAIN: Duration = Duration::from_millis(500);
/// Stores remembered at most.
const STORES: usize = 1_024;

/// What is known of whether this coordinator sees the stores of its workers.
pub(super) type Evidence = Arc<Mutex<HashMap<String, Seen>>>;

/// What this coordinator has seen of a store.
#[derive(Debug, Default)]
pub(super) struct Seen {
    /// A result that it found there.
    witness: Option<(Arc<JobSpec>, StageRef, Recorded)>,
    /// Workers whose reports it did not find before it found any.
    doubted: BTreeSet<WorkerId>,
}

impl Submissions {
    /// What the store holds of reported results, and whether it turned out to be another one than that of the workers.
    pub(super) async fn verified(
        &self,
        store: &str,
        reports: Vec<Reported>,
    ) -> (Vec<(Reported, Verdict)>, bool) {
        // Two reports of one task are two questions.
        let mut questions: BTreeMap<(StageRef, usize), Vec<Reported>> = BTreeMap::new();
        let mut seen = HashMap::new();
        for reported in reports {
            let stage = reported.stage;
            let nth = seen.entry((stage, reported.report.index)).or_insert(0);
            questions.entry((stage, *nth)).or_default().push(reported);
            *nth += 1;
        }
        let (mut verdicts, mut blind) = (Vec::new(), false);
        for reports in questions.into_values() {
            let mut found = self.find(store, &reports).await;
            if found
                .iter()
                .any(|f| matches!(f, Some(Found::Gone | Found::Differs)))
            {
                tokio::time::sleep(AGAIN).await;
                found = self.find(store, &reports).await;
            }
            for (reported, found) in reports.into_iter().zip(found) {
                let verdict = match found {
                    Some(Found::Equal) => {
                        self.seen(store, |seen| {
                            seen.witness = Some(witness(&reported));
                            seen.doubted.clear();
                        });
                        Verdict::Held
                    }
                    Some(Found::NoStore) if reported.here => {
                        self.missing(store, &reported, "holds no such result").await
                    }
                    None | Some(Found::NoFolder | Found::NoStore) => Verdict::Unknown,
                    Some(Found::Gone) => {
                        self.missing(store, &reported, "holds no such result").await
                    }
                    Some(Found::Differs) => {
                        self.missing(store, &reported, "holds another result").await
                    }
                };
                let looked = match found {
                    Some(Found::Gone | Found::Differs) => true,
                    Some(Found::NoStore) => reported.here,
                    _ => false,
                };
                blind |= verdict == Verdict::Unknown && looked;
                verdicts.push((reported, verdict));
            }
        }
        (verdicts, blind)
    }

    /// What the store holds, by report; `None` if it could not be asked.
    async fn find(&self, store: &str, reports: &[Reported]) -> Vec<Option<Found>> {
        let Some(first) = reports.first() else {
            return Vec::new();
        };
        let Some(stage) = first.job.stages.get(first.stage.stage as usize) else {
            return vec![None; reports.len()];
        };
        let results: Vec<Recorded> = reports.iter().map(|r| witness(r).2).collect();
        let (found, why) = self.stores.look(stage, store, &results, look::soon()).await;
        if let Some(why) = why {
            tracing::debug!(store, why, "reported results are not verified");
        }
        results
            .iter()
            .map(|result| found.get(&result.task).copied())
            .collect()
    }

    /// The verdict on a result that the store does not hold as it was reported.
    async fn missing(&self, store: &str, reported: &Reported, what: &str) -> Verdict {
        let witness = self.seen(store, |seen| seen.witness.clone());
        let sure = match witness {
            Some((job, stage, result)) => {
                let found = match job.stages.get(stage.stage as usize) {
                    Some(spec) => {
                        self.stores
                            .look(spec, store, &[result], look::soon())
                            .await
                            .0
                    }
                    None => BTreeMap::new(),
                };
                found.get(&result.task) == Some(&Found::Equal)
            }
            None => self.seen(store, |seen| {
                seen.doubted.insert(reported.worker);
                seen.doubted.len() < 2
            }),
        };
        if !sure {
            tracing::warn!(
                store,
                "what workers report is not there as this coordinator sees it: results are not verified. Mount the store \
                 here, or start the coordinator with --check-stores none"
            );
            return Verdict::Unknown;
        }
        Verdict::Contradicted(format!(
            "task {} was reported as done with manifest {}, but {store} {what} as the coordinator sees it. The worker may \
             write to another disk (is the store mounted there?), or it does not tell the truth",
            reported.report.index, reported.report.manifest_sha256
        ))
    }

    /// Why what a store holds here says nothing: nothing was found of what workers reported.
    pub(super) fn sees_another_disk(&self, store: &str) -> Option<String> {
        let blind = self.seen(store, |seen| {
            seen.witness.is_none() && seen.doubted.len() >= 2
        });
        blind.then(|| {
            "the coordinator finds none of what workers report there, and may see another disk (mount the store there, or \
             start it with --check-stores none)"
                .to_owned()
        })
    }

    fn seen<T>(&self, store: &str, with: impl FnOnce(&mut Seen) -> T) -> T {
        let mut evidence = self.evidence.lock().expect("no panic while locked");
        if evidence.len() > STORES {
            evidence.clear();
        }
        with(evidence.entry(store.to_owned()).or_default())
    }
}

/// A reported result as a store is asked about it.
fn witness(reported: &Reported) -> (Arc<JobSpec>, StageRef, Recorded) {
    let mut manifest = [0; 32];
    // A hash that cannot be read equals none; the core refuses the report for it.
    let _ = hex::decode_to_slice(&reported.report.manifest_sha256, &mut manifest);
    let result = Recorded {
        task: reported.report.index,
        manifest,
        checked: false,
    };
    (Arc::clone(&reported.job), reported.stage, result)
}
