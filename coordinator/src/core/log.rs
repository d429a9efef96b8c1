//! Adds the log lines of tasks to their history.

use picofarm_proto::messages::{EventKind, TaskLog};

use super::{history::EventDetails, message::SessionId, state::Core};

impl Core {
    /// Records log lines of a task that this session's worker runs, within the task's allowance.
    /// Drops them if the lease is not the worker's own or not live. No answer is sent.
    pub(crate) fn logged(&mut self, session: SessionId, log: &TaskLog, now_ms: i64) {
        // A task that runs twice has one allowance.
        let second = self
            .workers
            .id_of(session)
            .and_then(|worker| self.second_run(worker, log.lease))
            .filter(|(run, _)| run.task == log.index)
            .map(|(_, range)| range);
        let held = || self.held_to_do(session, log.lease, log.index, now_ms).ok();
        let Some(range) = second.or_else(held) else {
            return;
        };
        let (range, stage) = (range.id, range.stage);
        let worker = self.workers.session_name(session);
        for line in &log.lines {
            let task = self.leases.progress_mut(range, log.index, now_ms);
            if !task.log.take(line.text.len()) {
                return;
            }
            let about = EventDetails::message(format!("{}: {}", line.level, line.text))
                .task(log.index)
                .worker(&*worker);
            let at_ms = now_ms - i64::from(line.ago_ms);
            self.outcome.event(at_ms, stage, EventKind::Log, about);
        }
    }
}
