//! The steps of an instance. It decides from memory, and writes in one transaction that checks the
//! database's rows.

use crate::protocol_model::{
    model::{InstanceStep, Protocol},
    state::{Collector, Commit, InstanceId, InstanceRow, Message, Owner, Range, State},
};

impl Protocol {
    /// Applies a step of an instance; `None` if the step is not possible.
    pub fn instance(&self, s: &mut State, process: u8, step: InstanceStep) -> Option<()> {
        let me = s.instance(process);
        let at = usize::from(process);
        match step {
            InstanceStep::Claim => {
                let range = s.database.range;
                let free = s.database.owner == Owner::Nobody
                    && range.lease.is_none()
                    && range.done != self.tasks();
                free.then_some(())?;
                self.begin(s, me)?;
                self.own(s, me);
            }
            InstanceStep::Release => {
                let range = s.instances[at].memory?;
                range.lease.is_none().then_some(())?;
                self.begin_on_range(s, me)?;
                s.database.owner = Owner::Nobody;
                s.instances[at].memory = None;
            }
            InstanceStep::Grant(worker) => {
                let mut range = s.instances[at].memory?;
                let tasks = self.tasks().without(range.done);
                let pending = range.lease.is_none() && !tasks.is_empty();
                // The workers are symmetric, so the first lease goes to worker 0.
                let first = range.epoch > 0 || worker == 0;
                (pending && first && range.epoch < self.bounds.epochs).then_some(())?;
                self.begin_on_range(s, me)?;
                let to = s.worker(worker);
                range.epoch += 1;
                range.lease = Some(to);
                s.history.leased_again |= !tasks.and(s.database.outputs).is_empty();
                self.write(s, at, range);
                s.network.insert(Message::Grant {
                    epoch: range.epoch,
                    to,
                    tasks,
                });
            }
            InstanceStep::Close => {
                let mut range = s.instances[at].memory?;
                (range.lease.is_some() && range.epoch < self.bounds.epochs).then_some(())?;
                self.begin_on_range(s, me)?;
                range.lease = None;
                self.write(s, at, range);
            }
            InstanceStep::Commit(Message::Done { epoch, from, task }) => {
                let mut range = s.instances[at].memory?;
                let live = range.epoch == epoch && range.lease == Some(from);
                (live || !self.rules.commit_checks_lease).then_some(())?;
                (!range.done.has(task)).then_some(())?;
                self.begin_on_range(s, me)?;
                let row = s.database.range;
                s.history.commits.push(Commit {
                    task,
                    epoch,
                    by: me,
                    lease_was_live: row.epoch == epoch && row.lease == Some(from),
                });
                s.database.outputs = s.database.outputs.with(task);
                range.done = range.done.with(task);
                if range.done == self.tasks() {
                    range.lease = None;
                }
                self.write(s, at, range);
            }
            InstanceStep::Adopt(worker) => {
                let epoch = s.workers[usize::from(worker)].held?.epoch;
                let from = s.worker(worker);
                let row = s.database.range;
                let held = row.epoch == epoch && row.lease == Some(from);
                (held || !self.rules.lease_adoption_is_conditional).then_some(())?;
                self.begin(s, me)?;
                s.database.owner = Owner::Instance(me);
                s.instances[at].memory = Some(Range {
                    epoch,
                    lease: Some(from),
                    done: row.done,
                });
            }
            InstanceStep::Commit(_) => return None,
            InstanceStep::TakeOver(other) => {
                let expired = s.database.instances.get(&other)? == &InstanceRow::Expired;
                (other != me && (expired || !self.rules.takeover_waits_for_expiry)).then_some(())?;
                self.begin(s, me)?;
                s.database.instances.remove(&other);
                // A row that owns nothing may stay forever.
                (s.database.owner == Owner::Instance(other)).then_some(())?;
                s.history.robbed |= !expired && s.runs(other);
                self.own(s, me);
            }
            InstanceStep::TakeOverCollector => {
                let held = s.database.owner == Owner::Collector;
                (held && !self.rules.hold_outlasts_lease).then_some(())?;
                self.begin(s, me)?;
                self.own(s, me);
            }
            InstanceStep::Reload => {
                let live = s.database.instances.get(&me) == Some(&InstanceRow::Live);
                let refused = !live && self.rules.instance_is_fenced
                    || s.database.owner != Owner::Instance(me)
                        && s.instances[at].memory.is_some()
                        && self.rules.writes_check_owner;
                refused.then_some(())?;
                s.instances[at].memory = None;
                if !live {
                    self.open(s, process);
                }
            }
            InstanceStep::Restart => {
                (process == 0 && s.faults.instance_kills < self.bounds.instance_kills)
                    .then_some(())?;
                s.faults.instance_kills += 1;
                s.instances[at].memory = None;
                self.open(s, process);
            }
        }
        Some(())
    }

