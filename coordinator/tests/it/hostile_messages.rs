//! Whatever messages arrive, a coordinator does not panic or grow, and continues to serve honest
//! clients. `PICOFARM_FUZZ=n` runs n times as many cases.

use std::{
    sync::atomic::{AtomicUsize, Ordering},
    time::Duration,
};

use picofarm_coordinator::{CoordinatorConfig, Running, VERSION, serve};
use picofarm_database::CatalogPlace;
use picofarm_proto::{
    PROTOCOL,
    spec::{JobSpec, RenderTask, TaskSpec},
    wire::{
        self, farm_client::FarmClient, jobs_client::JobsClient, session_request::Message as Say,
        session_response::Message as Heard,
    },
};
use proptest::{
    collection::vec,
    prelude::*,
    strategy::ValueTree,
    test_runner::{Config, TestRunner},
};
use tokio_stream::StreamExt;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use uuid::Uuid;

/// Panics of any thread, including caught ones.
static PANICS: AtomicUsize = AtomicUsize::new(0);

/// Returns the number of cases, given the number that takes a few seconds.
fn cases(short: u32) -> u32 {
    let times = std::env::var("PICOFARM_FUZZ").map_or(1, |n| n.parse().expect("a number"));
    short * times
}

struct Server {
    _folder: tempfile::TempDir,
    _running: Running,
    channel: Channel,
}

impl Server {
    async fn start() -> Self {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            PANICS.fetch_add(1, Ordering::SeqCst);
            before(panic);
        }));
        let folder = tempfile::tempdir().unwrap();
        let listen = "127.0.0.1:0".parse().unwrap();
        let config =
            CoordinatorConfig::new(CatalogPlace::from(folder.path().join("catalog.db")), listen);
        let running = serve(config, CancellationToken::new()).await.unwrap();
        let url = format!("http://{}", running.address);
        Self {
            _folder: folder,
            _running: running,
            channel: Channel::from_shared(url).unwrap().connect().await.unwrap(),
        }
    }

    fn jobs(&self) -> JobsClient<Channel> {
        JobsClient::new(self.channel.clone())
    }

    /// Runs one session that sends all these messages. It ends when the coordinator ends it or has
    /// received enough.
    async fn session(&self, said: Vec<wire::SessionRequest>) {
        let mut client = FarmClient::new(self.channel.clone());
        let said = tokio_stream::iter(said);
        if let Ok(answer) = client.session(said).await {
            let mut heard = answer.into_inner();
            let enough = Duration::from_secs(10);
            while let Ok(Ok(Some(_))) = tokio::time::timeout(enough, heard.message()).await {}
        }
    }

    /// Runs a job from submission to end with an honest worker.
    async fn serves(&self) {
        let mut jobs = self.jobs();
        let mut spec = good();
        spec.name = Uuid::new_v4().to_string();
        let spec_name = spec.name.clone();
        rendering(&mut spec).output.dataset = spec_name;
        let request = wire::SubmitJobRequest {
            spec: Some(spec.into()),
            again: false,
        };
        let job = jobs.submit_job(request).await.unwrap().into_inner().job_id;
        let hello = hello(Uuid::new_v4().to_string());
        let (say, said) = tokio::sync::mpsc::channel(8);
        for message in [Say::Hello(hello), Say::Credit(wire::Credit { leases: 1 })] {
            say.send(request_of(message)).await.unwrap();
        }
        let said = tokio_stream::wrappers::ReceiverStream::new(said);
        let mut client = FarmClient::new(self.channel.clone());
        let mut heard = client.session(said).await.unwrap().into_inner();
        let lease = loop {
            let message = tokio::time::timeout(Duration::from_secs(20), heard.next()).await;
            let message = message.expect("a lease in time").unwrap().unwrap();
            if let Some(Heard::Lease(lease)) = message.message {
                break lease;
            }
        };
        assert_eq!(lease.job_id, job);
        let cancel = wire::CancelJobRequest { job_id: job };
        jobs.cancel_job(cancel).await.unwrap();
    }

    /// Returns the known jobs and the connected workers.
    async fn held(&self) -> (usize, u32) {
        let mut jobs = self.jobs();
        let list = jobs
            .list_jobs(wire::ListJobsRequest {
                page_size: 1_000,
                ..Default::default()
            })
            .await
            .unwrap();
        let info = jobs
            .get_server_info(wire::GetServerInfoRequest {})
            .await
            .unwrap();
        (list.into_inner().jobs.len(), info.into_inner().workers)
    }

    async fn settles_at(&self, held: (usize, u32)) {
        for _ in 0..2_000 {
            if self.held().await == held {
                return;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        assert_eq!(self.held().await, held);
    }
}

fn request_of(message: Say) -> wire::SessionRequest {
    wire::SessionRequest {
        message: Some(message),
    }
}

/// Returns a valid job.
fn good() -> JobSpec {
    serde_json::from_str(
        r#"{"name": "good", "scenes": {"kind": "primitive", "count": 3},
            "render": {"renderer": "r1"},
            "output": {"store": "file:///nowhere", "dataset": "d", "profile": "sqrt-u16"}}"#,
    )
    .unwrap()
}

