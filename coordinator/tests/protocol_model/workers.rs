//! What a worker does: lease in, objects and manifest to the store, report out. It never reads the database.

use crate::{
    model::{Protocol, WorkerStep},
    state::{Desk, Message, State, Step},
};

impl Protocol {
    /// A step of a worker; `None` if it cannot happen.
    pub fn worker(&self, s: &mut State, worker: u8, step: WorkerStep) -> Option<()> {
        let me = s.worker(worker);
        let at = usize::from(worker);
        let holds_last = self.last_epoch(s) && s.database.range.lease == Some(me);
        if let WorkerStep::Receive(message) = step {
            let Message::Grant { epoch, to, tasks } = message else {
                return None;
            };
            (to == me && s.workers[at].desk.is_none()).then_some(())?;
            s.workers[at].desk = Some(Desk {
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
            s.workers[at].desk = None;
            return Some(());
        }
        let desk = s.workers[at].desk.as_mut()?;
        let epoch = desk.epoch;
        let hand = desk.todo.lowest();
        let finish = |desk: &mut Desk, task| {
            desk.todo = desk.todo.without(crate::state::Tasks::one(task));
            desk.outbox = desk.outbox.with(task);
            desk.step = Step::Begun;
        };
        match step {
            WorkerStep::Look if desk.step == Step::Begun => {
                let found = s.store.manifests.has(hand?);
                desk.step = if found { Step::Found } else { Step::Rendering };
            }
            WorkerStep::Check if desk.step == Step::Found => {
                if !self.rules.reuse_checks_objects || s.store.objects.has(hand?) {
                    finish(desk, hand?);
                } else {
                    desk.step = Step::Rendering;
                }
            }
            WorkerStep::PutObject if desk.step == Step::Rendering => {
                s.store.objects = s.store.objects.with(hand?);
                desk.step = Step::Uploaded;
            }
            WorkerStep::PutManifest if desk.step == Step::Uploaded => {
                s.store.manifests = s.store.manifests.with(hand?);
                finish(desk, hand?);
            }
            WorkerStep::ReportEarly
                if desk.step == Step::Rendering && !self.rules.store_precedes_report =>
            {
                let task = hand?;
                s.network.insert(Message::Done {
                    epoch,
                    from: me,
                    task,
                });
            }
            WorkerStep::Report(task) => {
                desk.outbox.has(task).then_some(())?;
                s.network.insert(Message::Done {
                    epoch,
                    from: me,
                    task,
                });
            }
            WorkerStep::Forget => {
                (!holds_last || epoch < self.bounds.epochs).then_some(())?;
                s.workers[at].desk = None;
            }
            _ => return None,
        }
        Some(())
    }
}
