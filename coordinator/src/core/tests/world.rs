//! Instances of the core over one catalog, workers that follow instructions, and a model of the
//! expected result.

mod act;
mod checks;

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
    sync::Arc,
};

use picofarm_catalog::{Catalog, CatalogError, Job, Outcome, Recorded, ResultSet, Run, Submission};
use picofarm_database::{PostgresCatalog, SqliteCatalog, testing};
use picofarm_proto::{
    PROTOCOL,
    ids::{Incarnation, InstanceId, JobId, WorkerId},
    key::task_key,
    messages::{
        Abilities, Failure, FailureKind, Finished, JobState, Lease, TaskAt, TaskProgress,
        WorkerHello,
    },
    spec::JobSpec,
};
use proptest::prelude::*;
use uuid::Uuid;

use crate::{
    core::{Backoff, Core, OutputHint, Settings, Timings, ToWorker},
    submission::{Draft, prepare, reuses_job},
};

pub(super) const TASKS: u64 = 12;
/// The same value as the actor's.
const ROUNDS: usize = 8;
const WORKERS: u8 = 3;
pub(super) const SETTINGS: Settings = Settings {
    lease_ms: 1_000,
    reconnect_ms: 100,
    backoff: Backoff {
        first_ms: 10,
        most_ms: 100,
    },
    worth_ms: 20,
    slow_ms: 300,
};

#[derive(Debug, Clone)]
pub(super) enum Op {
    Credit(u8),
    /// The worker finishes the nth task of the nth lease that it ever had, live or not.
    Finish(u8, u8, u8),
    Fail(u8, u8, u8, FailureKind),
    Release(u8, u8),
    Beat(u8),
    /// The connection breaks; with `true`, the process dies too.
    Drop(u8, bool),
    /// The worker connects to the nth instance without leaving another first.
    Connect(u8, u8),
    Pass(u16),
    /// An instance beats and receives news.
    InstanceBeats(u8),
    /// An instance's process restarts.
    InstanceRestarts(u8),
    /// An instance's registration runs out while it sleeps.
    InstanceIsLost(u8),
    Retry,
    /// The first job is paused or resumed.
    Pause(bool),
    Cancel,
    /// A second job writes to the same outputs.
    Grow,
    /// The worker must end in this many milliseconds.
    Ends(u8, u16),
}

pub(super) fn op() -> impl Strategy<Value = Op> {
    let w = 0..WORKERS;
    let h = any::<u8>();
    prop_oneof![
        5 => w.clone().prop_map(Op::Credit),
        8 => (w.clone(), 0..4u8, any::<u8>()).prop_map(|(w, l, t)| Op::Finish(w, l, t)),
        2 => (w.clone(), 0..4u8, any::<u8>(), prop_oneof![
            Just(FailureKind::User), Just(FailureKind::Crash), Just(FailureKind::Interrupted)
        ]).prop_map(|(w, l, t, k)| Op::Fail(w, l, t, k)),
        1 => (w.clone(), 0..4u8).prop_map(|(w, l)| Op::Release(w, l)),
        2 => w.clone().prop_map(Op::Beat),
        1 => (w.clone(), any::<bool>()).prop_map(|(w, d)| Op::Drop(w, d)),
        3 => (w, h).prop_map(|(w, h)| Op::Connect(w, h)),
        2 => (1..1_500u16).prop_map(Op::Pass),
        2 => h.prop_map(Op::InstanceBeats),
        1 => h.prop_map(Op::InstanceRestarts),
        1 => h.prop_map(Op::InstanceIsLost),
        1 => Just(Op::Retry),
        1 => any::<bool>().prop_map(Op::Pause),
        1 => prop_oneof![9 => Just(Op::Grow), 1 => Just(Op::Cancel)],
    ]
}

fn spec(count: u64) -> JobSpec {
    // The second stage needs the first.
    serde_json::from_str(&format!(
        r#"{{"name": "law", "stage": [
            {{"scenes": {{"kind": "primitive", "count": {count}}}, "render": {{"renderer": "r"}},
             "output": {{"store": "s", "dataset": "d"}}}},
            {{"kind": "reprocess", "source": "render", "reprocess": {{"version": "r"}},
             "output": {{"store": "s", "dataset": "e"}}}}]}}"#
    ))
    .unwrap()
}

#[derive(Default)]
pub(super) struct FakeWorker {
    /// The instance, and the session with it.
    pub(super) session: Option<(usize, u64)>,
    incarnation: u128,
    /// The reported milliseconds until the worker must end.
    pub(super) ends_in_ms: Option<u64>,
    /// Leases of the worker, latest first.
    pub(super) leases: Vec<Lease>,
}

