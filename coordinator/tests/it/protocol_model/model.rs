//! The protocol as a transition system: the possible actions of each process, and the laws. An
//! action with a false guard is no step.

use stateright::{Model, Property};

use crate::protocol_model::{
    rules::{Bounds, Rules},
    state::{Collector, Commit, InstanceId, InstanceRow, Message, State, Tasks},
};

pub const ONCE: &str = "each task is committed at most once";
pub const THERE: &str = "what the catalog names is in the store";
pub const FENCED: &str = "a fenced instance writes nothing";
pub const DEAD_EPOCH: &str = "no report of a dead epoch is accepted";
pub const TWO_INSTANCES: &str = "no two instances accept the same task of one epoch";
pub const LEASED_AGAIN: &str = "a committed task is never leased again";
pub const ROBBED: &str = "a living instance keeps its range";
pub const ENDS_LATE: &str = "the job can end in its last epoch";
pub const COLLECTED: &str = "objects can be collected";
pub const ZOMBIE: &str = "a stopped worker can leave a manifest whose objects were collected";

/// A condition on a state.
type Law = fn(&Protocol, &State) -> bool;

/// The laws of every state.
pub const LAWS: [(&str, Law); 7] = [
    (ONCE, |_, s| {
        let commits = &s.history.commits;
        (1..commits.len()).all(|n| commits[..n].iter().all(|c| c.task != commits[n].task))
    }),
    (THERE, |_, s| {
        let stored = s.store.objects.and(s.store.manifests);
        s.database.outputs.without(stored).is_empty()
    }),
    (FENCED, |_, s| !s.history.fenced_write),
    (DEAD_EPOCH, |_, s| {
        s.history.commits.iter().all(|c| c.lease_was_live)
    }),
    (TWO_INSTANCES, |_, s| {
        let commits = &s.history.commits;
        let one = |a: &Commit, b: &Commit| (a.epoch, a.task) != (b.epoch, b.task) || a.by == b.by;
        commits.iter().all(|a| commits.iter().all(|b| one(a, b)))
    }),
    (LEASED_AGAIN, |_, s| !s.history.leased_again),
    (ROBBED, |_, s| !s.history.robbed),
];

/// One step of one process, or one fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    Instance(u8, InstanceStep),
    Worker(u8, WorkerStep),
    Collector(CollectorStep),
    /// An instance's row expires: that of a dead instance at any time, that of a running one only
    /// if the instance is stopped for long enough.
    Expire(InstanceId),
}

/// A step of an instance, each with at most one transaction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InstanceStep {
    /// It takes a pending range without an owner.
    Claim,
    /// It gives a pending range back.
    Release,
    /// It leases the range to a worker.
    Grant(u8),
    /// It ends a lease, because heartbeats are missing or the worker returned it.
    Close,
    /// It accepts a report (`Message::Done`).
    Commit(Message),
    /// A worker connects and names its lease. The instance becomes the owner of its range.
    Adopt(u8),
    /// It deletes another instance's row and becomes the owner of that instance's range.
    TakeOver(InstanceId),
    /// Like `TakeOver`, for a collector with an expired lease.
    TakeOverCollector,
    /// A write was refused. It forgets everything, and restarts as a new instance if its row is no
    /// longer live.
    Reload,
    /// It is killed and restarted.
    Restart,
}

/// A step of a worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WorkerStep {
    /// A lease arrives (`Message::Grant`).
    Receive(Message),
    /// It looks for a manifest of the current task.
    Look,
    /// It checks that the objects of the manifest exist.
    Check,
    /// It has rendered the task and stores the object, create-only.
    PutObject,
    /// It stores the manifest, create-only.
    PutManifest,
    /// It reports the current task although nothing is stored yet. No worker of the product does
    /// this.
    ReportEarly,
    /// It reports a finished task, for the first time or again.
    Report(u8),
    /// It has finished with its lease: all tasks are acknowledged, refused, revoked or lost.
    Forget,
    /// It is killed and restarted.
    Restart,
}

/// A step of the collector.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CollectorStep {
    /// It takes a pending range without an owner.
    Claim,
    /// It looks for objects without a manifest.
    Look,
    /// It deletes the object of one task, and gives the range back after the last one.
    Delete,
    /// It is killed. Its database session ends, and with it its hold on the range.
    Restart,
}

