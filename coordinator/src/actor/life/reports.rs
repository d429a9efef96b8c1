//! Commits or refuses reported results, after they were checked where that is necessary.

use std::collections::{HashMap, hash_map::Entry};

use picofarm_proto::{ids::StageRef, messages::Finished};

use super::Life;
use crate::{
    actor::{command::StoreCheck, slow_work::Dispute},
    core::{OutputHint, Reported, SessionId},
    observe::trace,
};

/// Most disputed reports that are checked against a store at a time. For further reports the
/// recorded result stands.
const MOST_DISPUTES: usize = 64;

/// The recorded manifest hash of each task in a batch of reports.
pub(super) type KnownManifests = HashMap<(StageRef, u64), Option<[u8; 32]>>;

impl Life<'_> {
    /// Starts a check of reported results against their store. Each store has one check at a time;
    /// reports that arrive meanwhile are part of the next check.
    pub(super) fn start_check(&mut self, store: String, reports: Vec<Reported>) {
        match self.checking.entry(store) {
            Entry::Occupied(mut waiting) => waiting.get_mut().extend(reports),
            Entry::Vacant(entry) if !reports.is_empty() => {
                self.actor.slow_work.verify(entry.key().clone(), reports);
                entry.insert(Vec::new());
            }
            Entry::Vacant(_) => {}
        }
    }

    /// Commits or refuses the reports that were checked against their store.
    pub(super) fn verified(
        &mut self,
        store: &str,
        reports: Vec<(Reported, StoreCheck)>,
        blind: bool,
        known: &KnownManifests,
    ) {
        if blind {
            self.core.forgive(store);
        }
        for (
            Reported {
                session, report, ..
            },
            verdict,
        ) in reports
        {
            match verdict {
                StoreCheck::Contradicted(why) => {
                    self.core.contradicted(session, &report, &why, self.now());
                }
                _ if self.disputed(session, &report, known) => {}
                verdict => self.done(session, &report, known, verdict == StoreCheck::Held),
            }
        }
        if let Some(waiting) = self.checking.remove(store) {
            self.start_check(store.to_owned(), waiting);
        }
    }

    /// Returns whether this is the second report of a result that differs from the record. If so,
    /// the record is replaced first and the report is answered afterwards.
    pub(super) fn outvoted(
        &mut self,
        session: SessionId,
        report: &Finished,
        known: &KnownManifests,
    ) -> bool {
        let Some(dispute) = self.dispute(report, known) else {
            return false;
        };
        let outvoted = self.core.outvoted(session, report);
        if outvoted {
            self.disputes += 1;
            self.actor.slow_work.replace(session, report, dispute);
        }
        outvoted
    }

    /// Returns whether the store must be checked before this report is answered. This is the case
    /// if a different manifest is recorded, because the earlier report is not necessarily the right
    /// one.
    pub(super) fn disputed(
        &mut self,
        session: SessionId,
        report: &Finished,
        known: &KnownManifests,
    ) -> bool {
        let Some(dispute) = self.dispute(report, known) else {
            return false;
        };
        let asked =
            self.disputes < MOST_DISPUTES && self.actor.slow_work.judge(session, report, dispute);
        self.disputes += usize::from(asked);
        asked || self.outvoted(session, report, known)
    }

    /// Returns the record that a report contradicts.
    fn dispute(&self, report: &Finished, known: &KnownManifests) -> Option<Dispute> {
        let stage = self.core.stage_of(report)?;
        let recorded = known.get(&(stage, report.index)).copied().flatten()?;
        let same = hex::encode(recorded).eq_ignore_ascii_case(&report.manifest_sha256);
        (!same).then_some(Dispute { stage, recorded })
    }

    pub(super) fn done(
        &mut self,
        session: SessionId,
        report: &Finished,
        known: &KnownManifests,
        checked: bool,
    ) {
        self.commits.extend(trace::commit(report));
        let stage = self.core.stage_of(report);
        let hint = stage.and_then(|stage| known.get(&(stage, report.index)).copied().flatten());
        let now = self.now();
        self.core
            .finished(session, report, OutputHint(hint), checked, now);
    }
}