    /// Opens a new instance of a process. The row of the former instance stays until it expires.
    fn open(&self, s: &mut State, process: u8) {
        s.instances[usize::from(process)].life += 1;
        let me = s.instance(process);
        s.database.instances.insert(me, InstanceRow::Live);
    }

    /// Begins a write transaction with the fence.
    fn begin(&self, s: &mut State, me: InstanceId) -> Option<()> {
        let live = s.database.instances.get(&me) == Some(&InstanceRow::Live);
        s.history.fenced_write |= !live;
        (live || !self.rules.instance_is_fenced).then_some(())
    }

    /// Begins a transaction that writes the range from the instance's memory.
    fn begin_on_range(&self, s: &mut State, me: InstanceId) -> Option<()> {
        let mine = s.database.owner == Owner::Instance(me);
        (mine || !self.rules.writes_check_owner).then_some(())?;
        self.begin(s, me)
    }

    /// Makes the instance the owner, which reads the range.
    fn own(&self, s: &mut State, me: InstanceId) {
        s.database.owner = Owner::Instance(me);
        s.instances[usize::from(me.process)].memory = Some(s.database.range);
    }

    /// Sets the range's row and the instance's memory to `range`.
    fn write(&self, s: &mut State, at: usize, range: Range) {
        s.database.range = range;
        s.instances[at].memory = Some(range);
    }

    /// Applies a step of the collector; `None` if the step is not possible.
    pub fn collector(
        &self,
        s: &mut State,
        step: crate::protocol_model::model::CollectorStep,
    ) -> Option<()> {
        use crate::protocol_model::model::CollectorStep as Step;
        let over = match (step, s.collector) {
            (Step::Claim, Collector::Idle) => {
                let unleased = s.database.range.lease.is_none();
                let within = s.faults.collections < self.bounds.collections;
                (unleased && within && s.database.range.done != self.tasks()).then_some(())?;
                if self.rules.collector_holds_range {
                    (s.database.owner == Owner::Nobody).then_some(())?;
                    s.database.owner = Owner::Collector;
                }
                s.faults.collections += 1;
                s.collector = Collector::Claimed;
                false
            }
            (Step::Look, Collector::Claimed) => {
                let orphans = s.store.objects.without(s.store.manifests);
                s.collector = Collector::Deleting(orphans);
                orphans.is_empty()
            }
            (Step::Delete, Collector::Deleting(orphans)) => {
                let one = crate::protocol_model::state::Tasks::one(orphans.lowest()?);
                s.store.objects = s.store.objects.without(one);
                s.collector = Collector::Deleting(orphans.without(one));
                orphans == one
            }
            (Step::Restart, Collector::Claimed | Collector::Deleting(_)) => true,
            _ => return None,
        };
        if over {
            s.collector = Collector::Idle;
            if s.database.owner == Owner::Collector {
                s.database.owner = Owner::Nobody;
            }
        }
        Some(())
    }
}