fn rendering(spec: &mut JobSpec) -> &mut RenderTask {
    match &mut spec.stages[0].task {
        TaskSpec::Render(task) => task,
        other => panic!("{other:?}"),
    }
}

/// Returns two stages; the second needs the first.
fn graph() -> JobSpec {
    serde_json::from_str(
        r#"{"name": "graph", "priority": 3, "limits": {"max_workers": 2, "deadline": "2030-01-01T00:00:00Z"}, "stage": [
            {"scenes": {"kind": "primitive", "count": 3}, "render": {"renderer": "r1"},
             "output": {"store": "file:///nowhere", "dataset": "g"}, "resources": {"cores": 2, "labels": ["x"]}},
            {"kind": "reprocess", "source": "render", "reprocess": {"version": "s", "sensor": {"dark_per_bin": 0.1}},
             "output": {"store": "file:///nowhere", "dataset": "h"}},
            {"kind": "split", "source": "reprocess", "split": {"fractions": [0.5, 0.25, 0.25]}}]}"#,
    )
    .unwrap()
}

fn hello(id: String) -> wire::Hello {
    wire::Hello {
        worker_id: id,
        incarnation: Uuid::new_v4().to_string(),
        name: "ada".into(),
        version: VERSION.into(),
        protocol: PROTOCOL,
        cores: 1,
        held: Vec::new(),
        ended: String::new(),
        ends_in_ms: 0,
        kinds: [("render".to_owned(), "r1".to_owned())].into(),
        assets: Vec::new(),
        memory_mib: 64 << 10,
        gpus: Vec::new(),
        labels: Vec::new(),
    }
}

// Random messages. Ids come from few values, so that messages refer to one another.

fn id() -> impl Strategy<Value = String> {
    prop_oneof![
        6 => (0..4u128).prop_map(|n| Uuid::from_u128(n).to_string()),
        1 => Just(String::new()),
        1 => any::<u128>().prop_map(|n| Uuid::from_u128(n).to_string()),
        1 => ".{0,40}",
    ]
}

fn number() -> impl Strategy<Value = u64> {
    prop_oneof![
        Just(0),
        0..5u64,
        Just(u64::MAX),
        Just(u64::MAX - 1),
        any::<u64>()
    ]
}

fn small() -> impl Strategy<Value = u32> {
    prop_oneof![Just(0), 0..5u32, Just(u32::MAX), any::<u32>()]
}

fn lease() -> impl Strategy<Value = Option<wire::LeaseRef>> {
    let lease = (id(), number()).prop_map(|(range_id, epoch)| wire::LeaseRef { range_id, epoch });
    prop_oneof![1 => Just(None), 9 => lease.prop_map(Some)]
}

fn leases() -> impl Strategy<Value = Vec<wire::LeaseRef>> {
    vec(lease(), 0..6).prop_map(|all| all.into_iter().flatten().collect())
}

