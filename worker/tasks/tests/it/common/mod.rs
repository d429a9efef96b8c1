//! A scripted coordinator, reached over real gRPC on a loopback port, and a scripted executor.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::{collections::BTreeMap, net::SocketAddr, sync::Arc, time::Duration};

use picofarm_proto::{
    ids::{Epoch, JobId, LeaseRef, RangeId},
    key::stage_key,
    messages::{Check, Examine, Lease, Verdict},
    spec::{
        Budget, OutputSettings, RenderSettings, RenderTask, SceneKind, SceneSource, StageSpec,
        TaskSpec,
    },
    wire::{
        self, SessionRequest, SessionResponse,
        farm_server::{Farm, FarmServer},
        session_request::Message as Said,
        session_response::Message as Answer,
    },
};
use picofarm_settings::{PrimitiveRooms, Resolution, Spots};
use picofarm_tasks::{
    AgentConfig, AgentError, Control, Executor, Output, Summary, Task, TaskError,
};
use picofarm_tests::ports::lasting;
use tokio::{net::TcpListener, sync::mpsc, task::JoinHandle};
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming, transport::Server};
use uuid::Uuid;

/// Timeout of every wait. No passing test comes near it; it only stops a broken test from hanging.
const PATIENCE: Duration = Duration::from_secs(120);

/// Waits for `what`, with a timeout.
pub async fn soon<T>(what: &str, future: impl Future<Output = T>) -> T {
    match tokio::time::timeout(PATIENCE, future).await {
        Ok(value) => value,
        Err(_) => panic!("{what}: nothing came within {PATIENCE:?}"),
    }
}

