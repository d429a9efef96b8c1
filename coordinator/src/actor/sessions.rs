//! The sessions of one life of the actor: how to send to each, and which have unhandled heartbeats.

use std::{
    collections::HashMap,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
};

use tokio::sync::mpsc;

use crate::core::{SessionId, ToWorker};

/// Counts a session's heartbeats that have arrived and are not handled yet.
#[derive(Debug, Clone, Default)]
pub(crate) struct HeartbeatQueue(Arc<AtomicU32>);

impl HeartbeatQueue {
    /// Records the arrival of a heartbeat.
    pub(crate) fn arrived(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns the number of unhandled heartbeats.
    pub(crate) fn count(&self) -> u32 {
        self.0.load(Ordering::Relaxed)
    }
}

/// The open sessions.
#[derive(Debug, Default)]
pub(crate) struct Sessions(HashMap<SessionId, (mpsc::Sender<ToWorker>, HeartbeatQueue)>);

impl Sessions {
    pub(crate) fn open(
        &mut self,
        session: SessionId,
        say: mpsc::Sender<ToWorker>,
        waiting: HeartbeatQueue,
    ) {
        self.0.insert(session, (say, waiting));
    }

    pub(crate) fn close(&mut self, session: SessionId) {
        self.0.remove(&session);
    }

    pub(crate) fn get(&self, session: SessionId) -> Option<&mpsc::Sender<ToWorker>> {
        self.0.get(&session).map(|(say, _)| say)
    }

    /// Records that a heartbeat of this session was handled.
    pub(crate) fn heartbeat_handled(&self, session: SessionId) {
        if let Some((_, waiting)) = self.0.get(&session) {
            waiting.0.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// Returns the sessions with unhandled heartbeats.
    pub(crate) fn waiting(&self) -> impl Iterator<Item = SessionId> + '_ {
        let waits = self
            .0
            .iter()
            .filter(|(_, (_, w))| w.0.load(Ordering::Relaxed) > 0);
        waits.map(|(session, _)| *session)
    }
}
