//! Harmful connections to a coordinator: hundreds of silent ones, slow ones, idle ones. Also
//! certificates that change while it runs.

mod memory;
mod monitoring;
mod pages;
mod tls;

use std::{path::Path, time::Duration};

use picofarm_catalog::{AuditQuery, Rights};
use picofarm_coordinator::{Connections, CoordinatorConfig, Running, VERSION, serve};
use picofarm_database::{CatalogPlace, SqliteCatalog};
use picofarm_proto::{
    PROTOCOL,
    wire::{
        self, farm_client::FarmClient, jobs_client::JobsClient, session_request::Message as Say,
        session_response::Message as Heard,
    },
};
use tls::{Authority, authority};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    time::timeout,
};
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use uuid::Uuid;

/// Longer than any successful operation takes, and shorter than the wait of an excluded client.
const PATIENCE: Duration = Duration::from_secs(20);

struct Server {
    running: Running,
    stop: CancellationToken,
}

async fn start(folder: &Path, change: impl FnOnce(&mut CoordinatorConfig)) -> Server {
    let any = "127.0.0.1:0".parse().unwrap();
    let mut config = CoordinatorConfig::new(CatalogPlace::from(folder.join("catalog.sqlite")), any);
    config.http = Some(any);
    change(&mut config);
    let stop = CancellationToken::new();
    let running = serve(config, stop.clone()).await.unwrap();
    Server { running, stop }
}

impl Server {
    /// Returns the body of a page.
    async fn page(&self, path: &str) -> String {
        let whole = async {
            let mut stream = TcpStream::connect(self.running.http.unwrap())
                .await
                .unwrap();
            let request = format!("GET {path} HTTP/1.1\r\n\r\n");
            stream.write_all(request.as_bytes()).await.unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).await.unwrap();
            answer
        };
        let answer = timeout(PATIENCE, whole)
            .await
            .expect("the page comes in time");
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        answer
    }

    async fn silent(&self, count: usize) -> Vec<TcpStream> {
        let mut sockets = Vec::new();
        for _ in 0..count {
            sockets.push(TcpStream::connect(self.running.address).await.unwrap());
        }
        sockets
    }
}

/// Opens a worker's session up to the welcome, and makes a client's call.
async fn works(channel: Channel) {
    let (say, said) = tokio::sync::mpsc::channel(4);
    let hello = wire::Hello {
        worker_id: Uuid::new_v4().to_string(),
        incarnation: Uuid::new_v4().to_string(),
        name: "ada".into(),
        version: VERSION.into(),
        protocol: PROTOCOL,
        ..Default::default()
    };
    let message = Some(Say::Hello(hello));
    say.send(wire::SessionRequest { message }).await.unwrap();
    let said = tokio_stream::wrappers::ReceiverStream::new(said);
    let mut farm = FarmClient::new(channel.clone());
    let session = farm.session(said);
    let session = timeout(PATIENCE, session).await.expect("a session in time");
    let mut heard = session.unwrap().into_inner();
    let first = timeout(PATIENCE, heard.message())
        .await
        .expect("a welcome in time");
    let first = first.unwrap().unwrap().message;
    assert!(matches!(first, Some(Heard::Welcome(_))), "{first:?}");
    let info = wire::GetServerInfoRequest {};
    let mut jobs = JobsClient::new(channel);
    let asked = timeout(PATIENCE, jobs.get_server_info(info)).await;
    asked.expect("an answer in time").unwrap();
}

#[tokio::test]
async fn silent_and_slow_clients_shut_nobody_out() {
    let folder = tempfile::tempdir().unwrap();
    let ours = authority("ours");
    let files = ours.serve(folder.path(), None);
    let server = start(folder.path(), |config| {
        config.access.tls = Some(files);
        config.connections = Connections {
            all: 60,
            per_address: Some(50),
            // Longer than the test, so that silence alone does not end the connections.
            first_request: Duration::from_secs(3_600),
            ..Connections::default()
        };
    })
    .await;
    let mut silent = server.silent(200).await;
    // Some of them complete the handshake and send nothing more.
    let mut shaken = Vec::new();
    for socket in silent.drain(150..) {
        shaken.push(tokio::spawn(ours.handshake(socket)));
    }
    let mut slow = Vec::new();
    for _ in 0..400 {
        let mut socket = TcpStream::connect(server.running.http.unwrap())
            .await
            .unwrap();
        socket.write_all(b"GET /healthz HT").await.unwrap();
        slow.push(socket);
    }
    let answer = server.page("/healthz").await;
    assert!(answer.contains("\r\n\r\nok, the loop turned"), "{answer}");
    let channel = ours
        .channel(server.running.address.port(), None)
        .await
        .unwrap();
    works(channel.clone()).await;
    // They keep reconnecting, and a client that has had a request stays.
    let more = server.silent(200).await;
    works(channel).await;
    server.page("/metrics").await;
    drop((silent, shaken, slow, more));
    server.stop.cancel();
    server.running.wait().await.unwrap();
}

