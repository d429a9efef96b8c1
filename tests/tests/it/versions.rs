//! A coordinator serves workers of the previous minor version. Other versions are refused with a
//! remedy.

use std::time::Duration;

use picofarm_proto::{
    PROTOCOL,
    wire::{
        self, SessionRequest, SessionResponse,
        farm_client::FarmClient,
        farm_server::{Farm as FarmService, FarmServer},
        session_request::Message as Said,
        session_response::Message as Answer,
    },
};
use picofarm_tests::{Cli, Farm, Job, Scratch, store, wait::until};
use tokio::net::TcpListener;
use tokio_stream::{
    StreamExt,
    wrappers::{ReceiverStream, TcpListenerStream},
};
use tonic::{Code, Request, Response, Status, Streaming, transport::Server};

const VERSION: &str = env!("CARGO_PKG_VERSION");
const PATIENCE: Duration = Duration::from_secs(30);

fn hello(version: &str, protocol: u32) -> wire::Hello {
    wire::Hello {
        worker_id: uuid::Uuid::new_v4().to_string(),
        incarnation: uuid::Uuid::new_v4().to_string(),
        name: "stranger".into(),
        version: version.into(),
        protocol,
        cores: 1,
        held: Vec::new(),
        ended: String::new(),
        ends_in_ms: 0,
        kinds: [("render".to_owned(), "transient-0".to_owned())].into(),
        assets: Vec::new(),
        memory_mib: 0,
        gpus: Vec::new(),
        labels: Vec::new(),
    }
}