/// The model: the rules in force and its bounds.
#[derive(Debug, Clone, Copy)]
pub struct Protocol {
    pub rules: Rules,
    pub bounds: Bounds,
}

impl Protocol {
    pub fn tasks(&self) -> Tasks {
        Tasks::first(self.bounds.tasks)
    }

    /// Returns whether the last epoch is granted. Faults that would need a further one are out of
    /// bounds.
    pub fn last_epoch(&self, state: &State) -> bool {
        state.database.range.epoch == self.bounds.epochs
    }
}

impl Model for Protocol {
    type State = State;
    type Action = Action;

    fn init_states(&self) -> Vec<State> {
        vec![State::initial()]
    }

    fn actions(&self, state: &State, actions: &mut Vec<Action>) {
        // States after a broken law are not explored.
        if !LAWS.iter().all(|(_, law)| law(self, state)) {
            return;
        }
        for process in [0, 1] {
            let mut instance = |step| actions.push(Action::Instance(process, step));
            instance(InstanceStep::Claim);
            instance(InstanceStep::Release);
            instance(InstanceStep::Grant(0));
            instance(InstanceStep::Grant(1));
            instance(InstanceStep::Adopt(0));
            instance(InstanceStep::Adopt(1));
            instance(InstanceStep::Close);
            instance(InstanceStep::TakeOverCollector);
            instance(InstanceStep::Reload);
            instance(InstanceStep::Restart);
            for message in &state.network {
                instance(InstanceStep::Commit(*message));
            }
            for id in state.database.instances.keys() {
                instance(InstanceStep::TakeOver(*id));
            }
        }
        for worker in [0, 1] {
            let mut worker = |step| actions.push(Action::Worker(worker, step));
            worker(WorkerStep::Look);
            worker(WorkerStep::Check);
            worker(WorkerStep::PutObject);
            worker(WorkerStep::PutManifest);
            worker(WorkerStep::ReportEarly);
            worker(WorkerStep::Forget);
            worker(WorkerStep::Restart);
            for task in self.tasks().iter() {
                worker(WorkerStep::Report(task));
            }
            for message in &state.network {
                worker(WorkerStep::Receive(*message));
            }
        }
        actions.push(Action::Collector(CollectorStep::Claim));
        actions.push(Action::Collector(CollectorStep::Look));
        actions.push(Action::Collector(CollectorStep::Delete));
        actions.push(Action::Collector(CollectorStep::Restart));
        actions.extend(state.database.instances.keys().copied().map(Action::Expire));
    }

    fn next_state(&self, last: &State, action: Action) -> Option<State> {
        let mut next = last.clone();
        match action {
            Action::Instance(process, step) => self.instance(&mut next, process, step),
            Action::Worker(worker, step) => self.worker(&mut next, worker, step),
            Action::Collector(step) => self.collector(&mut next, step),
            Action::Expire(id) => self.expire(&mut next, id),
        }?;
        (next != *last).then_some(next)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        let laws = LAWS.map(|(name, law)| Property::always(name, law));
        let mut properties = Vec::from(laws);
        properties.push(Property::sometimes(ENDS_LATE, |m: &Self, s: &State| {
            m.ended(s) && m.last_epoch(s)
        }));
        properties.push(Property::sometimes(COLLECTED, |_, s: &State| {
            s.faults.collections > 0 && s.collector == Collector::Idle && s.store.objects.is_empty()
        }));
        properties.push(Property::sometimes(ZOMBIE, |_, s: &State| {
            !s.store.manifests.without(s.store.objects).is_empty()
        }));
        properties
    }
}

impl Protocol {
    /// Returns whether every task is committed.
    pub fn ended(&self, state: &State) -> bool {
        state.database.outputs == self.tasks() && state.database.range.done == self.tasks()
    }

    fn expire(&self, state: &mut State, id: InstanceId) -> Option<()> {
        if state.runs(id) {
            (id.process == 0 && state.faults.instance_stops < self.bounds.instance_stops)
                .then_some(())?;
            state.faults.instance_stops += 1;
        }
        let row = state.database.instances.get_mut(&id)?;
        (*row == InstanceRow::Live).then_some(())?;
        *row = InstanceRow::Expired;
        Some(())
    }
}