fn say() -> impl Strategy<Value = wire::SessionRequest> {
    let hello = (id(), id(), leases()).prop_map(|(worker, incarnation, held)| {
        let mut hello = hello(worker);
        hello.incarnation = incarnation;
        hello.held = held;
        Say::Hello(hello)
    });
    let progress = (lease(), number(), any::<(f32, String, f64)>()).prop_map(
        |(lease, index, (fraction, text, figure))| wire::TaskProgress {
            figures: [(text.clone(), figure)].into(),
            text,
            lease,
            index,
            fraction,
        },
    );
    let beat =
        (leases(), vec(progress, 0..4), number()).prop_map(|(leases, progress, ends_in_ms)| {
            Say::Heartbeat(wire::Heartbeat {
                leases,
                progress,
                ends_in_ms,
            })
        });
    let done = (
        lease(),
        number(),
        "[0-9a-f]{0,64}",
        number(),
        any::<f64>(),
        any::<bool>(),
        ".{0,60}",
    )
        .prop_map(
            |(lease, index, hex, bytes, seconds, adopted, traceparent)| {
                Say::Done(wire::TaskDone {
                    lease,
                    index,
                    task_key: format!("{hex:0>64}"),
                    manifest_sha256: hex,
                    bytes,
                    seconds,
                    adopted,
                    traceparent,
                    shared: 0,
                })
            },
        );
    let failed =
        (lease(), number(), -1..6i32, ".{0,60}").prop_map(|(lease, index, kind, message)| {
            Say::Failed(wire::TaskFailed {
                lease,
                index,
                kind,
                message,
                damaged: index % 2 == 0,
                milliseconds: index,
                shared: u32::MAX,
            })
        });
    let release = (lease(), ".{0,20}")
        .prop_map(|(lease, reason)| Say::Release(wire::Release { lease, reason }));
    let line = (small(), 0..5i32, ".{0,60}").prop_map(|(ago_ms, level, text)| wire::LogLine {
        ago_ms,
        level,
        text,
    });
    let log = (lease(), number(), vec(line, 0..5)).prop_map(|(lease, index, lines)| {
        Say::Log(wire::TaskLog {
            lease,
            index,
            lines,
        })
    });
    let credit = small().prop_map(|leases| Say::Credit(wire::Credit { leases }));
    prop_oneof![hello, beat, done, failed, log, release, credit].prop_map(request_of)
}

fn job() -> impl Strategy<Value = serde_json::Value> {
    let jobs = [good(), graph()].map(|job| serde_json::to_value(job).unwrap());
    prop::sample::select(jobs.to_vec())
}

/// Returns a job with changed bytes in its text, or with exchanged values.
fn spoilt_spec() -> impl Strategy<Value = Option<wire::JobSpec>> {
    let bytes = (
        job(),
        vec((any::<prop::sample::Index>(), any::<u8>()), 1..5),
    )
        .prop_map(|(job, changes)| {
            let mut bytes = job.to_string().into_bytes();
            for (at, byte) in changes {
                let at = at.index(bytes.len());
                bytes[at] = byte;
            }
            String::from_utf8_lossy(&bytes).into_owned()
        });
    let values = (job(), vec((any::<prop::sample::Index>(), value()), 1..3)).prop_map(
        |(mut job, changes)| {
            for (at, value) in changes {
                let mut places = Vec::new();
                leaves(&job, "", &mut places);
                let place = &places[at.index(places.len())];
                *job.pointer_mut(place).expect("just found") = value;
            }
            job.to_string()
        },
    );
    prop_oneof![
        1 => Just(None),
        4 => bytes.prop_map(|json| Some(wire::JobSpec { json })),
        6 => values.prop_map(|json| Some(wire::JobSpec { json })),
    ]
}

/// Returns a value of an unexpected type, or beyond every limit.
fn value() -> impl Strategy<Value = serde_json::Value> {
    use serde_json::json;
    prop_oneof![
        Just(json!(null)),
        Just(json!(u64::MAX)),
        Just(json!(-1)),
        Just(json!(1e300)),
        Just(json!([])),
        Just(json!({})),
        Just(json!("render")),
        Just(json!("../../etc")),
        Just(json!("x".repeat(10_000))),
        Just(json!(vec![0; 5_000])),
        Just(json!({"a": vec![1; 40], "b": vec![1; 40], "c": [1]})),
        any::<u32>().prop_map(|n| json!(n)),
        any::<f64>().prop_map(|n| json!(n)),
        ".{0,20}".prop_map(|text| json!(text)),
    ]
}

/// Collects pointers to all replaceable places in a value.
fn leaves(value: &serde_json::Value, path: &str, found: &mut Vec<String>) {
    match value {
        serde_json::Value::Object(all) if !all.is_empty() => {
            for (name, value) in all {
                leaves(value, &format!("{path}/{name}"), found);
            }
        }
        serde_json::Value::Array(all) if !all.is_empty() => {
            for (at, value) in all.iter().enumerate() {
                leaves(value, &format!("{path}/{at}"), found);
            }
        }
        _ => found.push(path.to_owned()),
    }
}

/// Draws values one by one, because proptest's own loop does not support asynchronous tests.
struct Draws(TestRunner);

impl Draws {
    fn new() -> Self {
        Self(TestRunner::new(Config::default()))
    }

