//! The commit rule: a result is accepted only from the holder of a live lease, and each task has
//! one result.

use picofarm_catalog::{Output, Range, RangeState};
use picofarm_proto::{
    ids::StageRef,
    key::task_key,
    messages::{EventKind, Finished},
};

use super::{
    history::EventDetails, message::SessionId, stage_entry::StageEntry, state::Core,
    store_faults::store_of, transition::RangeEvent,
};

/// The recorded result of a reported task, which is looked up before [`Core::finished`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct OutputHint(pub Option<[u8; 32]>);

impl Core {
    /// Returns the stage of a reported task. The stage is found by the lease, or else by the task
    /// key.
    pub(crate) fn stage_of(&self, report: &Finished) -> Option<StageRef> {
        let fits =
            |entry: &StageEntry| task_key(self.stages.key_of(entry), report.index) == report.key;
        if let Some(run) = self.second_runs.get(report.lease.range) {
            return fits(self.stages.get(&run.stage)?).then_some(run.stage);
        }
        if let Some(id) = self.leases.stage_of(report.lease.range) {
            return fits(&self.stages[&id]).then_some(id);
        }
        self.stages
            .iter()
            .rev()
            .find(|(_, entry)| fits(entry))
            .map(|(id, _)| *id)
    }

    /// Commits a finished task, or refuses it with a reason. `hint` is the recorded result.
    /// `checked` means that its store contains the result.
    pub(crate) fn finished(
        &mut self,
        session: SessionId,
        report: &Finished,
        hint: OutputHint,
        checked: bool,
        now_ms: i64,
    ) {
        let Some(worker) = self.workers.id_of(session) else {
            return;
        };
        let verdict = self.commit(session, report, (hint, checked), now_ms);
        if let Err(reason) = &verdict {
            tracing::info!(%worker, range = %report.lease.range, task = report.index, reason, "report refused");
        }
        self.outcome
            .acknowledge(session, report.lease, report.index, verdict);
    }

    /// Adds a warning about a reported task to the history.
    pub(crate) fn alarm(
        &mut self,
        session: SessionId,
        report: &Finished,
        message: String,
        now_ms: i64,
    ) {
        let Some(stage) = self.stage_of(report) else {
            return;
        };
        let name = self.workers.session_name(session);
        tracing::error!(job = %stage.job, worker = name, "{message}");
        let about = EventDetails::message(message)
            .task(report.index)
            .worker(name);
        self.outcome.event(now_ms, stage, EventKind::Alarm, about);
    }

