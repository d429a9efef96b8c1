//! The state: database, object store, network, and the knowledge of each process.

use std::collections::{BTreeMap, BTreeSet};

/// A set of tasks, one bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Tasks(pub u8);

impl Tasks {
    pub fn first(n: u8) -> Self {
        Self((1 << n) - 1)
    }

    pub fn one(task: u8) -> Self {
        Self(1 << task)
    }

    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    pub fn has(self, task: u8) -> bool {
        self.0 & (1 << task) != 0
    }

    pub fn with(self, task: u8) -> Self {
        Self(self.0 | (1 << task))
    }

    pub fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }

    pub fn and(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }

    pub fn iter(self) -> impl Iterator<Item = u8> {
        (0..8).filter(move |task| self.has(*task))
    }

    /// Returns the first task to work on.
    pub fn lowest(self) -> Option<u8> {
        self.iter().next()
    }
}

/// A worker's process. A killed worker restarts as the next incarnation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WorkerId {
    pub worker: u8,
    pub incarnation: u8,
}

/// A life of a coordinator. A killed or fenced coordinator restarts as a new instance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct InstanceId {
    pub process: u8,
    pub life: u8,
}

/// The process that may write the range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Owner {
    Nobody,
    Instance(InstanceId),
    Collector,
}

/// The row of an instance. The row is deleted when another instance takes over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum InstanceRow {
    Live,
    /// Expired by the database's clock.
    Expired,
}

/// The range, as a row of the database or in the memory of an instance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Range {
    pub epoch: u8,
    /// The worker to which the epoch was granted, while its lease is live.
    pub lease: Option<WorkerId>,
    pub done: Tasks,
}

/// The database that all instances share.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Database {
    pub instances: BTreeMap<InstanceId, InstanceRow>,
    pub owner: Owner,
    pub range: Range,
    /// Tasks with an output in the catalog.
    pub outputs: Tasks,
}

/// The object store. A task has one object and a manifest. A half-written task has no manifest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Store {
    pub objects: Tasks,
    pub manifests: Tasks,
}

/// A message that may arrive at any time, any number of times, at any process concerned, or never.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Message {
    /// A lease, sent after the grant is durable.
    Grant {
        epoch: u8,
        to: WorkerId,
        tasks: Tasks,
    },
    /// A finished task.
    Done { epoch: u8, from: WorkerId, task: u8 },
}

/// Progress of a worker's current task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Step {
    /// Nothing is known yet.
    Begun,
    /// The worker has seen the manifest and is about to check the objects.
    Found,
    /// The worker saw no usable output and renders.
    Rendering,
    /// The worker has stored the object, or found it stored with equal bytes.
    Uploaded,
}

/// A lease as seen by its worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct HeldLease {
    pub epoch: u8,
    pub todo: Tasks,
    pub step: Step,
    /// Finished and unacknowledged tasks.
    pub outbox: Tasks,
}

/// A worker. A stopped worker takes no step for long, so that its knowledge is outdated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Worker {
    pub incarnation: u8,
    pub held: Option<HeldLease>,
}

/// A coordinator. A stopped one takes no step for long, while others may find its row expired.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Instance {
    pub life: u8,
    /// The range, if the instance believes that it owns it.
    pub memory: Option<Range>,
}

/// The collector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Collector {
    Idle,
    /// It owns the range (or believes that nobody works on it) and is about to look for objects.
    Claimed,
    /// It saw no manifest for these tasks and is about to delete their objects.
    Deleting(Tasks),
}

/// An accepted report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Commit {
    pub task: u8,
    pub epoch: u8,
    pub by: InstanceId,
    /// Whether its lease was live according to the database's row.
    pub lease_was_live: bool,
}

/// The past as far as the laws need it. No process reads it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub struct History {
    pub commits: Vec<Commit>,
    /// Whether an instance without a live row has written.
    pub fenced_write: bool,
    /// Whether a lease named a task that was already committed.
    pub leased_again: bool,
    /// Whether an instance with a live row has lost the range to a takeover.
    pub robbed: bool,
}

/// Counted faults that have happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Faults {
    pub worker_kills: u8,
    pub instance_kills: u8,
    pub instance_stops: u8,
    pub collections: u8,
}

/// The complete state.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct State {
    pub database: Database,
    pub store: Store,
    pub network: BTreeSet<Message>,
    pub instances: [Instance; 2],
    pub workers: [Worker; 2],
    pub collector: Collector,
    pub faults: Faults,
    pub history: History,
}

impl State {
    /// Returns the initial state: two instances and two workers have just started, and the range is
    /// pending without an owner.
    pub fn initial() -> Self {
        let instance = |process| (InstanceId { process, life: 0 }, InstanceRow::Live);
        Self {
            database: Database {
                instances: BTreeMap::from([instance(0), instance(1)]),
                owner: Owner::Nobody,
                range: Range {
                    epoch: 0,
                    lease: None,
                    done: Tasks::default(),
                },
                outputs: Tasks::default(),
            },
            store: Store::default(),
            network: BTreeSet::new(),
            instances: [Instance {
                life: 0,
                memory: None,
            }; 2],
            workers: [Worker {
                incarnation: 0,
                held: None,
            }; 2],
            collector: Collector::Idle,
            faults: Faults::default(),
            history: History::default(),
        }
    }

    pub fn instance(&self, process: u8) -> InstanceId {
        InstanceId {
            process,
            life: self.instances[usize::from(process)].life,
        }
    }

    pub fn worker(&self, worker: u8) -> WorkerId {
        WorkerId {
            worker,
            incarnation: self.workers[usize::from(worker)].incarnation,
        }
    }

    /// Returns whether an instance with this id runs now.
    pub fn runs(&self, id: InstanceId) -> bool {
        self.instance(id.process) == id
    }
}