#[tokio::test]
async fn silence_ends_a_connection_and_open_streams_keep_one() {
    let folder = tempfile::tempdir().unwrap();
    let server = start(folder.path(), |config| {
        config.connections = Connections {
            first_request: Duration::from_millis(300),
            idle: Duration::from_millis(300),
            ..Connections::default()
        };
    })
    .await;
    let url = format!("http://{}", server.running.address);
    let channel = Channel::from_shared(url).unwrap().connect().await.unwrap();
    let mut jobs = JobsClient::new(channel.clone());
    let spec = r#"{"name": "n", "scenes": {"kind": "primitive", "count": 1}, "render": {"renderer": "r"},
        "output": {"store": "file:///nowhere", "dataset": "d"}}"#;
    let request = wire::SubmitJobRequest {
        spec: Some(wire::JobSpec { json: spec.into() }),
        again: false,
    };
    let job_id = jobs.submit_job(request).await.unwrap().into_inner().job_id;
    let watch = wire::WatchJobRequest {
        job_id: job_id.clone(),
    };
    let mut watch = jobs.watch_job(watch).await.unwrap().into_inner();
    watch.message().await.unwrap().unwrap();
    for mut socket in server.silent(20).await {
        // The connection ends after the server's settings, cleanly or with a reset.
        let end = timeout(PATIENCE, socket.read_to_end(&mut Vec::new())).await;
        let _ = end.expect("it is closed in time");
    }
    tokio::time::sleep(Duration::from_millis(1_200)).await;
    // The stream that was quiet for several times the limit is still open.
    let cancel = wire::CancelJobRequest { job_id };
    jobs.cancel_job(cancel).await.unwrap();
    let heard = timeout(PATIENCE, watch.message()).await.unwrap().unwrap();
    assert!(heard.unwrap().job.unwrap().ended_at_ms > 0);
    drop(watch);
    // A connection without streams ends, and a client that needs one opens another.
    tokio::time::sleep(Duration::from_millis(1_200)).await;
    works(channel).await;
}

async fn until_connected(by: &Authority, port: u16, client: Option<&Authority>) -> Channel {
    let began = std::time::Instant::now();
    loop {
        let channel = by.channel(port, client).await;
        if let Ok(channel) = channel {
            // A client's certificate is refused after the handshake.
            let info = wire::GetServerInfoRequest {};
            if JobsClient::new(channel.clone())
                .get_server_info(info)
                .await
                .is_ok()
            {
                return channel;
            }
        }
        assert!(
            began.elapsed() < PATIENCE,
            "the new certificates are not used"
        );
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test]
async fn new_certificates_are_used_without_a_restart_and_bad_ones_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let (old, new) = (authority("old"), authority("new"));
    let files = old.serve(folder.path(), Some(&old));
    let server = start(folder.path(), |config| config.access.tls = Some(files)).await;
    let port = server.running.address.port();
    let before = until_connected(&old, port, Some(&old)).await;
    assert!(new.channel(port, Some(&old)).await.is_err());

    // The certificate and the client authority both change.
    new.serve(folder.path(), Some(&new));
    let after = until_connected(&new, port, Some(&new)).await;
    works(after).await;
    assert!(old.channel(port, Some(&new)).await.is_err());
    let stranger = new.channel(port, Some(&old)).await;
    let refused = match stranger {
        Err(_) => true,
        Ok(channel) => {
            let info = wire::GetServerInfoRequest {};
            JobsClient::new(channel)
                .get_server_info(info)
                .await
                .is_err()
        }
    };
    assert!(refused, "the old authority's clients are let in still");
    // An earlier connection is refused too, because its client may have been revoked with its
    // authority.
    let info = wire::GetServerInfoRequest {};
    let refused = JobsClient::new(before).get_server_info(info).await;
    let refused = refused.expect_err("the old authority's clients are let in still");
    assert!(refused.message().contains("connect again"), "{refused}");

    // This key belongs to another certificate, so the current ones stay in force.
    std::fs::write(folder.path().join("server.pem"), old.pem()).unwrap();
    tokio::time::sleep(Duration::from_secs(4)).await;
    works(until_connected(&new, port, Some(&new)).await).await;
    server.stop.cancel();
    server.running.wait().await.unwrap();
    let catalog = SqliteCatalog::open(&folder.path().join("catalog.sqlite"), "test").await;
    let query = AuditQuery {
        limit: 9,
        ..AuditQuery::default()
    };
    let lines = catalog.unwrap().audited(&query).await.unwrap();
    let said: Vec<_> = lines
        .iter()
        .rev()
        .map(|line| (line.act.name(), line.outcome.name()))
        .collect();
    assert_eq!(said, [("certificates", "done"), ("certificates", "failed")]);
    assert!(
        lines[0].detail.contains("does not match"),
        "{}",
        lines[0].detail
    );
}
