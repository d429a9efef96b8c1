//! Connects and disconnects workers. A worker has one session; a newer one replaces the older one.

use picofarm_catalog::{Range, Worker};
use picofarm_proto::{
    ids::{LeaseRef, WorkerId},
    messages::{Examine, WorkerHello},
};

use super::{
    message::{SessionId, ToWorker},
    state::Core,
    workers::WorkerEntry,
};

/// Workers that were asked to check their machines.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Asked {
    pub workers: Vec<AskedWorker>,
    /// Number of workers connected to other coordinators.
    pub elsewhere: u32,
}

/// A worker that was asked to check its machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct AskedWorker {
    pub session: SessionId,
    pub id: String,
    pub name: String,
}

impl Core {
    /// Connects a worker. Leases that it still has stay live. Leases that it does not know become
    /// pending again. Leases of an earlier process of the worker are lost.
    pub(crate) fn hello(&mut self, session: SessionId, hello: WorkerHello, now_ms: i64) {
        let id = hello.id;
        if let Some(old) = self.workers.replace(id, &hello.name) {
            self.outcome.send(old, ToWorker::Replaced);
        }
        self.second_runs.remove_worker(id);
        self.refund(id, hello.incarnation);
        self.doubts.restarted(id, hello.incarnation);
        self.outcome.record_worker(Worker {
            id,
            incarnation: hello.incarnation,
            name: hello.name.clone(),
            last_seen_ms: now_ms,
        });
        let mut mine = Vec::new();
        let mut former = Vec::new();
        for entry in self.stages.values() {
            for (range, lease) in entry.held.leased().filter(|(_, l)| l.worker == id) {
                if lease.incarnation == hello.incarnation {
                    mine.push(range.clone());
                } else {
                    former.push(range.clone());
                }
            }
        }
        let why = match &*hello.ended {
            "" => "the worker was restarted while it held this lease".to_owned(),
            how => format!("the worker's process was {how}"),
        };
        for range in &former {
            self.lost(range, &why, now_ms);
        }
        self.load.worker_has(id, hello.abilities.cores);
        self.workers.connect(
            id,
            WorkerEntry {
                session,
                incarnation: hello.incarnation,
                name: hello.name,
                version: hello.version,
                since_ms: now_ms,
                heard_ms: now_ms,
                ends_ms: super::time_left::end_time(hello.ends_in_ms, now_ms),
                abilities: hello.abilities,
                credits: 0,
                leases: Default::default(),
                quarantined: false,
                drains: false,
            },
        );
        self.keep_held((session, id), &hello.held, mine, now_ms);
    }

    fn keep_held(
        &mut self,
        (session, worker): (SessionId, WorkerId),
        held: &[LeaseRef],
        mine: Vec<Range>,
        now_ms: i64,
    ) {
        for lease in held {
            if !mine.iter().any(|range| range.lease() == *lease) {
                self.outcome.revoke(
                    session,
                    *lease,
                    "the lease is no longer live: it ran out, was cancelled, or is finished",
                );
            }
        }
        for range in mine {
            if held.contains(&range.lease()) {
                self.renew(range.id, now_ms);
                let entry = self
                    .workers
                    .get_mut(&worker)
                    .expect("it has just connected");
                entry.leases.insert(range.id);
                entry.quarantined |= range.crashes > 0;
            } else {
                // The grant was lost on the way, so nobody runs it and nobody is at fault.
                self.close(&range, false);
            }
        }
    }

    /// Sets how many more leases a worker can take; 0 withdraws its request.
    pub(crate) fn credit(&mut self, session: SessionId, leases: u32) {
        if let Some(entry) = self.workers.of_session_mut(session) {
            entry.credits = match leases {
                0 => 0,
                n => entry.credits.saturating_add(n),
            };
        }
    }

    /// Tells workers with this id or name to finish their current tasks and to end. Returns their
    /// number.
    pub(crate) fn drain(&mut self, worker: &str) -> u32 {
        let mut count = 0;
        for (id, entry) in self.workers.iter_mut() {
            if entry.name == worker || id.to_string() == worker {
                entry.drains = true;
                self.outcome.send(entry.session, ToWorker::Drain);
                count += 1;
            }
        }
        count
    }

    /// Asks all connected workers to check their machines.
    pub(crate) fn examine(&mut self, what: &Examine) -> Asked {
        let mut asked = Asked {
            workers: Vec::new(),
            elsewhere: self.peers.workers(),
        };
        for (id, entry) in self.workers.iter() {
            let ask = ToWorker::Examine(what.clone());
            self.outcome.send(entry.session, ask);
            asked.workers.push(AskedWorker {
                session: entry.session,
                id: id.to_string(),
                name: entry.name.clone(),
            });
        }
        asked
    }

    /// Ends a session. Leases that were not returned stay live for a moment, because the worker may
    /// reconnect. If its process died, its tasks need not wait for the end of the lease.
    pub(crate) fn closed(&mut self, session: SessionId, now_ms: i64) {
        if let Some((worker, entry)) = self.workers.disconnect(session) {
            let until_ms = now_ms + i64::from(self.settings.reconnect_ms);
            // After a stall of this coordinator, the worker may still be waiting before it
            // reconnects.
            let until_ms = until_ms.max(self.leases.graced_until_ms());
            for range in &entry.leases {
                self.set_until(*range, |until| until.min(until_ms));
            }
            self.outcome.record_worker(Worker {
                id: worker,
                incarnation: entry.incarnation,
                name: entry.name,
                last_seen_ms: now_ms,
            });
        }
    }
}
