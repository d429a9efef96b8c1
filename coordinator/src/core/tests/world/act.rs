//! What happens in a history.

use super::*;

impl World {
    pub(in crate::core::tests) async fn act(&mut self, op: &Op) {
        match op {
            Op::Credit(w) => {
                if let Some((h, session)) = self.workers[usize::from(*w)].session {
                    self.instances[h].core.credit(session, 1);
                }
            }
            Op::Finish(w, l, t) => {
                if let Some((h, session, lease)) = self.lease_of(*w, *l) {
                    let index = lease.lo + u64::from(*t) % (lease.hi - lease.lo);
                    self.finish(h, session, &lease, index).await;
                }
            }
            Op::Fail(w, l, t, kind) => {
                if let Some((h, session, lease)) = self.lease_of(*w, *l) {
                    let failure = Failure {
                        lease: lease.lease,
                        index: lease.lo + u64::from(*t) % (lease.hi - lease.lo),
                        kind: *kind,
                        message: "no".into(),
                        milliseconds: 0,
                        shared: 0,
                    };
                    self.instances[h].core.failed(session, &failure, self.now);
                }
            }
            Op::Release(w, l) => {
                if let Some((h, session, lease)) = self.lease_of(*w, *l) {
                    let core = &mut self.instances[h].core;
                    core.released(session, lease.lease, "bye", self.now);
                }
            }
            Op::Beat(w) => {
                let worker = &self.workers[usize::from(*w)];
                if let Some((h, session)) = worker.session {
                    let leases: Vec<_> = worker.leases.iter().map(|l| l.lease).collect();
                    let progress = worker.leases.iter().take(1).map(|l| TaskProgress {
                        lease: l.lease,
                        index: l.lo,
                        fraction: 0.5,
                        at: TaskAt::default(),
                    });
                    let progress: Vec<_> = progress.collect();
                    self.instances[h]
                        .core
                        .heartbeat(session, &leases, &progress, self.now);
                }
            }
            Op::Drop(w, dies) => {
                let worker = &mut self.workers[usize::from(*w)];
                if *dies {
                    worker.incarnation = 0;
                    worker.leases.clear();
                }
                if let Some((h, session)) = worker.session.take() {
                    self.instances[h].core.closed(session, self.now);
                }
            }
            Op::Connect(w, h) => self.connect(*w, self.instance(*h)).await,
            Op::Pass(ms) => self.now += i64::from(*ms),
            Op::InstanceBeats(h) => self.beat(self.instance(*h)).await,
            Op::InstanceRestarts(h) => {
                let h = self.instance(*h);
                self.flush(h).await;
                self.reload(h).await;
            }
            Op::InstanceIsLost(h) => {
                let h = self.instance(*h);
                if let Some(url) = &self.postgres {
                    testing::lose_instance(url, self.instances[h].id).await;
                }
            }
            Op::Retry => {
                for job in self.jobs.clone() {
                    let retried = self.instances[0].catalog.retry(job, self.now).await;
                    // A job with a later twin stays as it is.
                    if matches!(retried, Ok(1..)) {
                        self.instances[0].core.retried(job);
                        self.learn(0, job).await;
                    }
                }
            }
            Op::Pause(paused) => {
                let job = self.jobs[0];
                self.flush(0).await;
                let changed = self.instances[0]
                    .catalog
                    .pause(job, *paused, "", self.now)
                    .await;
                if self.or_reload(0, changed).await == Some(true) {
                    self.instances[0].core.paused(job, *paused);
                    self.flush(0).await;
                }
            }
            Op::Cancel => {
                let job = self.jobs[0];
                self.flush(0).await;
                let cancelled = self.instances[0].catalog.cancel(job, "", self.now).await;
                if self.or_reload(0, cancelled).await == Some(true) {
                    self.instances[0].core.drop_job(job, "cancelled");
                }
            }
            Op::Grow => self.submit(0, TASKS + 4).await,
            Op::Ends(w, ms) => {
                if let Some((h, session)) = self.workers[usize::from(*w)].session {
                    let core = &mut self.instances[h].core;
                    core.ends(session, Some(u64::from(*ms)), self.now);
                }
            }
        }
        for h in 0..self.instances.len() {
            self.step(h).await;
        }
    }

    /// Runs one turn of an instance's actor.
    pub(super) async fn step(&mut self, h: usize) {
        self.instances[h].core.expire(self.now);
        for _ in 0..ROUNDS {
            let wants = self.instances[h].core.wants(self.now);
            let claimed = !wants.is_empty();
            if claimed {
                self.flush(h).await;
                let claims = self.instances[h].catalog.claim(&wants).await;
                let Some(claims) = self.or_reload(h, claims).await else {
                    return;
                };
                for (want, claim) in wants.iter().zip(claims) {
                    self.instances[h].core.claimed(want.stage, claim, self.now);
                }
            }
            self.instances[h].core.dispatch(self.now);
            if !claimed {
                break;
            }
        }
        self.flush(h).await;
    }
}