/// Sends a hello and returns the first answer.
async fn greet(url: &str, hello: wire::Hello) -> Result<Option<SessionResponse>, Status> {
    let mut client = FarmClient::connect(url.to_owned())
        .await
        .expect("the coordinator listens");
    let (to, requests) = tokio::sync::mpsc::channel(1);
    to.send(SessionRequest {
        message: Some(Said::Hello(hello)),
    })
    .await
    .expect("just made");
    let answer = async {
        let mut answers = client
            .session(ReceiverStream::new(requests))
            .await?
            .into_inner();
        answers.message().await
    };
    let answer = tokio::time::timeout(PATIENCE, answer)
        .await
        .expect("an answer");
    drop(to);
    answer
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_coordinator_refuses_a_worker_of_another_version_and_names_both() {
    let farm = tokio::task::spawn_blocking(|| Farm::start("other-worker"))
        .await
        .unwrap();
    let refusal = greet(farm.url(), hello("9.9.9", PROTOCOL + 1))
        .await
        .unwrap_err();
    assert_eq!(refusal.code(), Code::FailedPrecondition, "{refusal}");
    let words = refusal.message();
    for part in [PROTOCOL, PROTOCOL + 1] {
        assert!(words.contains(&part.to_string()), "{words}");
    }
    assert!(words.contains("upgrade the coordinator first"), "{words}");

    let mut nameless = hello(VERSION, PROTOCOL);
    nameless.worker_id = "nobody".into();
    let refusal = greet(farm.url(), nameless).await.unwrap_err();
    assert_eq!(refusal.code(), Code::InvalidArgument, "{refusal}");
    assert!(refusal.message().contains("worker_id"), "{refusal}");
    tokio::task::spawn_blocking(move || farm.json(&["job", "list"]))
        .await
        .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_with_another_renderer_gets_nothing_and_the_job_says_why() {
    let (farm, id) = tokio::task::spawn_blocking(|| {
        let farm = Farm::start("other-renderer");
        let id = farm.submit(&Job::quick(&farm.store(), 1));
        (farm, id)
    })
    .await
    .unwrap();
    let mut client = FarmClient::connect(farm.url().to_owned()).await.unwrap();
    let (to, requests) = tokio::sync::mpsc::channel(2);
    let say = async |message| {
        to.send(SessionRequest {
            message: Some(message),
        })
        .await
        .unwrap()
    };
    say(Said::Hello(hello(VERSION, PROTOCOL))).await;
    let mut answers = client
        .session(ReceiverStream::new(requests))
        .await
        .unwrap()
        .into_inner();
    let welcome = answers.message().await.unwrap().unwrap();
    assert!(
        matches!(welcome.message, Some(Answer::Welcome(_))),
        "{welcome:?}"
    );
    say(Said::Credit(wire::Credit { leases: 1 })).await;
    tokio::task::spawn_blocking(move || {
        let waiting = until("the job to say why it waits", || {
            farm.events_of(&id, "waiting").pop()
        });
        let message = waiting["message"].as_str().unwrap();
        assert!(
            message.contains("renderer") && message.contains("transient-0"),
            "{message}"
        );
        assert_eq!(waiting["worker"], "stranger");
        assert_eq!(farm.count(&id, "pending"), 1);
    })
    .await
    .unwrap();
}

struct Refusing;

#[tonic::async_trait]
impl FarmService for Refusing {
    type SessionStream = ReceiverStream<Result<SessionResponse, Status>>;

    async fn session(
        &self,
        _: Request<Streaming<SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        Err(Status::failed_precondition(
            "this coordinator speaks protocol 77",
        ))
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_refused_for_its_version_exits_with_4_and_says_what_to_do() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let server = tokio::spawn(
        Server::builder()
            .add_service(FarmServer::new(Refusing))
            .serve_with_incoming(TcpListenerStream::new(listener)),
    );
    let asked = url.clone();
    tokio::task::spawn_blocking(move || {
        let scratch = Scratch::new("refused-worker");
        let cli = Cli::new(scratch.path());
        cli.run(&["worker", "--coordinator", &asked]).fails(
            4,
            &[
                "this coordinator speaks protocol 77",
                &asked,
                "hint: compare `picofarm --version`",
            ],
        );
    })
    .await
    .unwrap();
    server.abort();
}

/// Relays between a worker and its coordinator, and reports another version of the worker.
struct Relay {
    coordinator: String,
    version: String,
}

#[tonic::async_trait]
impl FarmService for Relay {
    type SessionStream = Streaming<SessionResponse>;

    async fn session(
        &self,
        request: Request<Streaming<SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let mut client = FarmClient::connect(self.coordinator.clone())
            .await
            .map_err(|e| Status::unavailable(e.to_string()))?;
        let version = self.version.clone();
        let requests = request.into_inner().map_while(move |said| {
            let mut said = said.ok()?;
            if let Some(Said::Hello(hello)) = &mut said.message {
                hello.version.clone_from(&version);
            }
            Some(said)
        });
        client.session(requests).await
    }
}

/// Returns this version with another minor number.
fn with_minor(change: impl Fn(u64) -> u64) -> String {
    let mut numbers = VERSION.split('.').map(|n| n.parse::<u64>().unwrap());
    let (major, minor) = (numbers.next().unwrap(), numbers.next().unwrap());
    format!("{major}.{}.9", change(minor))
}

/// Serves a relay to `coordinator` and returns its URL.
async fn relay(coordinator: &str, version: String) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let relay = Relay {
        coordinator: coordinator.to_owned(),
        version,
    };
    tokio::spawn(
        Server::builder()
            .add_service(FarmServer::new(relay))
            .serve_with_incoming(TcpListenerStream::new(listener)),
    );
    url
}

/// Runs a job on a farm with a worker that reports this version. Returns the hashes of the objects.
async fn hashes_by(
    name: &'static str,
    version: String,
) -> std::collections::BTreeMap<String, String> {
    let farm = tokio::task::spawn_blocking(move || Farm::start(name))
        .await
        .unwrap();
    let url = relay(farm.url(), version).await;
    tokio::task::spawn_blocking(move || {
        let job = Job::quick(&farm.store(), 2);
        let id = farm.submit(&job);
        let args = [
            "worker",
            "--name",
            name,
            "--threads",
            "1",
            "--coordinator",
            &url,
        ];
        let worker = farm.cli().start(name, &args);
        farm.until_done_once(&job, &id);
        worker.kill();
        store::hashes(&job.place())
    })
    .await
    .unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_of_the_previous_minor_version_makes_the_same_bytes() {
    let before = hashes_by(
        "previous-version",
        with_minor(|minor| minor.saturating_sub(1)),
    )
    .await;
    let same = hashes_by("same-version", VERSION.to_owned()).await;
    assert!(!same.is_empty());
    assert_eq!(before, same);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_is_newer_than_its_coordinator_exits_and_says_what_to_upgrade() {
    let farm = tokio::task::spawn_blocking(|| Farm::start("newer-worker"))
        .await
        .unwrap();
    let newer = with_minor(|minor| minor + 1);
    let url = relay(farm.url(), newer.clone()).await;
    tokio::task::spawn_blocking(move || {
        let args = ["worker", "--coordinator", &url];
        farm.cli()
            .run(&args)
            .fails(4, &["upgrade the coordinator first", &newer]);
    })
    .await
    .unwrap();
}