/// Waits until `holds` returns true.
pub async fn until(what: &str, holds: impl Fn() -> bool) {
    soon(what, async {
        while !holds() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

struct Door(mpsc::UnboundedSender<Conversation>);

#[tonic::async_trait]
impl Farm for Door {
    type SessionStream = ReceiverStream<Result<SessionResponse, Status>>;

    async fn session(
        &self,
        request: Request<Streaming<SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (to, from) = mpsc::channel(64);
        let conversation = Conversation {
            from_worker: request.into_inner(),
            to_worker: to,
            credit: 0,
            fractions: Vec::new(),
            released: Vec::new(),
            held: Vec::new(),
            beats: 0,
            renew: true,
        };
        let _ = self.0.send(conversation);
        Ok(Response::new(ReceiverStream::new(from)))
    }
}

/// The scripted coordinator.
pub struct FakeFarm {
    pub address: SocketAddr,
    server: JoinHandle<()>,
    sessions: mpsc::UnboundedReceiver<Conversation>,
}

impl FakeFarm {
    pub async fn start() -> Self {
        Self::start_at(([127, 0, 0, 1], lasting()).into()).await
    }

    pub async fn start_at(address: SocketAddr) -> Self {
        let listener = TcpListener::bind(address).await.unwrap();
        let address = listener.local_addr().unwrap();
        let (sender, sessions) = mpsc::unbounded_channel();
        let server = tokio::spawn(async move {
            Server::builder()
                .add_service(FarmServer::new(Door(sender)))
                .serve_with_incoming(TcpListenerStream::new(listener))
                .await
                .unwrap();
        });
        Self {
            address,
            server,
            sessions,
        }
    }

    /// Stops listening. Open conversations end when they are dropped.
    pub async fn stop(self) -> SocketAddr {
        self.server.abort();
        let _ = self.server.await;
        self.address
    }

    /// Accepts the next session and reads its hello, without an answer.
    pub async fn meet(&mut self) -> (Conversation, wire::Hello) {
        let mut c = soon("a session", self.sessions.recv()).await.unwrap();
        let hello = match soon("hello", c.from_worker.message()).await {
            Ok(Some(SessionRequest {
                message: Some(Said::Hello(hello)),
            })) => hello,
            other => panic!("expected a hello first, got {other:?}"),
        };
        (c, hello)
    }

    /// Accepts the next session and welcomes it, with heartbeats every 50 ms and leases of
    /// `lease_ms`.
    pub async fn welcome(&mut self, lease_ms: u32) -> (Conversation, wire::Hello) {
        let (c, hello) = self.meet().await;
        c.say(Answer::Welcome(wire::Welcome {
            coordinator_version: "fake".into(),
            heartbeat_ms: 50,
            lease_ms,
        }))
        .await;
        (c, hello)
    }
}

/// A session from the coordinator's side.
pub struct Conversation {
    from_worker: Streaming<SessionRequest>,
    to_worker: mpsc::Sender<Result<SessionResponse, Status>>,
    /// Number of leases that the worker asked for.
    pub credit: u32,
    /// Reported progress, in order.
    pub fractions: Vec<f32>,
    /// Leases that answers to heartbeats omit.
    pub released: Vec<wire::LeaseRef>,
    /// Leases in the latest heartbeat.
    pub held: Vec<wire::LeaseRef>,
    /// Number of received heartbeats.
    pub beats: u32,
    /// Whether heartbeats are answered.
    pub renew: bool,
}

impl Conversation {
    pub async fn say(&self, message: Answer) {
        let _ = self
            .to_worker
            .send(Ok(SessionResponse {
                message: Some(message),
            }))
            .await;
    }

    pub async fn refuse(&self, status: Status) {
        let _ = self.to_worker.send(Err(status)).await;
    }

    /// Returns the next message other than credit and heartbeats, answering heartbeats in the
    /// meantime. `None` if the worker has closed the session.
    pub async fn next(&mut self) -> Option<Said> {
        soon("a message from the worker", async {
            loop {
                let message = self.from_worker.message().await.ok()??;
                match message.message.expect("workers send no empty messages") {
                    Said::Credit(c) => self.credit += c.leases,
                    Said::Heartbeat(h) => self.answer(h).await,
                    other => return Some(other),
                }
            }
        })
        .await
    }

    async fn answer(&mut self, heartbeat: wire::Heartbeat) {
        self.fractions
            .extend(heartbeat.progress.iter().map(|p| p.fraction));
        self.beats += 1;
        self.held = heartbeat.leases.clone();
        if self.renew {
            let leases = heartbeat.leases.into_iter();
            self.say(Answer::Renewed(wire::Renewed {
                leases: leases.filter(|l| !self.released.contains(l)).collect(),
                ttl_ms: 60_000,
            }))
            .await;
        }
    }

    /// Reads messages until `enough` returns true, answering heartbeats. Any other message fails
    /// the test.
    pub async fn listen_until(&mut self, what: &str, enough: impl Fn(&Self) -> bool) {
        soon(what, async {
            while !enough(self) {
                let message = self.from_worker.message().await.unwrap().expect(what);
                match message.message.unwrap() {
                    Said::Credit(c) => self.credit += c.leases,
                    Said::Heartbeat(h) => self.answer(h).await,
                    other => panic!("{what}: did not expect {other:?}"),
                }
            }
        })
        .await;
    }

    pub async fn grant(&self, lease: Lease) {
        self.say(Answer::Lease(lease.into())).await;
    }

    pub async fn done(&mut self) -> wire::TaskDone {
        match self.next().await {
            Some(Said::Done(done)) => done,
            other => panic!("expected a finished task, got {other:?}"),
        }
    }

    pub async fn failed(&mut self) -> wire::TaskFailed {
        match self.next().await {
            Some(Said::Failed(failed)) => failed,
            other => panic!("expected a failed task, got {other:?}"),
        }
    }

    pub async fn release(&mut self) -> wire::Release {
        match self.next().await {
            Some(Said::Release(release)) => release,
            other => panic!("expected a release, got {other:?}"),
        }
    }

    pub async fn acknowledge(&self, lease: Option<wire::LeaseRef>, index: u64) {
        self.say(Answer::Acknowledge(wire::Acknowledge {
            lease,
            index,
            accepted: true,
            reason: String::new(),
        }))
        .await;
    }
}

/// A small job of primitive scenes with results in `store`.
pub fn spec(store: &str) -> RenderTask {
    RenderTask {
        parts: 1,
        scenes: SceneSource {
            kind: SceneKind::Primitive {
                rooms: PrimitiveRooms::LIVING,
            },
            count: 100,
            seed: 7,
            fov_deg: Some(90.0),
            spots: Spots::Grid(1),
            laser_m: [0.0; 3],
        },
        render: RenderSettings {
            resolution: Resolution::square(16),
            gate_start_m: 0.0,
            bin_width_m: 0.5,
            bins: 40,
            budget: Budget::Samples(2),
            max_bounces: 2,
            renderer: picofarm_tasks::renderer_version(),
            ..RenderSettings::default()
        },
        output: OutputSettings {
            store: store.into(),
            dataset: "tiny".into(),
            profile: "sqrt-u16".into(),
        },
    }
}

/// A stage of that job.
pub fn stage(spec: RenderTask) -> StageSpec {
    StageSpec::new(TaskSpec::Render(spec))
}

/// Tasks `lo..hi` of a job under `epoch`.
pub fn lease(epoch: u64, lo: u64, hi: u64) -> Lease {
    Lease {
        lease: LeaseRef {
            range: RangeId::from_uuid(Uuid::from_u128(0xA0 + u128::from(epoch))),
            epoch: Epoch(epoch),
        },
        job: JobId::from_uuid(Uuid::from_u128(0x10B)),
        lo,
        hi,
        skip: Vec::new(),
        ttl_ms: 60_000,
        key: stage_key(&stage(spec("/nowhere"))),
        stage: stage(spec("/nowhere")),
        ordinal: 0,
        traceparent: String::new(),
    }
}

type Work = dyn Fn(&Task, &Control) -> Result<Output, TaskError> + Send + Sync;

/// Executor that does what the test specifies and reports which tasks were started.
pub struct FakeExecutor {
    work: Box<Work>,
    started: mpsc::UnboundedSender<u64>,
}

impl Executor for FakeExecutor {
    fn kinds(&self) -> BTreeMap<String, String> {
        [("render".to_owned(), "fake-1".to_owned())].into()
    }

    fn assets(&self) -> Vec<String> {
        vec!["parametric-1".into()]
    }

    fn examine(&self, what: &Examine) -> Vec<Check> {
        let detail = format!("store {:?}, scenes {:?}", what.store, what.scenes);
        vec![Check::new("places", Verdict::Ok, detail)]
    }

    fn run(&self, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let _ = self.started.send(task.index);
        (self.work)(task, control)
    }
}

/// The output of a correct executor.
pub fn output(task: &Task) -> Output {
    Output {
        manifest_sha256: task.key().to_string(),
        bytes: 1000 + task.index,
        adopted: false,
    }
}

/// A worker under test.
pub struct Worker {
    pub started: mpsc::UnboundedReceiver<u64>,
    pub shutdown: CancellationToken,
    life: JoinHandle<Result<Summary, AgentError>>,
}

impl Worker {
    pub fn start(
        address: SocketAddr,
        work: impl Fn(&Task, &Control) -> Result<Output, TaskError> + Send + Sync + 'static,
    ) -> Self {
        Self::start_with(config(address), work)
    }

    pub fn start_with(
        config: AgentConfig,
        work: impl Fn(&Task, &Control) -> Result<Output, TaskError> + Send + Sync + 'static,
    ) -> Self {
        let (sender, started) = mpsc::unbounded_channel();
        let executor = FakeExecutor {
            work: Box::new(work),
            started: sender,
        };
        let shutdown = CancellationToken::new();
        let life = tokio::spawn(picofarm_tasks::run_with(
            config,
            Arc::new(executor),
            shutdown.clone(),
        ));
        Self {
            started,
            shutdown,
            life,
        }
    }

    /// Waits until the worker has ended.
    pub async fn end(self) -> Result<Summary, AgentError> {
        soon("the worker's end", self.life).await.unwrap()
    }

    pub async fn starts(&mut self) -> u64 {
        soon("a task to start", self.started.recv()).await.unwrap()
    }
}

/// Settings of a worker with one thread.
pub fn config(address: SocketAddr) -> AgentConfig {
    AgentConfig {
        coordinator: format!("http://{address}"),
        name: "tester".into(),
        worker_id: None,
        ended: String::new(),
        threads: 1,
        memory_mib: 4096,
        memory_from: String::new(),
        gpus: Default::default(),
        peers: "127.0.0.1".into(),
        labels: Vec::new(),
        exit_idle: None,
        ends_at: None,
        asset_dirs: Vec::new(),
        python: None,
        python_environments: None,
        access: Default::default(),
        store_prefixes: Vec::new(),
    }
}

/// Blocks an executor's task until the test opens the gate or the task is asked to stop.
#[derive(Clone)]
pub struct Gate(pub CancellationToken);

impl Gate {
    pub fn new() -> Self {
        Self(CancellationToken::new())
    }

    /// Waits for the gate. Returns `Err` if the task is asked to stop first.
    pub fn pass(&self, control: &Control) -> Result<(), TaskError> {
        while !self.0.is_cancelled() {
            if control.stopped() {
                return Err(TaskError::Stopped);
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(())
    }

    pub fn open(&self) {
        self.0.cancel();
    }
}
