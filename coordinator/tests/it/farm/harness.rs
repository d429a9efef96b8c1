//! A coordinator with its own clock, a client, and a worker scripted by the test.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicI64, AtomicUsize, Ordering},
    },
    time::Duration,
};

use futures::future::BoxFuture;
use picofarm_coordinator::{
    Backoff, Clock, CoordinatorConfig, CoordinatorError, ResultReader, ResultState, Running,
    VERSION, serve,
};
use picofarm_database::CatalogPlace;
use picofarm_proto::{
    PROTOCOL,
    ids::{Incarnation, WorkerId},
    key::task_key,
    messages::{Abilities, JobState, JobStatus, Lease, WorkerHello},
    spec::{JobSpec, RenderTask, StageSpec, TaskSpec},
    wire::{
        self, farm_client::FarmClient, jobs_client::JobsClient, session_request::Message as Say,
        session_response::Message as Heard,
    },
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming, transport::Channel};
use uuid::Uuid;

/// Duration of a lease in these tests, in milliseconds of the test's clock.
pub const LEASE_MS: u32 = 60_000;
/// No operation takes this long; a test that waits longer has failed.
const PATIENCE: Duration = Duration::from_secs(20);

/// A scripted store. It contains every reported result, with exceptions.
#[derive(Debug, Default)]
pub struct FakeStore {
    /// Different manifests by task; `None` for a missing result.
    pub instead: Mutex<BTreeMap<u64, Option<[u8; 32]>>>,
    /// The reason why the store cannot be read.
    pub closed: Mutex<Option<String>>,
    /// Whether the store never answers.
    pub hangs: AtomicBool,
    /// Whether this machine has no such folder.
    pub absent: AtomicBool,
    /// Number of results checked.
    pub asked: AtomicUsize,
}

impl FakeStore {
    /// Sets the manifest that the store contains for a task.
    pub fn put(&self, task: u64, manifest: Option<[u8; 32]>) {
        self.instead.lock().unwrap().insert(task, manifest);
    }

    pub fn close(&self, why: &str) {
        *self.closed.lock().unwrap() = Some(why.into());
    }
}

impl ResultReader for FakeStore {
    fn check<'a>(
        &'a self,
        _: &'a StageSpec,
        results: &'a [(u64, [u8; 32])],
    ) -> BoxFuture<'a, Result<Vec<ResultState>, String>> {
        Box::pin(async move {
            if self.hangs.load(Ordering::SeqCst) {
                std::future::pending::<()>().await;
            }
            if let Some(why) = &*self.closed.lock().unwrap() {
                return Err(why.clone());
            }
            if self.absent.load(Ordering::SeqCst) {
                return Ok(vec![ResultState::NoFolder; results.len()]);
            }
            self.asked.fetch_add(results.len(), Ordering::SeqCst);
            let instead = self.instead.lock().unwrap();
            let of = |(task, reported): &(u64, [u8; 32])| match instead.get(task) {
                Some(None) => ResultState::Gone,
                Some(Some(other)) if other != reported => ResultState::Differs,
                _ => ResultState::Equal,
            };
            Ok(results.iter().map(of).collect())
        })
    }
}

pub struct Farm {
    _folder: tempfile::TempDir,
    /// The store that the coordinator reads.
    pub stored: Arc<FakeStore>,
    pub clock: Arc<AtomicI64>,
    /// Time for which the coordinator was suspended.
    slept: Arc<AtomicI64>,
    pub config: CoordinatorConfig,
    catalog: CatalogPlace,
    stop: CancellationToken,
    running: Option<Running>,
    pub jobs: JobsClient<Channel>,
}

impl Farm {
    pub async fn start() -> Self {
        Self::start_on(None).await
    }

    /// Starts a farm on each kind of catalog: SQLite, and Postgres if a test server is available.
    pub async fn start_on_each() -> Vec<Self> {
        let mut farms = vec![Self::start().await];
        if let Some(url) = picofarm_database::testing::postgres().await {
            farms.push(Self::start_on(Some(CatalogPlace::Postgres(url))).await);
        }
        farms
    }

