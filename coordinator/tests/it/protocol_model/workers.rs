//! The steps of a worker: it receives a lease, stores objects and a manifest, and sends a report.
//! It never reads the database.

use crate::protocol_model::{
    model::{Protocol, WorkerStep},
    state::{HeldLease, Message, State, Step},
};

impl Protocol {
    /// Applies a step of a worker; `None` if the step is not possible.
    pub fn worker(&self, s: &mut State, worker: u8, step: WorkerStep) -> Option<()> {
        let me = s.worker(worker);
        let at = usize::from(worker);
        let holds_last = self.last_epoch(s) && s.database.range.lease == Some(me);
        if let WorkerStep::Receive(message) = step {
            let Message::Grant { epoch, to, tasks } = message else {
                return None;
            };
            (to == me && s.workers[at].held.is_none()).then_some(())?;
            s.workers[at].held = Some(HeldLease {
                epoch,
                todo: tasks,
                step: Step::Begun,
                outbox: Default::default(),
            });
            return Some(());
        }
        if step == WorkerStep::Restart {
            // A worker that was never given a lease has nothing to lose.
            let idle = s.database.range.epoch == 0;
            let within = s.faults.worker_kills < self.bounds.worker_kills;
            (!holds_last && !idle && within).then_some(())?;
            s.faults.worker_kills += 1;
            s.workers[at].incarnation += 1;
            s.workers[at].held = None;
            return Some(());
        }
        let held = s.workers[at].held.as_mut()?;
        let epoch = held.epoch;
        let hand = held.todo.lowest();
        let finish = |held: &mut HeldLease, task| {
            held.todo = held
                .todo
                .without(crate::protocol_model::state::Tasks::one(task));
            held.outbox = held.outbox.with(task);
            held.step = Step::Begun;
        };
        match step {
            WorkerStep::Look if held.step == Step::Begun => {
                let found = s.store.manifests.has(hand?);
                held.step = if found { Step::Found } else { Step::Rendering };
            }
            WorkerStep::Check if held.step == Step::Found => {
                if !self.rules.reuse_checks_objects || s.store.objects.has(hand?) {
                    finish(held, hand?);
                } else {
                    held.step = Step::Rendering;
                }
            }
            WorkerStep::PutObject if held.step == Step::Rendering => {
                s.store.objects = s.store.objects.with(hand?);
                held.step = Step::Uploaded;
            }
            WorkerStep::PutManifest if held.step == Step::Uploaded => {
                s.store.manifests = s.store.manifests.with(hand?);
                finish(held, hand?);
            }
            WorkerStep::ReportEarly
                if held.step == Step::Rendering && !self.rules.store_precedes_report =>
            {
                let task = hand?;
                s.network.insert(Message::Done {
                    epoch,
                    from: me,
                    task,
                });
            }
            WorkerStep::Report(task) => {
                held.outbox.has(task).then_some(())?;
                s.network.insert(Message::Done {
                    epoch,
                    from: me,
                    task,
                });
            }
            WorkerStep::Forget => {
                (!holds_last || epoch < self.bounds.epochs).then_some(())?;
                s.workers[at].held = None;
            }
            _ => return None,
        }
        Some(())
    }
}
