//! Removes rows that a database rejects for their content from a change set, so that the rest
//! becomes durable. A task with a result that cannot be recorded is given up with the reason. A
//! message that cannot be recorded is replaced by the reason.

use picofarm_catalog::{Changes, Culprit, Mark, NewEvent, Range, RangeState, Row, Run};
use picofarm_proto::{
    ids::{LeaseRef, StageRef, WorkerId},
    messages::EventKind,
    spec::bounds,
};

use super::{
    message::{SessionId, ToWorker},
    state::Core,
};

impl Core {
    /// Removes rejected rows from the changes that [`Core::take`] returned. If `again`, their
    /// reworded versions were rejected too and are left out.
    pub(crate) fn refused(
        &mut self,
        changes: &mut Changes,
        say: &mut [(SessionId, ToWorker)],
        culprits: &[Culprit],
        again: bool,
        now_ms: i64,
    ) {
        let (mut outputs, mut events) = (Vec::new(), Vec::new());
        for Culprit { row, why } in culprits {
            let why = bounds::message(why);
            tracing::error!(?row, why, "the catalog refuses a row; the others are kept");
            match row {
                Row::Output(at) => outputs.push((*at, why)),
                Row::Event(at) => events.push((*at, why)),
                Row::Worker(id) => self.rename(changes, *id, again),
                Row::Exception(stage, task) => {
                    let said = format!("the worker's error message could not be recorded: {why}");
                    if let Some(exception) = changes.exceptions.get_mut(&(*stage, *task)) {
                        exception.last_error.clone_from(&said);
                    }
                    if again {
                        changes.exceptions.remove(&(*stage, *task));
                    }
                    if let Some(entry) = self.stages.get_mut(stage) {
                        entry.set_last_error(*task, said);
                    }
                }
            }
        }
        // Removal starts at the end so that earlier positions stay valid.
        for (at, why) in events.into_iter().rev() {
            if again {
                changes.events.remove(at);
                continue;
            }
            let event = &mut changes.events[at];
            event.message = format!("what happened could not be recorded as it was said: {why}");
            event.worker = bounds::cut(&event.worker, bounds::NAME_BYTES);
            event.seconds = bounds::seconds(event.seconds).unwrap_or(0.0);
        }
        for (at, why) in outputs.into_iter().rev() {
            let output = changes.outputs.remove(at);
            self.give_up(changes, say, (output.stage, output.task), &why, now_ms);
        }
    }

    /// Replaces a rejected worker name by the worker's id.
    fn rename(&mut self, changes: &mut Changes, id: WorkerId, again: bool) {
        if again {
            changes.workers.remove(&id);
        }
        self.workers.rename(id, &id.to_string());
        if let Some(worker) = changes.workers.get_mut(&id) {
            worker.name = id.to_string();
        }
    }

    /// Gives up a task with a result that cannot be recorded, instead of marking it as done.
    fn give_up(
        &mut self,
        changes: &mut Changes,
        say: &mut [(SessionId, ToWorker)],
        (stage, task): (StageRef, u64),
        why: &str,
        now_ms: i64,
    ) {
        let why = format!("the result cannot be recorded: {why}");
        if let Some(lease) = self.undo(changes, stage, task) {
            for (_, say) in say.iter_mut() {
                if let ToWorker::Acknowledge {
                    lease: of,
                    index,
                    accepted,
                    reason,
                } = say
                    && (*of, *index) == (lease, task)
                {
                    *accepted = false;
                    reason.clone_from(&why);
                }
            }
        }
        let Some(entry) = self.stages.get_mut(&stage) else {
            return;
        };
        let exception = entry.give_up(task, &why);
        changes.exceptions.insert((stage, task), exception);
        let worker = unsay(&mut changes.events, stage, task);
        changes.events.push(NewEvent {
            stage: Some(stage.stage),
            tasks: Some(Run {
                lo: task,
                hi: task + 1,
            }),
            worker,
            ..NewEvent::new(stage.job, now_ms, EventKind::Dead, why)
        });
        if entry.held.is_empty() {
            changes.perhaps_over.insert(stage, now_ms);
        }
    }

    /// Turns one task of a range about to be written as done into a given-up task. Returns the
    /// lease under which it was done.
    fn undo(&mut self, changes: &mut Changes, stage: StageRef, task: u64) -> Option<LeaseRef> {
        let of_stage = |range: &Range| range.stage == stage && (range.lo..range.hi).contains(&task);
        let done = |range: &Range| match &range.state {
            RangeState::Leased(lease) => {
                let mark = lease.marks.get((task - range.lo) as usize);
                matches!(mark, Some(Mark::Done | Mark::Reused))
            }
            RangeState::Done { .. } => true,
            _ => false,
        };
        let mut all = changes.ranges.values().chain(changes.free.values());
        let range = all.find(|range| of_stage(range) && done(range))?.clone();
        if let RangeState::Leased(_) = range.state {
            let entry = self.stages.get_mut(&stage)?;
            if let Some(left) = entry.held.leave(range.id, task) {
                changes.put(left);
            }
        } else {
            changes.remove(range.id);
            for (lo, hi) in [(range.lo, task), (task + 1, range.hi)] {
                if lo < hi {
                    let piece = Range {
                        lo,
                        hi,
                        ..range.clone()
                    };
                    self.give_new(changes, piece);
                }
            }
        }
        let dead = Range {
            lo: task,
            hi: task + 1,
            crashes: 0,
            state: RangeState::Dead,
            ..range.clone()
        };
        self.give_new(changes, dead);
        Some(range.lease())
    }

    /// Writes a range under a new id.
    fn give_new(&mut self, changes: &mut Changes, mut range: Range) {
        range.id = self.outcome.new_range_id();
        changes.minted.insert(range.id);
        changes.give(range);
    }
}

/// Removes the history line about a finished task. Returns the worker that the line names.
fn unsay(events: &mut Vec<NewEvent>, stage: StageRef, task: u64) -> String {
    let says = |event: &NewEvent| {
        (event.job, event.stage) == (stage.job, Some(stage.stage))
            && matches!(event.kind, EventKind::Committed | EventKind::Reused)
            && event.tasks.is_some_and(|t| (t.lo..t.hi).contains(&task))
    };
    let Some(at) = events.iter().rposition(says) else {
        return String::new();
    };
    let event = events.remove(at);
    let tasks = event.tasks.expect("it names the task");
    for (lo, hi) in [(task + 1, tasks.hi), (tasks.lo, task)] {
        if lo < hi {
            let tasks = Some(Run { lo, hi });
            events.insert(
                at,
                NewEvent {
                    tasks,
                    ..event.clone()
                },
            );
        }
    }
    event.worker
}