    pub async fn start_on(catalog: Option<CatalogPlace>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let catalog = catalog.unwrap_or_else(|| folder.path().join("state/catalog.db").into());
        let clock = Arc::new(AtomicI64::new(1_000_000));
        let slept = Arc::new(AtomicI64::new(0));
        let (time, more) = (Arc::clone(&clock), Arc::clone(&slept));
        let passed = Arc::clone(&slept);
        let stored = Arc::new(FakeStore::default());
        let config = CoordinatorConfig {
            lease_ms: LEASE_MS,
            tick: Duration::from_millis(10),
            backoff: Backoff {
                first_ms: 1_000,
                most_ms: 8_000,
            },
            clock: Clock::with_stalls(
                move || time.load(Ordering::SeqCst) + more.load(Ordering::SeqCst),
                move || passed.load(Ordering::SeqCst),
            ),
            http: Some("127.0.0.1:0".parse().unwrap()),
            result_reader: Some(Arc::clone(&stored) as Arc<dyn ResultReader>),
            ..CoordinatorConfig::new(catalog.clone(), "127.0.0.1:0".parse().unwrap())
        };
        let (running, stop, jobs) = run(&config).await.unwrap();
        Self {
            _folder: folder,
            stored,
            clock,
            slept,
            config,
            catalog,
            stop,
            running: Some(running),
            jobs,
        }
    }

    pub fn address(&self) -> std::net::SocketAddr {
        self.running.as_ref().unwrap().address
    }

    /// Returns the status line and the text of `/readyz`.
    pub async fn readiness(&self) -> (String, String) {
        use tokio::io::{AsyncReadExt, AsyncWriteExt};
        let address = self.running.as_ref().unwrap().http.unwrap();
        let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
        stream
            .write_all(b"GET /readyz HTTP/1.1\r\nHost: x\r\n\r\n")
            .await
            .unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await.unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        (head.lines().next().unwrap().to_owned(), body.to_owned())
    }