    fn next<T>(&mut self, strategy: &impl Strategy<Value = T>) -> T {
        strategy.new_tree(&mut self.0).unwrap().current()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_on_the_wire_makes_a_coordinator_panic_grow_or_stop_serving() {
    let server = Server::start().await;
    let mut draws = Draws::new();
    server.serves().await;

    for case in 0..cases(150) {
        // A session of random messages; most begin correctly.
        let mut said = draws.next(&vec(say(), 0..40));
        if case % 4 != 0 {
            let id = Uuid::from_u128(u128::from(case % 4)).to_string();
            said.insert(0, request_of(Say::Hello(hello(id))));
        }
        tokio::time::timeout(Duration::from_secs(30), server.session(said))
            .await
            .expect("the session ends");
    }
    server.settles_at((1, 0)).await;

    let mut jobs = server.jobs();
    let mut accepted = 1;
    for _ in 0..cases(150) {
        let spec = draws.next(&spoilt_spec());
        let again = draws.next(&any::<bool>());
        let plan = wire::PlanJobRequest { spec: spec.clone() };
        let planned = jobs.plan_job(plan).await.is_ok();
        let submit = wire::SubmitJobRequest { spec, again };
        if let Ok(answer) = jobs.submit_job(submit).await {
            let answer = answer.into_inner();
            assert!(planned, "what can be submitted can be planned");
            accepted += usize::from(!answer.existed);
            let cancel = wire::CancelJobRequest {
                job_id: answer.job_id,
            };
            jobs.cancel_job(cancel).await.unwrap();
        }
        let id = draws.next(&id());
        let query = wire::ListEventsRequest {
            job_id: id.clone(),
            after: draws.next(&number()),
            limit: draws.next(&small()),
            task: Some(draws.next(&number())),
            newest: draws.next(&small()).is_multiple_of(2),
            logs: draws.next(&any::<bool>()),
            stage: Some(draws.next(&small())),
        };
        // Any answer is acceptable, as long as there is one.
        let _ = jobs.list_events(query).await;
        let _ = jobs
            .explain_job(wire::ExplainJobRequest {
                job_id: id.clone(),
                task: Some(draws.next(&number())),
                stage: draws.next(&small()),
            })
            .await;
        let _ = jobs
            .pause_job(wire::PauseJobRequest { job_id: id.clone() })
            .await;
        let _ = jobs
            .resume_job(wire::ResumeJobRequest { job_id: id.clone() })
            .await;
        let _ = jobs
            .drain_worker(wire::DrainWorkerRequest { worker: id.clone() })
            .await;
        let _ = jobs
            .get_job(wire::GetJobRequest { job_id: id.clone() })
            .await;
        let _ = jobs
            .cancel_job(wire::CancelJobRequest { job_id: id.clone() })
            .await;
        let _ = jobs
            .retry_job(wire::RetryJobRequest { job_id: id.clone() })
            .await;
        let _ = jobs.watch_job(wire::WatchJobRequest { job_id: id }).await;
    }
    server.settles_at((accepted, 0)).await;
    server.serves().await;
    assert_eq!(PANICS.load(Ordering::SeqCst), 0, "somebody panicked");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_beyond_their_limit_are_refused_by_name_and_leave_nothing_behind() {
    let server = Server::start().await;
    let huge = wire::LeaseRef {
        range_id: "x".repeat(1000),
        epoch: 1,
    };
    let mut first = hello(Uuid::new_v4().to_string());
    first.held = vec![huge; 2000];
    let mut client = FarmClient::new(server.channel.clone());
    let said = tokio_stream::iter([request_of(Say::Hello(first))]);
    let mut heard = client.session(said).await.unwrap().into_inner();
    let refused = heard.message().await.unwrap_err();
    assert_eq!(refused.code(), tonic::Code::OutOfRange, "{refused:?}");

    let mut spec = good();
    rendering(&mut spec).scenes.count = 50_000_000;
    let submit = wire::SubmitJobRequest {
        spec: Some(spec.into()),
        again: false,
    };
    let refused = server.jobs().submit_job(submit).await.unwrap_err();
    assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
    assert!(
        refused.message().contains("--max-tasks-per-job"),
        "{refused:?}"
    );

    let mut climbing = good();
    rendering(&mut climbing).output.store = "file:///data/%2E./etc".into();
    let plan = wire::PlanJobRequest {
        spec: Some(climbing.into()),
    };
    let refused = server.jobs().plan_job(plan).await.unwrap_err();
    assert!(refused.message().contains("output.store"), "{refused:?}");
    server.settles_at((0, 0)).await;
    server.serves().await;
}