pub(super) struct Instance {
    pub(super) catalog: Arc<dyn Catalog>,
    id: InstanceId,
    pub(super) core: Core,
}

impl Instance {
    async fn open(catalog: Arc<dyn Catalog>, now: i64) -> Self {
        let (id, core) = load(&*catalog, now).await;
        Self { catalog, id, core }
    }
}

async fn load(catalog: &dyn Catalog, now: i64) -> (InstanceId, Core) {
    let snapshot = catalog.load().await.unwrap();
    let mut timings = Timings::new();
    for stage in snapshot.jobs.iter().flat_map(Job::stages) {
        let seconds = catalog.timing(&stage.set).await.unwrap();
        timings.insert(stage.set, seconds);
    }
    let id = snapshot.instance;
    let core = Core::load(snapshot, &timings, SETTINGS, Box::new(Uuid::now_v7), now);
    (id, core)
}

pub(super) struct World {
    pub(super) instances: Vec<Instance>,
    /// Address of the Postgres catalog, on which instances can be lost.
    postgres: Option<String>,
    pub(super) now: i64,
    pub(super) workers: Vec<FakeWorker>,
    next: u128,
    /// The results that the model expects to be committed, by stage and task.
    committed: BTreeMap<(u32, u64), String>,
    pub(super) jobs: Vec<JobId>,
    pub(super) trims: u32,
    pub(super) doubles: u32,
}

impl World {
    /// Creates one instance on SQLite in a folder.
    pub(super) async fn on_sqlite(folder: &Path) -> Self {
        let catalog = SqliteCatalog::open(&folder.join("c.db"), "test").await;
        Self::new(vec![Arc::new(catalog.unwrap())], None).await
    }

    /// Creates two instances on one Postgres, if one is available.
    pub(super) async fn on_postgres() -> Option<Self> {
        let url = testing::postgres().await?;
        let mut catalogs: Vec<Arc<dyn Catalog>> = Vec::new();
        for name in ["a", "b"] {
            catalogs.push(Arc::new(PostgresCatalog::open(&url, name).await.unwrap()));
        }
        Some(Self::new(catalogs, Some(url)).await)
    }

    async fn new(catalogs: Vec<Arc<dyn Catalog>>, postgres: Option<String>) -> Self {
        let mut instances = Vec::new();
        for catalog in catalogs {
            instances.push(Instance::open(catalog, 0).await);
        }
        let mut world = Self {
            instances,
            postgres,
            now: 1,
            workers: (0..WORKERS).map(|_| FakeWorker::default()).collect(),
            next: 1,
            committed: BTreeMap::new(),
            jobs: Vec::new(),
            trims: 0,
            doubles: 0,
        };
        world.submit(0, TASKS).await;
        world
    }

    /// Begins a new life of an instance, as the actor does after a failed catalog call.
    async fn reload(&mut self, h: usize) {
        let instance = &mut self.instances[h];
        (instance.id, instance.core) = load(&*instance.catalog, self.now).await;
        for worker in &mut self.workers {
            worker.session = worker.session.filter(|(at, _)| *at != h);
        }
    }

    /// Reacts to the catalog's answer as an instance does: an error ends its life.
    async fn or_reload<T>(&mut self, h: usize, result: Result<T, CatalogError>) -> Option<T> {
        match result {
            Ok(value) => Some(value),
            Err(CatalogError::Fenced | CatalogError::Conflict(_)) if self.postgres.is_some() => {
                self.reload(h).await;
                None
            }
            Err(error) => panic!("{error}"),
        }
    }

    async fn submit(&mut self, h: usize, count: u64) {
        self.submit_as(h, "ada", spec(count)).await;
    }

    pub(super) async fn submit_as(&mut self, h: usize, user: &str, spec: JobSpec) {
        self.flush(h).await;
        let catalog = self.instances[h].catalog.clone();
        let latest = catalog
            .job_with(&picofarm_proto::key::spec_hash(&spec))
            .await;
        if latest
            .unwrap()
            .is_some_and(|job| reuses_job(job.state, true))
        {
            return;
        }
        let draft = Draft::new(spec, 0);
        let mut runs = Vec::new();
        for stage in draft.stages() {
            let recorded = catalog.recorded(&stage.set, stage.tasks).await.unwrap();
            // The store contains every other result; the rest were never checked.
            let seen: Vec<_> = recorded.into_iter().filter(|o| o.task % 2 == 0).collect();
            let marked = catalog.mark_checked(&stage.set, &seen).await;
            if self.or_reload(h, marked).await.is_none() {
                return;
            }
            let run = |o: &Recorded| Run {
                lo: o.task,
                hi: o.task + 1,
            };
            runs.push(seen.iter().map(run).collect::<Vec<_>>());
        }
        let prepared = prepare(&draft, user.into(), "", &runs, &mut Uuid::now_v7, self.now);
        let submission = Submission::new(
            &prepared.job,
            &prepared.stages,
            &prepared.ranges,
            &prepared.events,
        );
        let recorded = catalog.record(&submission).await;
        if self.or_reload(h, recorded).await == Some(Outcome::New) {
            self.jobs.push(prepared.job.id);
            self.learn(h, prepared.job.id).await;
        }
    }