    /// Waits until the coordinator is ready, or not ready with this message.
    pub async fn until_ready(&self, unready: Option<&str>) {
        let start = std::time::Instant::now();
        loop {
            let (status, words) = self.readiness().await;
            let there = match unready {
                None => status.contains("200"),
                Some(why) => status.contains("503") && words.contains(why),
            };
            if there {
                return;
            }
            assert!(start.elapsed() < PATIENCE, "it stays {status} {words}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    pub async fn stop(&mut self) {
        self.stop.cancel();
        if let Some(running) = self.running.take() {
            tokio::time::timeout(PATIENCE, running.wait())
                .await
                .expect("stops in time")
                .unwrap();
        }
    }

    /// Stops the coordinator and starts another on the same catalog.
    pub async fn restart(&mut self) {
        self.stop().await;
        let (running, stop, jobs) = run(&self.config).await.unwrap();
        self.running = Some(running);
        self.stop = stop;
        self.jobs = jobs;
    }

    pub fn pass(&self, ms: i64) {
        self.clock.fetch_add(ms, Ordering::SeqCst);
    }

    /// Advances the time while the coordinator's machine is suspended.
    pub fn suspend(&self, ms: i64) {
        self.slept.fetch_add(ms, Ordering::SeqCst);
    }

    pub async fn submit(&mut self, spec: &JobSpec) -> wire::SubmitJobResponse {
        self.submit_again(spec, false).await
    }

    pub async fn submit_again(&mut self, spec: &JobSpec, again: bool) -> wire::SubmitJobResponse {
        let request = wire::SubmitJobRequest {
            spec: Some(spec.clone().into()),
            again,
        };
        self.jobs.submit_job(request).await.unwrap().into_inner()
    }

    pub async fn plan(&mut self, spec: &JobSpec) -> wire::JobPlan {
        let request = wire::PlanJobRequest {
            spec: Some(spec.clone().into()),
        };
        let response = self.jobs.plan_job(request).await.unwrap();
        response.into_inner().plan.unwrap()
    }

    pub async fn status(&mut self, job: &str) -> JobStatus {
        let request = wire::GetJobRequest { job_id: job.into() };
        let response = self.jobs.get_job(request).await.unwrap().into_inner();
        response.job.unwrap().try_into().unwrap()
    }

    /// Waits until the job's status satisfies the condition.
    pub async fn until(&mut self, job: &str, what: impl Fn(&JobStatus) -> bool) -> JobStatus {
        let start = std::time::Instant::now();
        loop {
            let status = self.status(job).await;
            if what(&status) {
                return status;
            }
            assert!(start.elapsed() < PATIENCE, "the job stays {status:?}");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    pub async fn until_ended(&mut self, job: &str) -> JobStatus {
        self.until(job, |s| s.state != JobState::Active).await
    }

    pub async fn events(&mut self, job: &str, task: Option<u64>) -> Vec<wire::Event> {
        let request = wire::ListEventsRequest {
            stage: None,
            job_id: job.into(),
            after: 0,
            limit: 0,
            task,
            newest: false,
            logs: true,
        };
        let response = self.jobs.list_events(request).await.unwrap();
        response.into_inner().events
    }

    pub async fn worker(&self) -> Worker {
        self.connect(hello("ada")).await.unwrap()
    }

    pub async fn connect(&self, hello: WorkerHello) -> Result<Worker, Status> {
        Worker::connect(self.address(), hello).await
    }
}

async fn run(
    config: &CoordinatorConfig,
) -> Result<(Running, CancellationToken, JobsClient<Channel>), CoordinatorError> {
    let stop = CancellationToken::new();
    let running = serve(config.clone(), stop.clone()).await?;
    let url = format!("http://{}", running.address);
    let jobs = JobsClient::connect(url).await.unwrap();
    Ok((running, stop, jobs))
}

/// Returns the hello of a worker that can run [`spec`].
pub fn hello(name: &str) -> WorkerHello {
    WorkerHello {
        id: WorkerId::from_uuid(Uuid::new_v4()),
        incarnation: Incarnation::from_uuid(Uuid::new_v4()),
        name: name.into(),
        version: VERSION.into(),
        protocol: PROTOCOL,
        held: Vec::new(),
        ended: String::new(),
        ends_in_ms: None,
        abilities: Abilities {
            kinds: ["render", "reprocess"]
                .map(|kind| (kind.to_owned(), "r1".to_owned()))
                .into(),
            assets: vec!["parametric-1".into()],
            cores: 1,
            ..Abilities::default()
        },
    }
}

pub fn spec(count: u64) -> JobSpec {
    let text = format!(
        r#"{{"name": "test", "scenes": {{"kind": "primitive", "count": {count}}},
            "render": {{"renderer": "r1"}},
            "output": {{"store": "file:///nowhere", "dataset": "d", "profile": "sqrt-u16"}}}}"#
    );
    serde_json::from_str(&text).unwrap()
}

/// Returns the render task of a job's first stage.
pub fn rendering(spec: &mut JobSpec) -> &mut RenderTask {
    match &mut spec.stages[0].task {
        TaskSpec::Render(task) => task,
        other => panic!("{other:?}"),
    }
}

/// Returns the manifest hash that an honest worker reports for a task.
pub fn manifest(index: u64) -> String {
    format!("{index:064x}")
}

pub struct Worker {
    pub hello: WorkerHello,
    /// Number of tasks that share its cores, as it reports.
    pub share: u32,
    say: mpsc::Sender<wire::SessionRequest>,
    heard: Streaming<wire::SessionResponse>,
}

impl Worker {
    pub async fn connect(
        address: std::net::SocketAddr,
        hello: WorkerHello,
    ) -> Result<Self, Status> {
        let url = format!("http://{address}");
        let mut client = FarmClient::connect(url).await.unwrap();
        let (say, said) = mpsc::channel(64);
        let first = wire::SessionRequest {
            message: Some(Say::Hello(hello.clone().into())),
        };
        say.send(first).await.unwrap();
        let heard = client
            .session(ReceiverStream::new(said))
            .await?
            .into_inner();
        let mut worker = Self {
            hello,
            share: 0,
            say,
            heard,
        };
        match worker.hear().await? {
            Heard::Welcome(welcome) => assert_eq!(welcome.lease_ms, LEASE_MS),
            other => panic!("expected welcome, heard {other:?}"),
        }
        Ok(worker)
    }

    pub async fn say(&self, message: Say) {
        let request = wire::SessionRequest {
            message: Some(message),
        };
        self.say.send(request).await.unwrap();
    }

    /// Returns the next message.
    pub async fn hear(&mut self) -> Result<Heard, Status> {
        let message = tokio::time::timeout(PATIENCE, self.heard.message())
            .await
            .expect("something is heard in time")?;
        let message = message.ok_or_else(|| Status::ok("the session ended"))?;
        Ok(message.message.unwrap())
    }

    pub async fn credit(&self, leases: u32) {
        self.say(Say::Credit(wire::Credit { leases })).await;
    }

    /// Requests one lease and waits for it.
    pub async fn lease(&mut self) -> Lease {
        self.credit(1).await;
        match self.hear().await.unwrap() {
            Heard::Lease(lease) => lease.try_into().unwrap(),
            other => panic!("expected a lease, heard {other:?}"),
        }
    }

    /// Reports a task without waiting for an answer.
    pub async fn say_done(&mut self, lease: &Lease, index: u64, manifest: &str) {
        let done = wire::TaskDone {
            lease: Some(lease.lease.into()),
            index,
            task_key: task_key(&lease.key, index).to_string(),
            manifest_sha256: manifest.into(),
            bytes: 100,
            seconds: 2.0,
            adopted: false,
            traceparent: String::new(),
            shared: self.share,
        };
        self.say(Say::Done(done)).await;
    }

    pub async fn report(&mut self, lease: &Lease, index: u64, manifest: &str) -> wire::Acknowledge {
        self.say_done(lease, index, manifest).await;
        self.acknowledged().await
    }

    pub async fn done(&mut self, lease: &Lease, index: u64) -> wire::Acknowledge {
        self.report(lease, index, &manifest(index)).await
    }

    pub async fn fail(&mut self, lease: &Lease, index: u64, kind: wire::FailureKind) {
        self.say(Say::Failed(wire::TaskFailed {
            lease: Some(lease.lease.into()),
            index,
            kind: kind.into(),
            message: "no such mesh".into(),
            damaged: false,
            milliseconds: 3_000,
            shared: 0,
        }))
        .await;
        assert!(self.acknowledged().await.accepted);
    }

    pub async fn release(&mut self, lease: &Lease) -> wire::Acknowledge {
        self.say(Say::Release(wire::Release {
            lease: Some(lease.lease.into()),
            reason: "shutdown".into(),
        }))
        .await;
        self.acknowledged().await
    }

    /// Sends a heartbeat with leases and the running task. Returns the live leases.
    pub async fn beat(&mut self, leases: &[&Lease], in_hand: Option<u64>) -> Vec<wire::LeaseRef> {
        self.say(Say::Heartbeat(wire::Heartbeat {
            leases: leases.iter().map(|l| l.lease.into()).collect(),
            progress: in_hand
                .map(|index| wire::TaskProgress {
                    lease: Some(leases[0].lease.into()),
                    index,
                    fraction: 0.5,
                    ..wire::TaskProgress::default()
                })
                .into_iter()
                .collect(),
            ends_in_ms: 0,
        }))
        .await;
        match self.hear().await.unwrap() {
            Heard::Renewed(renewed) => renewed.leases,
            other => panic!("expected renewed, heard {other:?}"),
        }
    }

    pub async fn acknowledged(&mut self) -> wire::Acknowledge {
        loop {
            match self.hear().await.unwrap() {
                Heard::Acknowledge(ack) => return ack,
                Heard::Revoke(_) => {}
                other => panic!("expected an acknowledgement, heard {other:?}"),
            }
        }
    }

    pub async fn revoked(&mut self) -> wire::Revoke {
        match self.hear().await.unwrap() {
            Heard::Revoke(revoke) => revoke,
            other => panic!("expected a revoke, heard {other:?}"),
        }
    }

    /// Works honestly until the job has ended.
    pub async fn work(&mut self, farm: &mut Farm, job: &str) -> JobStatus {
        loop {
            let status = farm.status(job).await;
            if status.state != JobState::Active {
                return status;
            }
            if status.tasks.pending == 0 {
                tokio::time::sleep(Duration::from_millis(5)).await;
                continue;
            }
            let lease = self.lease().await;
            for index in lease.lo..lease.hi {
                assert!(self.done(&lease, index).await.accepted);
            }
        }
    }
}

pub fn catalog_of(farm: &Farm) -> CatalogPlace {
    farm.catalog.clone()
}
