//! The core over a real catalog against a simple model: whatever happens in whatever order, every task is
//! committed exactly once, the counts add up, and the catalog holds what the core thinks.

use std::collections::{BTreeMap, HashMap};

use picofarm_catalog::{Catalog, Mark, Range, RangeState, ResultSet, SqliteCatalog};
use picofarm_proto::{
    PROTOCOL,
    ids::{Incarnation, JobId, WorkerId},
    key::{stage_key, task_key},
    model::{Failure, FailureKind, Finished, JobSpec, JobState, Lease, WorkerHello},
};
use proptest::prelude::*;
use uuid::Uuid;

use super::{Core, OutputHint, Say, Settings};
use crate::budget::Backoff;

const TASKS: u64 = 12;
const WORKERS: u8 = 3;
const SETTINGS: Settings = Settings {
    lease_ms: 1_000,
    backoff: Backoff {
        first_ms: 10,
        most_ms: 100,
    },
};

#[derive(Debug, Clone)]
enum Op {
    Credit(u8),
    /// The worker finishes the nth task of the nth lease it ever had, live or not.
    Finish(u8, u8, u8),
    Fail(u8, u8, u8, FailureKind),
    Release(u8, u8),
    Beat(u8),
    /// The connection breaks; with `true`, the process dies too.
    Drop(u8, bool),
    Connect(u8),
    Pass(u16),
    RestartCoordinator,
    Retry,
    /// A second job over the same outputs.
    Grow,
}

fn op() -> impl Strategy<Value = Op> {
    let w = 0..WORKERS;
    prop_oneof![
        5 => w.clone().prop_map(Op::Credit),
        8 => (w.clone(), 0..4u8, any::<u8>()).prop_map(|(w, l, t)| Op::Finish(w, l, t)),
        2 => (w.clone(), 0..4u8, any::<u8>(), prop_oneof![
            Just(FailureKind::User), Just(FailureKind::Crash), Just(FailureKind::Interrupted)
        ]).prop_map(|(w, l, t, k)| Op::Fail(w, l, t, k)),
        1 => (w.clone(), 0..4u8).prop_map(|(w, l)| Op::Release(w, l)),
        2 => w.clone().prop_map(Op::Beat),
        1 => (w.clone(), any::<bool>()).prop_map(|(w, d)| Op::Drop(w, d)),
        3 => w.prop_map(Op::Connect),
        2 => (1..1_500u16).prop_map(Op::Pass),
        1 => Just(Op::RestartCoordinator),
        1 => Just(Op::Retry),
        1 => Just(Op::Grow),
    ]
}

fn spec(count: u64) -> JobSpec {
    serde_json::from_str(&format!(
        r#"{{"name": "law", "scenes": {{"kind": "primitive", "count": {count}}},
            "render": {{"renderer": "r"}}, "output": {{"store": "s", "dataset": "d"}}}}"#
    ))
    .unwrap()
}

#[derive(Default)]
struct FakeWorker {
    session: Option<u64>,
    incarnation: u128,
    /// Latest first.
    leases: Vec<Lease>,
}

struct World {
    catalog: SqliteCatalog,
    core: Core,
    now: i64,
    workers: Vec<FakeWorker>,
    next: u128,
    /// What the model knows to be committed.
    committed: BTreeMap<u64, String>,
    jobs: Vec<JobId>,
}

async fn load(catalog: &SqliteCatalog, now: i64) -> Core {
    let snapshot = catalog.load().await.unwrap();
    let mut timing = HashMap::new();
    for job in &snapshot.jobs {
        let set = ResultSet::of(&job.spec);
        let seconds = catalog.timing(&set).await.unwrap();
        timing.insert(set, seconds);
    }
    Core::load(snapshot, &timing, SETTINGS, Box::new(Uuid::new_v4), now)
}

impl World {
    async fn new(folder: &std::path::Path) -> Self {
        let catalog = SqliteCatalog::open(&folder.join("c.db"), "test")
            .await
            .unwrap();
        let core = load(&catalog, 0).await;
        let mut world = Self {
            catalog,
            core,
            now: 1,
            workers: (0..WORKERS).map(|_| FakeWorker::default()).collect(),
            next: 1,
            committed: BTreeMap::new(),
            jobs: Vec::new(),
        };
        world.submit(TASKS).await;
        world
    }

