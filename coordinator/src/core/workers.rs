//! The connected workers.

use std::collections::BTreeSet;

use picofarm_proto::{
    ids::{Incarnation, RangeId},
    model::Abilities,
};

use super::message::SessionId;

pub(super) struct WorkerEntry {
    pub(super) session: SessionId,
    pub(super) incarnation: Incarnation,
    pub(super) name: String,
    pub(super) version: String,
    /// Time at which the session began, Unix milliseconds.
    pub(super) since_ms: i64,
    /// Time of its last message, Unix milliseconds.
    pub(super) heard_ms: i64,
    /// Time at which it must end, if known, Unix milliseconds.
    pub(super) ends_ms: Option<i64>,
    pub(super) abilities: Abilities,
    pub(super) credits: u32,
    pub(super) leases: BTreeSet<RangeId>,
    /// Whether it runs a range under suspicion, and therefore gets nothing else.
    pub(super) quarantined: bool,
    /// Whether it was asked to end, and therefore gets nothing more.
    pub(super) drains: bool,
}

impl WorkerEntry {
    /// Returns whether the worker may be given leases now.
    pub(super) fn hungry(&self) -> bool {
        self.credits > 0 && !self.quarantined && !self.drains
    }
}
