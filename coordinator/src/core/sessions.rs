//! Workers come and go. One session a worker: a newer one takes the older one's place.

use picofarm_catalog::{Range, Worker};
use picofarm_proto::{ids::LeaseRef, model::WorkerHello};

use super::{Core, Say, SessionId, WorkerEntry};

impl Core {
    /// A worker connects. Leases it still holds live on; those it does not know of become pending again; those
    /// of an earlier process of it are lost.
    pub(crate) fn hello(&mut self, session: SessionId, hello: WorkerHello, now_ms: i64) {
        let id = hello.id;
        if let Some(old) = self.workers.remove(&id) {
            self.sessions.remove(&old.session);
            self.say.push((old.session, Say::Replaced));
        }
        self.names.insert(id, hello.name.clone());
        self.doubles.retain(|_, double| double.worker != id);
        self.refund(id, hello.incarnation);
        self.doubts.restarted(id, hello.incarnation);
        self.changes.workers.insert(
            id,
            Worker {
                id,
                incarnation: hello.incarnation,
                name: hello.name.clone(),
                last_seen_ms: now_ms,
            },
        );
        let mut mine = Vec::new();
        let mut former = Vec::new();
        for entry in self.stages.values() {
            for (range, lease) in entry.stage.leased().filter(|(_, l)| l.worker == id) {
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
        self.sessions.insert(session, id);
        self.workers.insert(
            id,
            WorkerEntry {
                session,
                incarnation: hello.incarnation,
                name: hello.name,
                version: hello.version,
                since_ms: now_ms,
                heard_ms: now_ms,
                ends_ms: super::ends::at(hello.ends_in_ms, now_ms),
                abilities: hello.abilities,
                credits: 0,
                leases: Default::default(),
                quarantined: false,
                drains: false,
            },
        );
        self.keep_held(session, &hello.held, mine, now_ms);
    }

    fn keep_held(&mut self, session: SessionId, held: &[LeaseRef], mine: Vec<Range>, now_ms: i64) {
        let worker = self.sessions[&session];
        for lease in held {
            if !mine.iter().any(|range| range.lease() == *lease) {
                let revoke = Say::Revoke {
                    lease: *lease,
                    reason:
                        "the lease is no longer live: it ran out, was cancelled, or is finished"
                            .into(),
                };
                self.say.push((session, revoke));
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
                // The grant was lost on the way: nobody works on it and nobody is to blame.
                self.close(&range, false);
            }
        }
    }

    /// A worker can take more leases; with 0 it takes back what it asked for.
    pub(crate) fn credit(&mut self, session: SessionId, leases: u32) {
        if let Some(worker) = self.sessions.get(&session)
            && let Some(entry) = self.workers.get_mut(worker)
        {
            entry.credits = match leases {
                0 => 0,
                n => entry.credits.saturating_add(n),
            };
        }
    }

    /// Workers of this id or name are asked to finish what is in hand and to end; returns how many there are.
    pub(crate) fn drain(&mut self, worker: &str) -> u32 {
        let mut count = 0;
        for (id, entry) in &mut self.workers {
            if entry.name == worker || id.to_string() == worker {
                entry.drains = true;
                self.say.push((entry.session, Say::Drain));
                count += 1;
            }
        }
        count
    }

    /// A session has ended. Leases that were not given back live on for a moment: the worker may come back. If its
    /// process died, its tasks shall not wait for the end of the lease.
    pub(crate) fn closed(&mut self, session: SessionId, now_ms: i64) {
        let Some(worker) = self.sessions.remove(&session) else {
            return;
        };
        if let Some(entry) = self.workers.remove(&worker) {
            let until_ms = now_ms + i64::from(self.settings.reconnect_ms);
            // Broken by a stall here: the worker may still be waiting before it tries again.
            let until_ms = until_ms.max(self.graced_until_ms);
            for range in &entry.leases {
                self.set_until(*range, |until| until.min(until_ms));
            }
            self.changes.workers.insert(
                worker,
                Worker {
                    id: worker,
                    incarnation: entry.incarnation,
                    name: entry.name,
                    last_seen_ms: now_ms,
                },
            );
        }
    }
}