    async fn learn(&mut self, h: usize, job: JobId) {
        let instance = &mut self.instances[h];
        let record = instance.catalog.job(job).await.unwrap().unwrap();
        if record.job.state == JobState::Active && !instance.core.knows(job) {
            let mut timings = Timings::new();
            let stages = record.job.stages();
            for stage in &stages {
                let seconds = instance.catalog.timing(&stage.set).await.unwrap();
                timings.insert(stage.set.clone(), seconds);
            }
            instance.core.add_job(&record.job, stages, &timings);
        }
    }

    pub(super) async fn flush(&mut self, h: usize) -> Vec<(u64, ToWorker)> {
        let instance = &mut self.instances[h];
        let (changes, say) = instance.core.take();
        let written = instance.catalog.commit(&changes).await;
        let Some(settled) = self.or_reload(h, written).await else {
            return Vec::new();
        };
        self.instances[h].core.settled(&settled);
        for (session, what) in &say {
            let worker = self
                .workers
                .iter_mut()
                .find(|w| w.session == Some((h, *session)));
            match (worker, what) {
                (Some(worker), ToWorker::Lease(lease)) => {
                    self.doubles += u32::from(lease.lease.epoch.0 == 0);
                    worker.leases.insert(0, (**lease).clone());
                }
                (_, ToWorker::Trim { .. }) => self.trims += 1,
                _ => {}
            }
        }
        say
    }

    pub(super) async fn beat(&mut self, h: usize) {
        self.instances[h].core.give_back();
        self.flush(h).await;
        let connected = self.instances[h].core.connected();
        let news = self.instances[h].catalog.beat(connected, self.now).await;
        let Some(news) = self.or_reload(h, news).await else {
            return;
        };
        for job in self.instances[h].core.apply_news(news, self.now) {
            self.learn(h, job).await;
        }
    }

    pub(super) async fn connect(&mut self, w: u8, h: usize) {
        self.next += 1;
        let session = self.next as u64;
        let worker = &mut self.workers[usize::from(w)];
        if worker.incarnation == 0 {
            worker.incarnation = self.next;
        }
        let hello = WorkerHello {
            id: WorkerId::from_uuid(Uuid::from_u128(u128::from(w) + 1)),
            incarnation: Incarnation::from_uuid(Uuid::from_u128(worker.incarnation)),
            name: format!("w{w}"),
            version: String::new(),
            protocol: PROTOCOL,
            held: worker.leases.iter().map(|l| l.lease).collect(),
            ended: String::new(),
            ends_in_ms: worker.ends_in_ms,
            abilities: Abilities {
                kinds: ["render", "reprocess"]
                    .map(|kind| (kind.to_owned(), "r".to_owned()))
                    .into(),
                // One of the workers has a label.
                labels: (w == 2).then(|| "x".to_owned()).into_iter().collect(),
                ..Abilities::default()
            },
        };
        worker.session = None;
        self.flush(h).await;
        let owned = self.instances[h].catalog.adopt(hello.id).await;
        if let Some(owned) = self.or_reload(h, owned).await {
            self.instances[h].core.receive(owned, self.now);
            self.instances[h].core.hello(session, hello, self.now);
            self.workers[usize::from(w)].session = Some((h, session));
        }
    }

    pub(super) async fn finish(&mut self, h: usize, session: u64, lease: &Lease, index: u64) {
        let report = Finished {
            lease: lease.lease,
            index,
            key: task_key(&lease.key, index),
            manifest_sha256: format!("{index:064x}"),
            bytes: 1,
            seconds: 0.01,
            adopted: false,
            traceparent: String::new(),
            shared: 0,
        };
        self.flush(h).await;
        let instance = &mut self.instances[h];
        let hint = match instance.core.stage_of(&report) {
            Some(stage) => instance.catalog.manifests(&[(stage, index)]).await.unwrap()[0],
            None => None,
        };
        instance
            .core
            .finished(session, &report, OutputHint(hint), false, self.now);
        let said = self.flush(h).await;
        let accepted = said
            .iter()
            .any(|(_, s)| matches!(s, ToWorker::Acknowledge { accepted: true, .. }));
        if accepted {
            if lease.ordinal == 1 {
                let made = |task| self.committed.contains_key(&(0, task));
                assert!(
                    (0..lease.stage.tasks()).all(made),
                    "a stage ran before what it needs"
                );
            }
            self.committed
                .insert((lease.ordinal, index), report.manifest_sha256);
        }
    }