    async fn submit(&mut self, count: u64) {
        self.flush().await;
        let spec = spec(count);
        let set = ResultSet::of(&spec);
        let runs = self.catalog.output_runs(&set, count).await.unwrap();
        let timing = self.catalog.timing(&set).await.unwrap();
        let submitted = self
            .core
            .submit(spec, true, &runs, timing, self.now)
            .expect("all specs of this test share their settings");
        if !submitted.existed {
            self.jobs.push(submitted.job);
        }
    }

    async fn flush(&mut self) -> Vec<(u64, Say)> {
        let (changes, say) = self.core.take();
        self.catalog.commit(changes).await.unwrap();
        for (session, what) in &say {
            let worker = self
                .workers
                .iter_mut()
                .find(|w| w.session == Some(*session));
            if let (Some(worker), Say::Lease(lease)) = (worker, what) {
                worker.leases.insert(0, (**lease).clone());
            }
        }
        say
    }

    fn connect(&mut self, w: u8) {
        self.next += 1;
        let session = self.next as u64;
        let worker = &mut self.workers[usize::from(w)];
        if worker.incarnation == 0 {
            worker.incarnation = self.next;
        }
        worker.session = Some(session);
        let hello = WorkerHello {
            id: WorkerId::from_uuid(Uuid::from_u128(u128::from(w) + 1)),
            incarnation: Incarnation::from_uuid(Uuid::from_u128(worker.incarnation)),
            name: format!("w{w}"),
            version: String::new(),
            protocol: PROTOCOL,
            cores: 1,
            held: worker.leases.iter().map(|l| l.lease).collect(),
            renderer: "r".into(),
            assets: Vec::new(),
        };
        self.core.hello(session, hello, self.now);
    }

    async fn finish(&mut self, session: u64, lease: &Lease, index: u64) {
        let report = Finished {
            lease: lease.lease,
            index,
            key: task_key(&stage_key(&lease.spec), index),
            manifest_sha256: format!("{index:064x}"),
            bytes: 1,
            seconds: 1.0,
            adopted: false,
        };
        self.flush().await;
        let hint = match self.core.job_of(&report) {
            Some(job) => self.catalog.manifests(&[(job, index)]).await.unwrap()[0],
            None => None,
        };
        self.core
            .finished(session, &report, OutputHint(hint), self.now);
        let said = self.flush().await;
        let accepted = said
            .iter()
            .any(|(_, s)| matches!(s, Say::Acknowledge { accepted: true, .. }));
        if accepted {
            self.committed.insert(index, report.manifest_sha256);
        }
    }

    fn lease_of(&self, w: u8, l: u8) -> Option<(u64, Lease)> {
        let worker = &self.workers[usize::from(w)];
        Some((worker.session?, worker.leases.get(usize::from(l))?.clone()))
    }

    async fn act(&mut self, op: &Op) {
        match op {
            Op::Credit(w) => {
                if let Some(session) = self.workers[usize::from(*w)].session {
                    self.core.credit(session, 1);
                }
            }
            Op::Finish(w, l, t) => {
                if let Some((session, lease)) = self.lease_of(*w, *l) {
                    let index = lease.lo + u64::from(*t) % (lease.hi - lease.lo);
                    self.finish(session, &lease, index).await;
                }
            }
            Op::Fail(w, l, t, kind) => {
                if let Some((session, lease)) = self.lease_of(*w, *l) {
                    let failure = Failure {
                        lease: lease.lease,
                        index: lease.lo + u64::from(*t) % (lease.hi - lease.lo),
                        kind: *kind,
                        message: "no".into(),
                    };
                    self.core.failed(session, &failure, self.now);
                }
            }
            Op::Release(w, l) => {
                if let Some((session, lease)) = self.lease_of(*w, *l) {
                    self.core.released(session, lease.lease, "bye", self.now);
                }
            }
            Op::Beat(w) => {
                let worker = &self.workers[usize::from(*w)];
                if let Some(session) = worker.session {
                    let leases: Vec<_> = worker.leases.iter().map(|l| l.lease).collect();
                    self.core.heartbeat(session, &leases, &[], self.now);
                }
            }
            Op::Drop(w, dies) => {
                let worker = &mut self.workers[usize::from(*w)];
                if *dies {
                    worker.incarnation = 0;
                    worker.leases.clear();
                }
                if let Some(session) = worker.session.take() {
                    self.core.closed(session, self.now);
                }
            }
            Op::Connect(w) => self.connect(*w),
            Op::Pass(ms) => self.now += i64::from(*ms),
            Op::RestartCoordinator => {
                self.flush().await;
                self.core = load(&self.catalog, self.now).await;
                for worker in &mut self.workers {
                    worker.session = None;
                }
            }
            Op::Retry => {
                for job in self.jobs.clone() {
                    let _ = self.core.retry(job, self.now);
                }
            }
            Op::Grow => self.submit(TASKS + 4).await,
        }
        self.core.expire(self.now);
        self.core.dispatch(self.now);
        self.flush().await;
    }

