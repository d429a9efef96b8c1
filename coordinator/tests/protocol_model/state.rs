//! The state: database, object store, network, and what each process knows.

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

    /// The task that is worked on first.
    pub fn lowest(self) -> Option<u8> {
        self.iter().next()
    }
}

/// A worker's process: a killed worker comes back as the next incarnation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WorkerId {
    pub worker: u8,
    pub incarnation: u8,
}

/// A life of a coordinator: a killed or fenced coordinator comes back as a new instance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct InstanceId {
    pub process: u8,
    pub life: u8,
}

/// Who may write the range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Owner {
    Nobody,
    Instance(InstanceId),
    Collector,
}

/// An instance's row; one that was taken over is gone from the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum InstanceRow {
    Live,
    /// By the database's clock.
    Expired,
}

/// The range, as a row of the database or as an instance remembers it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Range {
    pub epoch: u8,
    /// Whom the epoch was granted to, while its lease is live.
    pub lease: Option<WorkerId>,
    pub done: Tasks,
}

/// The database that all instances share.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Database {
    pub instances: BTreeMap<InstanceId, InstanceRow>,
    pub owner: Owner,
    pub range: Range,
    /// Tasks whose output the catalog names.
    pub outputs: Tasks,
}

/// The object store. A task has one object besides its manifest: a task half written is one without the manifest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Store {
    pub objects: Tasks,
    pub manifests: Tasks,
}

/// A message that may arrive at any time, any number of times, at any process it concerns; or never.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Message {
    /// A lease, said after the grant is durable.
    Grant {
        epoch: u8,
        to: WorkerId,
        tasks: Tasks,
    },
    /// A finished task.
    Done { epoch: u8, from: WorkerId, task: u8 },
}

/// How far a worker is with the task in hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Step {
    /// Nothing known yet.
    Begun,
    /// It has seen the manifest and is about to check the objects.
    Found,
    /// It saw no usable output and renders.
    Rendering,
    /// It has stored the object, or found it stored with equal bytes.
    Uploaded,
}

/// A lease as its worker sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct HeldLease {
    pub epoch: u8,
    pub todo: Tasks,
    pub step: Step,
    /// Finished and not acknowledged.
    pub outbox: Tasks,
}

/// A worker. A stopped one is one that takes no step for long; what it knows is then old.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Worker {
    pub incarnation: u8,
    pub held: Option<HeldLease>,
}

/// A coordinator. A stopped one is one that takes no step for long, while others may find its row expired.
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
    /// It has the range (or believes that nobody works on it) and is about to look.
    Claimed,
    /// It saw no manifest for these and is about to delete their objects.
    Deleting(Tasks),
}

/// An accepted report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Commit {
    pub task: u8,
    pub epoch: u8,
    pub by: InstanceId,
    /// Its lease was live by the database's row.
    pub lease_was_live: bool,
}

/// What the laws need to know of the past; no process reads it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub struct History {
    pub commits: Vec<Commit>,
    /// An instance without a live row has written.
    pub fenced_write: bool,
    /// A lease named a task that was committed already.
    pub leased_again: bool,
    /// An instance with a live row has lost the range to a takeover.
    pub robbed: bool,
}

/// Faults that have happened, of those that are counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Faults {
    pub worker_kills: u8,
    pub instance_kills: u8,
    pub instance_stops: u8,
    pub collections: u8,
}

/// Everything.
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
    /// Two instances and two workers have just started; the range is pending and nobody's.
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

    /// Whether an instance of this id runs now.
    pub fn runs(&self, id: InstanceId) -> bool {
        self.instance(id.process) == id
    }
}
