//! A lease begins a trace at the coordinator, which continues in the worker and returns with the
//! reports.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use opentelemetry_proto::tonic::{
    collector::trace::v1::{
        ExportTraceServiceRequest, ExportTraceServiceResponse,
        trace_service_server::{TraceService, TraceServiceServer},
    },
    common::v1::any_value::Value,
    trace::v1::Span,
};
use picofarm_tests::{Cli, Job, Scratch, Signal, wait::until};
use tokio::{net::TcpListener, runtime::Runtime};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, transport::Server};

/// Spans with the name of the service that sent them.
type Spans = Vec<(String, Span)>;

/// A stand-in for an OpenTelemetry collector.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Spans>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let mut spans = self.0.lock().unwrap();
        for of_process in request.into_inner().resource_spans {
            let resource = of_process.resource.unwrap();
            let name = resource.attributes.iter().find(|a| a.key == "service.name");
            let name = name.and_then(|a| a.value.as_ref()?.value.clone());
            let Some(Value::StringValue(service)) = name else {
                panic!("a process says what it is")
            };
            let found = of_process.scope_spans.into_iter().flat_map(|s| s.spans);
            spans.extend(found.map(|span| (service.clone(), span)));
        }
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

/// Returns the spans that a collector has received of a job of two scenes when the processes have
/// ended.
fn heard(name: &str, of_coordinator: &[(&str, &str)]) -> Spans {
    let runtime = Runtime::new().unwrap();
    let collector = Collector::default();
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
    let collects = format!("http://{}", listener.local_addr().unwrap());
    let service = TraceServiceServer::new(collector.clone());
    runtime.spawn(
        Server::builder()
            .add_service(service)
            .serve_with_incoming(TcpListenerStream::new(listener)),
    );

    let scratch = Scratch::new(name);
    let cli = Cli::new(scratch.path());
    // The coordinator's collector is set by the variable, the worker's by the option.
    let mut said = cli.clone().with("OTEL_EXPORTER_OTLP_ENDPOINT", &collects);
    for (name, value) in of_coordinator {
        said = said.with(name, value);
    }
    let listen = ["--listen", "127.0.0.1:0", "--json"];
    let args = ["coordinator", "--allow-insecure"];
    let mut coordinator = said.start("coordinator", &[&args[..], &listen].concat());
    let line: serde_json::Value = serde_json::from_str(&coordinator.first_line()).unwrap();
    let cli = cli.with(
        "PICOFARM_COORDINATOR",
        line["coordinator"].as_str().unwrap(),
    );
    let args = ["worker", "--threads", "1", "--otlp", &collects];
    let mut worker = cli.start("worker", &args);

    let file = scratch.join("job.toml");
    Job::quick(&scratch.join("store"), 2).write(&file);
    let submitted = cli.json(&["job", "submit", &file.display().to_string()]);
    let job = submitted["job"].as_str().unwrap().to_owned();
    until("the job to end", || {
        (cli.json(&["job", "status", &job])["state"] == "done").then_some(())
    });
    worker.signal(Signal::Terminate);
    worker.end().ok();
    coordinator.signal(Signal::Terminate);
    coordinator.end().ok();
    collector.0.lock().unwrap().clone()
}

#[test]
fn a_task_can_be_followed_from_its_grant_through_its_worker_to_its_commit() {
    let spans = heard("traces", &[]);
    let by_id: BTreeMap<_, _> = spans.iter().map(|(_, s)| (&s.span_id, s)).collect();
    let mut found = BTreeMap::new();
    for (service, span) in &spans {
        let parent = by_id.get(&span.parent_span_id);
        if let Some(parent) = parent {
            assert_eq!(parent.trace_id, span.trace_id, "{span:?}");
            assert!(parent.start_time_unix_nano <= span.start_time_unix_nano);
        }
        let parent = parent.map(|parent| &*parent.name);
        assert!(
            parent.is_some() || span.parent_span_id.is_empty(),
            "its parent was never sent: {span:?}"
        );
        let place = (&**service, &*span.name, parent);
        *found.entry(place).or_insert(0) += 1;
    }
    let (ours, theirs) = ("picofarm-coordinator", "picofarm-worker");
    let grants = found.remove(&(ours, "grant", None)).unwrap_or(0);
    assert!((1..=2).contains(&grants), "{found:?}");
    let expected = [
        ((ours, "commit", Some("task")), 2),
        ((theirs, "encode", Some("task")), 2),
        ((theirs, "publish", Some("task")), 2),
        ((theirs, "render", Some("task")), 2),
        ((theirs, "scene", Some("task")), 2),
        ((theirs, "task", Some("grant")), 2),
    ];
    assert_eq!(found, BTreeMap::from(expected));
}

#[test]
fn traces_that_the_coordinator_leaves_out_are_left_out_by_the_worker_too() {
    let spans = heard("no-traces", &[("OTEL_TRACES_SAMPLER_ARG", "0")]);
    assert!(spans.is_empty(), "{spans:?}");
}

#[test]
fn a_collector_that_cannot_be_is_named_and_one_that_is_away_does_no_harm() {
    let scratch = Scratch::new("bad-otlp");
    let cli = Cli::new(scratch.path());
    cli.run(&["worker", "--otlp", "http://no host"])
        .fails(3, &["--otlp"]);
    cli.clone()
        .with("OTEL_TRACES_SAMPLER_ARG", "half")
        .run(&["worker", "--otlp", "http://127.0.0.1:1"])
        .fails(3, &["OTEL_TRACES_SAMPLER_ARG"]);
    let args = ["coordinator", "--allow-insecure", "--json"];
    let more = ["--listen", "127.0.0.1:0", "--otlp", "http://127.0.0.1:1"];
    let mut coordinator = cli.start("coordinator", &[&args[..], &more].concat());
    coordinator.first_line();
    coordinator.signal(Signal::Terminate);
    coordinator.end().ok();
}
