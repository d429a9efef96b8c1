//! The connected workers, and their sessions.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    ops::Index,
};

use picofarm_proto::{
    ids::{Incarnation, RangeId, WorkerId},
    messages::Abilities,
};

use super::message::SessionId;

/// A connected worker.
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
    pub(super) fn wants_leases(&self) -> bool {
        self.credits > 0 && !self.quarantined && !self.drains
    }
}

/// The connected workers. Each has one session.
#[derive(Default)]
pub(super) struct Workers {
    connected: BTreeMap<WorkerId, WorkerEntry>,
    sessions: HashMap<SessionId, WorkerId>,
    /// Names of all workers that have ever connected.
    names: HashMap<WorkerId, String>,
}

impl Workers {
    /// Knows the names of workers that connected earlier.
    pub(super) fn with_names(names: impl Iterator<Item = (WorkerId, String)>) -> Self {
        Self {
            names: names.collect(),
            ..Self::default()
        }
    }

    /// Adds a worker that has connected.
    pub(super) fn connect(&mut self, id: WorkerId, worker: WorkerEntry) {
        self.sessions.insert(worker.session, id);
        self.connected.insert(id, worker);
    }

    /// Removes the earlier session of a worker that connects again, and takes its new name. Returns
    /// the earlier session.
    pub(super) fn replace(&mut self, id: WorkerId, name: &str) -> Option<SessionId> {
        self.names.insert(id, name.to_owned());
        let old = self.connected.remove(&id)?;
        self.sessions.remove(&old.session);
        Some(old.session)
    }

    /// Removes the worker of a session that has ended.
    pub(super) fn disconnect(&mut self, session: SessionId) -> Option<(WorkerId, WorkerEntry)> {
        let id = self.sessions.remove(&session)?;
        Some((id, self.connected.remove(&id)?))
    }

    /// Returns the worker of a session.
    pub(super) fn id_of(&self, session: SessionId) -> Option<WorkerId> {
        self.sessions.get(&session).copied()
    }

    /// Returns the entry of a session's worker.
    pub(super) fn of_session_mut(&mut self, session: SessionId) -> Option<&mut WorkerEntry> {
        self.connected.get_mut(self.sessions.get(&session)?)
    }

    /// Returns the name of a worker, connected or not; its id if it has no known name.
    pub(super) fn name(&self, worker: WorkerId) -> String {
        let name = self.names.get(&worker).cloned();
        name.unwrap_or_else(|| worker.to_string())
    }

    /// Returns the name of a session's worker; empty if the session has ended.
    pub(super) fn session_name(&self, session: SessionId) -> String {
        let worker = self.id_of(session);
        worker.map(|worker| self.name(worker)).unwrap_or_default()
    }

    /// Changes the name of a worker.
    pub(super) fn rename(&mut self, worker: WorkerId, name: &str) {
        self.names.insert(worker, name.to_owned());
        if let Some(entry) = self.connected.get_mut(&worker) {
            name.clone_into(&mut entry.name);
        }
    }

    /// Removes a lease from its worker.
    pub(super) fn lease_over(&mut self, lease: RangeId) {
        for worker in self.connected.values_mut() {
            if worker.leases.remove(&lease) && worker.leases.is_empty() {
                worker.quarantined = false;
            }
        }
    }

    /// Returns the number of connected workers.
    pub(super) fn count(&self) -> u32 {
        u32::try_from(self.connected.len()).unwrap_or(u32::MAX)
    }

    /// Returns the workers that may be given leases now.
    pub(super) fn asking(&self) -> impl Iterator<Item = (&WorkerId, &WorkerEntry)> {
        self.connected
            .iter()
            .filter(|(_, worker)| worker.wants_leases())
    }

    pub(super) fn get(&self, id: &WorkerId) -> Option<&WorkerEntry> {
        self.connected.get(id)
    }

    pub(super) fn get_mut(&mut self, id: &WorkerId) -> Option<&mut WorkerEntry> {
        self.connected.get_mut(id)
    }

    pub(super) fn keys(&self) -> impl Iterator<Item = &WorkerId> {
        self.connected.keys()
    }

    pub(super) fn values(&self) -> impl Iterator<Item = &WorkerEntry> {
        self.connected.values()
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (&WorkerId, &WorkerEntry)> {
        self.connected.iter()
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = (&WorkerId, &mut WorkerEntry)> {
        self.connected.iter_mut()
    }
}

impl Index<&WorkerId> for Workers {
    type Output = WorkerEntry;

    fn index(&self, id: &WorkerId) -> &WorkerEntry {
        &self.connected[id]
    }
}