    /// Fails a task of the first worker.
    pub(super) async fn fail(&mut self, lease: &Lease, index: u64, kind: FailureKind) {
        self.fail_on(0, lease, index, kind).await;
    }

    /// Fails a task of a worker.
    pub(super) async fn fail_on(&mut self, w: usize, lease: &Lease, index: u64, kind: FailureKind) {
        let Some((h, session)) = self.workers[w].session else {
            return;
        };
        let failure = Failure {
            lease: lease.lease,
            index,
            kind,
            message: "no".into(),
            milliseconds: 0,
            shared: 0,
        };
        self.instances[h].core.failed(session, &failure, self.now);
        self.flush(h).await;
    }

    pub(super) async fn close(self) {
        for instance in &self.instances {
            instance.catalog.close().await;
        }
    }

    fn lease_of(&self, w: u8, l: u8) -> Option<(usize, u64, Lease)> {
        let worker = &self.workers[usize::from(w)];
        let (instance, session) = worker.session?;
        Some((
            instance,
            session,
            worker.leases.get(usize::from(l))?.clone(),
        ))
    }

    fn instance(&self, h: u8) -> usize {
        usize::from(h) % self.instances.len()
    }

    /// Finishes all remaining tasks with honest workers.
    async fn finish_all(&mut self) {
        for w in 0..WORKERS {
            self.act(&Op::Drop(w, true)).await;
        }
        // An instance that was lost meanwhile refuses the first call afterwards.
        for h in 0..self.instances.len() {
            self.beat(h).await;
        }
        self.act(&Op::Pause(false)).await;
        for turn in 0..400u64 {
            self.act(&Op::Pass(1_200)).await;
            for h in 0..self.instances.len() {
                self.beat(h).await;
            }
            self.act(&Op::Connect(0, (turn / 50) as u8)).await;
            self.act(&Op::Credit(0)).await;
            if let Some((h, session, lease)) = self.lease_of(0, 0) {
                for index in lease.lo..lease.hi {
                    self.finish(h, session, &lease, index).await;
                }
            }
            let mut over = true;
            for job in &self.jobs {
                let record = self.instances[0].catalog.job(*job).await.unwrap().unwrap();
                over &= record.job.state != JobState::Active;
            }
            if over {
                return;
            }
        }
        panic!("the jobs do not end");
    }

    /// Finishes all tasks, checks the laws and closes the catalogs.
    pub(super) async fn end(mut self) {
        self.finish_all().await;
        self.check().await;
        for instance in &self.instances {
            instance.catalog.close().await;
        }
    }

    /// One worker takes all tasks and another one arrives with none: trimming, then doubling.
    pub(super) async fn greedy(&mut self) {
        for op in [Op::Connect(0, 0), Op::Credit(0), Op::Finish(0, 0, 0)] {
            self.act(&op).await;
        }
        for _ in 0..8 {
            self.act(&Op::Credit(0)).await;
        }
        self.act(&Op::InstanceBeats(0)).await;
        self.act(&Op::Connect(1, 0)).await;
        for _ in 0..8 {
            self.act(&Op::Credit(1)).await;
        }
        self.act(&Op::Beat(0)).await;
        self.act(&Op::Beat(1)).await;
        for _ in 0..2 {
            self.act(&Op::Pass(300)).await;
            self.act(&Op::Beat(0)).await;
            self.act(&Op::Beat(1)).await;
        }
        self.act(&Op::Connect(2, 0)).await;
        for _ in 0..10 {
            self.act(&Op::Credit(2)).await;
            for task in 0..4 {
                self.act(&Op::Finish(2, 0, task)).await;
            }
            self.act(&Op::Pass(100)).await;
            self.act(&Op::Beat(0)).await;
            self.act(&Op::Beat(1)).await;
        }
    }

    pub(super) async fn live(mut self, greedy: bool, ops: &[Op]) {
        if greedy {
            self.greedy().await;
            self.check().await;
        }
        for op in ops {
            self.act(op).await;
            self.check().await;
        }
        self.finish_all().await;
        self.check().await;
        for job in &self.jobs {
            let record = self.instances[0].catalog.job(*job).await.unwrap().unwrap();
            let (state, counts) = (record.job.state, record.counts());
            let stuck = counts.pending > 0 && counts.dead > 0;
            let over = counts.leased == 0 && (counts.pending == 0 || stuck);
            assert!(state == JobState::Cancelled || over, "{counts:?}");
        }
        for instance in &self.instances {
            instance.catalog.close().await;
        }
    }
}
