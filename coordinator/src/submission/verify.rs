//! Checks reported results against their stores before they are committed.
//!
//! A report is refused only if this coordinator certainly sees the store that the worker writes to.
//! This is so if it found another result there before and still finds it. It is also so if a single
//! worker contradicts a store with a folder that exists here, or that should exist here because the
//! worker is on this machine. If it finds none of the results that two workers report, it assumes
//! that it sees another disk, and commits the results as unverified.

use std::{
    collections::{BTreeMap, HashMap},
    sync::Arc,
    time::Duration,
};

use picofarm_catalog::Recorded;
use picofarm_proto::{ids::StageRef, spec::JobSpec};

use super::{result_reader::ResultState, service::Submissions, store_checks::report_deadline};
use crate::{actor::StoreCheck, core::Reported};

/// Delay before a missing result is looked up again, because a network file system may show it
/// late.
const AGAIN: Duration = Duration::from_millis(500);
impl Submissions {
    /// Checks reported results against the store. Also returns whether the store turned out not to
    /// be the workers' one.
    pub(super) async fn verified(
        &self,
        store: &str,
        reports: Vec<Reported>,
    ) -> (Vec<(Reported, StoreCheck)>, bool) {
        // Two reports of one task are checked separately.
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
                .any(|f| matches!(f, Some(ResultState::Gone | ResultState::Differs)))
            {
                tokio::time::sleep(AGAIN).await;
                found = self.find(store, &reports).await;
            }
            for (reported, found) in reports.into_iter().zip(found) {
                let verdict = match found {
                    Some(ResultState::Equal) => {
                        self.evidence.with(store, |seen| {
                            seen.witness = Some(witness(&reported));
                            seen.doubted.clear();
                        });
                        StoreCheck::Held
                    }
                    Some(ResultState::NoStore) if reported.here => {
                        self.missing(store, &reported, "holds no such result").await
                    }
                    None | Some(ResultState::NoFolder | ResultState::NoStore) => {
                        StoreCheck::Unknown
                    }
                    Some(ResultState::Gone) => {
                        self.missing(store, &reported, "holds no such result").await
                    }
                    Some(ResultState::Differs) => {
                        self.missing(store, &reported, "holds another result").await
                    }
                };
                let looked = match found {
                    Some(ResultState::Gone | ResultState::Differs) => true,
                    Some(ResultState::NoStore) => reported.here,
                    _ => false,
                };
                blind |= verdict == StoreCheck::Unknown && looked;
                verdicts.push((reported, verdict));
            }
        }
        (verdicts, blind)
    }

    /// Returns the store's answer to each report; `None` if the store could not be checked.
    async fn find(&self, store: &str, reports: &[Reported]) -> Vec<Option<ResultState>> {
        let Some(first) = reports.first() else {
            return Vec::new();
        };
        let Some(stage) = first.job.stages.get(first.stage.stage as usize) else {
            return vec![None; reports.len()];
        };
        let results: Vec<Recorded> = reports.iter().map(|r| witness(r).2).collect();
        let (found, why) = self
            .stores
            .check(stage, store, &results, report_deadline())
            .await;
        if let Some(why) = why {
            tracing::debug!(store, why, "reported results are not verified");
        }
        results
            .iter()
            .map(|result| found.get(&result.task).copied())
            .collect()
    }

    /// Returns the verdict on a result that the store does not contain as reported.
    async fn missing(&self, store: &str, reported: &Reported, what: &str) -> StoreCheck {
        let witness = self.evidence.with(store, |seen| seen.witness.clone());
        let sure = match witness {
            Some((job, stage, result)) => {
                let found = match job.stages.get(stage.stage as usize) {
                    Some(spec) => {
                        self.stores
                            .check(spec, store, &[result], report_deadline())
                            .await
                            .0
                    }
                    None => BTreeMap::new(),
                };
                found.get(&result.task) == Some(&ResultState::Equal)
            }
            None => self.evidence.with(store, |seen| {
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
            return StoreCheck::Unknown;
        }
        StoreCheck::Contradicted(format!(
            "task {} was reported as done with manifest {}, but {store} {what} as the coordinator sees it. The worker may \
             write to another disk (is the store mounted there?), or it does not tell the truth",
            reported.report.index, reported.report.manifest_sha256
        ))
    }
}

/// Returns a reported result in the form in which a store is checked.
fn witness(reported: &Reported) -> (Arc<JobSpec>, StageRef, Recorded) {
    let mut manifest = [0; 32];
    // An invalid hash equals no other; the core refuses the report because of it.
    let _ = hex::decode_to_slice(&reported.report.manifest_sha256, &mut manifest);
    let result = Recorded {
        task: reported.report.index,
        manifest,
        checked: false,
    };
    (Arc::clone(&reported.job), reported.stage, result)
}