    fn commit(
        &mut self,
        session: SessionId,
        report: &Finished,
        (OutputHint(known), checked): (OutputHint, bool),
        now_ms: i64,
    ) -> Result<(), String> {
        let mut manifest = [0; 32];
        hex_into(&report.manifest_sha256, &mut manifest)
            .ok_or("manifest_sha256: expected 64 hexadecimal digits")?;
        let id = self.stage_of(report).ok_or(
            "the task key names no task of an active job: it has ended, or the worker's renderer or settings differ",
        )?;
        let set = self.stages[&id].set();
        let known = known.or_else(|| self.outcome.new_output(set, report.index));
        let second = self
            .workers
            .id_of(session)
            .and_then(|worker| self.second_run(worker, report.lease))
            .filter(|(run, _)| run.task == report.index)
            .map(|(_, range)| range.clone());
        let live = match second {
            Some(range) => {
                self.drop_second_run(session, report.lease);
                Ok(range)
            }
            None => self
                .held_to_do(session, report.lease, report.index, now_ms)
                .cloned(),
        };
        match (live, known) {
            (Ok(range), None) => {
                self.commit_new(session, id, &range, report, (manifest, checked), now_ms);
                Ok(())
            }
            (Ok(range), Some(known))
                if known != manifest && self.doubts.disputed(set, report.index) =>
            {
                let message = format!(
                    "task {} has two different results: manifest {} is recorded, and {} was reported now. Nobody can look \
                     into the store, so the task runs again: what two other workers agree on counts",
                    report.index,
                    hex_of(&known),
                    report.manifest_sha256
                );
                self.rerun_undecided(&range, session, report.index, &message, now_ms);
                Err(message)
            }
            (live, Some(known)) => {
                // The task is done, because the output is valid whichever worker made it.
                let had_it = live.is_ok();
                if let Ok(range) = live {
                    self.mark(
                        &range,
                        &RangeEvent::Finish {
                            task: report.index,
                            reused: true,
                        },
                    );
                    self.perhaps_over(id, now_ms);
                }
                if known == manifest {
                    if had_it {
                        let kind = match report.adopted {
                            true => EventKind::Reused,
                            false => EventKind::Committed,
                        };
                        let about = EventDetails::message("the same result as before")
                            .task(report.index)
                            .worker(self.workers.session_name(session))
                            .seconds(report.seconds);
                        self.outcome.event(now_ms, id, kind, about);
                    }
                    return Ok(());
                }
                let name = self.workers.session_name(session);
                let message = format!(
                    "task {} has two different results: manifest {} is recorded, and {} was reported now; the recorded one stands",
                    report.index,
                    hex_of(&known),
                    report.manifest_sha256
                );
                tracing::error!(job = %id.job, worker = name, "{message}");
                let about = EventDetails::message(message.clone())
                    .task(report.index)
                    .worker(name);
                self.outcome.event(now_ms, id, EventKind::Alarm, about);
                Err(message)
            }
            (Err(reason), None) => Err(reason),
        }
    }

    fn commit_new(
        &mut self,
        session: SessionId,
        id: StageRef,
        range: &Range,
        report: &Finished,
        (manifest, checked): ([u8; 32], bool),
        now_ms: i64,
    ) {
        let task = report.index;
        let set = self.stages[&id].set();
        self.store_faults.mended((id, task));
        let worker = self.workers.id_of(session);
        if let (Some(worker), Some(entry)) = (worker, self.stages.get_mut(&id)) {
            entry.blocklist.succeeded(worker);
            self.failing_workers.succeeded(worker);
            let task = &entry.spec().task;
            if !report.adopted {
                self.store_faults.worked(store_of(task), worker);
            }
        }
        let output = Output {
            stage: id,
            task,
            manifest,
            bytes: report.bytes,
            seconds: report.seconds,
            epoch: range.epoch,
            adopted: report.adopted,
            checked,
        };
        self.outcome.record_output(set, output);
        if !checked && let Some(worker) = worker {
            self.doubts.unverified(set, task, worker);
        }
        let kind = if report.adopted {
            EventKind::Reused
        } else {
            self.stages.add_time(set, report.seconds, report.bytes);
            if let Some(worker) = worker {
                self.count_task(id, worker, report, now_ms);
            }
            EventKind::Committed
        };
        let about = EventDetails::default()
            .task(task)
            .worker(self.workers.session_name(session))
            .seconds(report.seconds);
        self.outcome.event(now_ms, id, kind, about);
        self.mark(
            range,
            &RangeEvent::Finish {
                task,
                reused: report.adopted,
            },
        );
        self.stop_first(session, range);
        self.perhaps_over(id, now_ms);
        self.settle_for_others(id, task, now_ms);
    }

    /// Tells the holder of a lease to stop if the second run of its last task finished first.
    fn stop_first(&mut self, by: SessionId, range: &Range) {
        let RangeState::Leased(lease) = &range.state else {
            return;
        };
        if let Some(holder) = self.workers.get(&lease.worker)
            && holder.session != by
            && self.range(range.id).is_none()
        {
            self.outcome.revoke(
                holder.session,
                range.lease(),
                "its last task was finished by another worker",
            );
        }
    }
}

fn hex_into(text: &str, bytes: &mut [u8; 32]) -> Option<()> {
    hex::decode_to_slice(text, bytes).ok()
}

fn hex_of(bytes: &[u8; 32]) -> String {
    hex::encode(bytes)
}
