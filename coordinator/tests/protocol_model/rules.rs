//! What the protocol checks, rule by rule with the place that enforces it, and how much may go wrong in a model.
//! Dropping a rule gives a mutant; `main.rs` says which law each mutant breaks.

/// The rules of the commit protocol. All of them together are the product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rules {
    /// A write transaction first locks its instance's row; an instance whose row has run out or is gone writes nothing and
    /// comes back as a new instance. Enforced by `storage/database/src/postgres/instance.rs` (`fence`), which every writing
    /// transaction calls first.
    pub instance_is_fenced: bool,
    /// A range is written only by the instance that owns it. Enforced by `storage/database/src/postgres/write.rs`
    /// (`replace_known`): one range of another owner fails the whole transaction.
    pub writes_check_owner: bool,
    /// An instance becomes the owner of a lease that a worker names in its hello only if the range still has that epoch,
    /// that worker and that incarnation. The product takes over all leases of that worker as the catalog has them
    /// (`instance.rs`, `adopt`) and ends at once those that the hello does not name (`coordinator/src/core/sessions.rs`).
    pub lease_adoption_is_conditional: bool,
    /// The ranges of an instance fall to another one only after its row has run out by the database's clock. Enforced by
    /// `instance.rs` (`take_lost`).
    pub takeover_waits_for_expiry: bool,
    /// A report is accepted only for the live lease: epoch, worker and incarnation match, the task is still to do.
    /// Enforced by `coordinator/src/core/leases.rs` (`held_to_do`), called by `core/commit.rs`.
    pub commit_checks_lease: bool,
    /// A worker reports a task only after its objects and then its manifest are stored. Enforced by
    /// `worker/agent/src/execute/kinds/render.rs` over `storage/dataset/src/scenes/publish.rs`.
    pub store_precedes_report: bool,
    /// A worker that finds a manifest takes the task as finished only if the objects exist; else it renders again.
    /// Enforced by `storage/dataset/src/scenes/publish.rs` (`published`).
    pub reuse_checks_objects: bool,
    /// The collector takes a range that nobody owns and that is not leased, before it looks for a manifest, and keeps
    /// others off it until its last delete is answered. Not so in the product: `dataset collect` leaves alone what is
    /// younger than a day, looks again after it deleted, and publishers look again after their manifest
    /// (`storage/dataset/src/repair/collect.rs`).
    pub collector_holds_range: bool,
    /// The collector's hold does not run out like an instance's lease: it ends when the collector gives the range back or
    /// its process is dead (its database session has ended). A delete in an object store cannot be fenced, so nobody
    /// may follow a collector that is only stopped.
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

/// How large the model is and how much may go wrong in it. What is not counted (slow and stopped processes, late,
/// repeated and lost messages, leases that run out as long as there are epochs) may happen at any time.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// Tasks of the one range.
    pub tasks: u8,
    /// Epochs. The last one is undisturbed: its lease does not run out and its worker is not killed.
    pub epochs: u8,
    /// Kills of workers, each of which comes back as a new incarnation.
    pub worker_kills: u8,
    /// Kills of coordinators, each of which comes back as a new instance.
    pub instance_kills: u8,
    /// Running coordinators that are stopped until their instance's row has run out.
    pub instance_stops: u8,
    /// Runs of the collector.
    pub collections: u8,
}