    /// The laws.
    async fn check(&self) {
        let snapshot = self.catalog.load().await.unwrap();
        let mut runs = Vec::new();
        for job in &self.jobs {
            let entry = &self.core.jobs[job];
            let count = entry.job.spec.scenes.count;
            let ranges: Vec<&Range> = snapshot.ranges.iter().filter(|r| r.job == *job).collect();
            let mut seen = vec![0; count as usize];
            let mut done = 0;
            for range in &ranges {
                for task in range.lo..range.hi {
                    let (here, finished) = match &range.state {
                        RangeState::Leased(lease) => {
                            let mark = lease.marks[(task - range.lo) as usize];
                            (
                                mark != Mark::Left,
                                matches!(mark, Mark::Done | Mark::Reused),
                            )
                        }
                        RangeState::Done { .. } => (true, true),
                        RangeState::Pending { .. } | RangeState::Dead => (true, false),
                    };
                    seen[task as usize] += u32::from(here);
                    done += u64::from(here && finished);
                    if here && finished {
                        assert!(self.committed.contains_key(&task), "done without an output");
                    }
                }
            }
            assert!(
                seen.iter().all(|n| *n == 1),
                "each task stands in one range: {ranges:?}"
            );
            let counts = entry.stage.counts();
            assert_eq!(counts.total, count);
            assert_eq!(counts.done, done);
            assert_eq!(entry.stage.rows(), ranges.len());
            let set = ResultSet::of(&entry.job.spec);
            runs = self
                .catalog
                .output_runs(&set, u64::from(u32::MAX))
                .await
                .unwrap();
        }
        let outputs: Vec<u64> = runs.iter().flat_map(|r| r.lo..r.hi).collect();
        let known: Vec<u64> = self.committed.keys().copied().collect();
        assert_eq!(outputs, known, "outputs are exactly what was accepted");
    }

    /// An honest worker finishes what is left.
    async fn finish_all(&mut self) {
        for w in 0..WORKERS {
            self.act(&Op::Drop(w, true)).await;
        }
        for _ in 0..400 {
            self.act(&Op::Pass(1_200)).await;
            self.act(&Op::Connect(0)).await;
            self.act(&Op::Credit(0)).await;
            let Some((session, lease)) = self.lease_of(0, 0) else {
                continue;
            };
            for index in lease.lo..lease.hi {
                self.finish(session, &lease, index).await;
            }
            if self
                .jobs
                .iter()
                .all(|j| self.core.jobs[j].job.state != JobState::Active)
            {
                return;
            }
        }
        panic!("the jobs do not end");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, max_shrink_iters: 200, ..ProptestConfig::default() })]

    #[test]
    fn every_task_is_committed_exactly_once_whatever_happens(ops in prop::collection::vec(op(), 1..60)) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let folder = tempfile::tempdir().unwrap();
            let mut world = World::new(folder.path()).await;
            for op in &ops {
                world.act(op).await;
                world.check().await;
            }
            world.finish_all().await;
            world.check().await;
            for job in &world.jobs {
                let counts = world.core.jobs[job].stage.counts();
                assert_eq!(counts.done + counts.dead, counts.total);
            }
            world.catalog.close().await;
        });
    }
}
