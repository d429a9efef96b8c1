//! The rules of the protocol with the place that enforces each, and the faults possible in a model.
//! Dropping a rule gives a mutant; `main.rs` lists the law that each mutant breaks.

/// The rules of the commit protocol. The product has all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rules {
    /// A write transaction first locks its instance's row. An instance with an expired or deleted
    /// row writes nothing and restarts as a new instance. Enforced by
    /// `storage/database/src/postgres/instance.rs` (`fence`), which every writing transaction calls
    /// first.
    pub instance_is_fenced: bool,
    /// A range is written only by the instance that owns it. Enforced by
    /// `storage/database/src/postgres/write.rs` (`replace_known`): one range of another owner fails
    /// the whole transaction.
    pub writes_check_owner: bool,
    /// An instance becomes the owner of a lease named in a worker's hello only if the range still
    /// has that epoch, that worker and that incarnation. The product takes over all leases of the
    /// worker in the catalog (`instance.rs`, `adopt`) and ends at once those that the hello does
    /// not name (`coordinator/src/core/sessions.rs`).
    pub lease_adoption_is_conditional: bool,
    /// An instance's ranges go to another instance only after its row has expired by the database's
    /// clock. Enforced by `instance.rs` (`take_lost`).
    pub takeover_waits_for_expiry: bool,
    /// A report is accepted only for the live lease: epoch, worker and incarnation match, and the
    /// task is unfinished. Enforced by `coordinator/src/core/leases.rs` (`held_to_do`), called by
    /// `core/commit.rs`.
    pub commit_checks_lease: bool,
    /// A worker reports a task only after it has stored the objects and then the manifest. Enforced
    /// by `worker/tasks/src/kinds/render.rs` over `storage/dataset/src/scenes/publish.rs`.
    pub store_precedes_report: bool,
    /// A worker that finds a manifest treats the task as finished only if the objects exist.
    /// Otherwise it renders again. Enforced by `storage/dataset/src/scenes/publish.rs`
    /// (`published`).
    pub reuse_checks_objects: bool,
    /// The collector takes an unowned, unleased range before it looks for a manifest, and keeps it
    /// until its last delete is answered. The product differs: `dataset collect` spares objects
    /// younger than a day, looks again after deleting, and publishers look again after their
    /// manifest (`storage/dataset/src/repair/collect.rs`).
    pub collector_holds_range: bool,
    /// The collector's hold does not expire like an instance's lease. It ends when the collector
    /// gives the range back or its process is dead (its database session has ended). A delete in an
    /// object store cannot be fenced, so that a stopped collector must not be replaced.
    pub hold_outlasts_lease: bool,
}

impl Rules {
    /// The protocol of the product.
    pub const ALL: Self = Self {
        instance_is_fenced: true,
        writes_check_owner: true,
        lease_adoption_is_conditional: true,
        takeover_waits_for_expiry: true,
        commit_checks_lease: true,
        store_precedes_report: true,
        reuse_checks_objects: true,
        collector_holds_range: true,
        hold_outlasts_lease: true,
    };
}

/// The size of a model and the number of its faults. Faults without a count (slow and stopped
/// processes; late, repeated and lost messages; leases that expire while epochs remain) may happen
/// at any time.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// Tasks of the single range.
    pub tasks: u8,
    /// Epochs. In the last one the lease does not expire and the worker is not killed.
    pub epochs: u8,
    /// Kills of workers. Each killed worker restarts as a new incarnation.
    pub worker_kills: u8,
    /// Kills of coordinators. Each killed coordinator restarts as a new instance.
    pub instance_kills: u8,
    /// Running coordinators that are stopped until their instance's row has expired.
    pub instance_stops: u8,
    /// Runs of the collector.
    pub collections: u8,
}
