//! A process without free file handles continues once there is one again. This is a separate test
//! program, because the limit applies to the whole process.

use std::time::Duration;

use picofarm_coordinator::{CoordinatorConfig, serve};
use picofarm_database::CatalogPlace;
use picofarm_proto::wire::{self, jobs_client::JobsClient};
use rustix::process::{Resource, Rlimit, setrlimit};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    time::timeout,
};
use tokio_util::sync::CancellationToken;
use tonic::Code;

const PATIENCE: Duration = Duration::from_secs(20);
const FILES: u64 = 240;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_listener_without_a_file_left_goes_on_when_there_are_some_again() {
    let limit = Rlimit {
        current: Some(FILES / 2),
        maximum: Some(FILES),
    };
    setrlimit(Resource::Nofile, limit).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let any = "127.0.0.1:0".parse().unwrap();
    let mut config = CoordinatorConfig::new(
        CatalogPlace::from(folder.path().join("catalog.sqlite")),
        any,
    );
    config.http = Some(any);
    let running = serve(config, CancellationToken::new()).await.unwrap();
    // The clients are in this process too, so that they use half of the connections' files.
    let mut sockets = Vec::new();
    let full = loop {
        match TcpStream::connect(running.address).await {
            Ok(socket) => sockets.push(socket),
            Err(error) => break error,
        }
        assert!(sockets.len() < FILES as usize, "there is no limit");
    };
    assert_eq!(
        full.raw_os_error(),
        Some(rustix::io::Errno::MFILE.raw_os_error())
    );
    assert!(
        sockets.len() > FILES as usize / 4,
        "the limit was not raised: {}",
        sockets.len()
    );
    tokio::time::sleep(Duration::from_millis(500)).await;
    drop(sockets);

    let asked = async {
        let mut stream = TcpStream::connect(running.http.unwrap()).await.unwrap();
        stream
            .write_all(b"GET /healthz HTTP/1.1\r\n\r\n")
            .await
            .unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await.unwrap();
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        let url = format!("http://{}", running.address);
        let mut jobs = JobsClient::connect(url).await.unwrap();
        // If the catalog could not be opened for lack of a file handle, opening is tried again a
        // little later.
        while let Err(status) = jobs.get_server_info(wire::GetServerInfoRequest {}).await {
            assert_eq!(status.code(), Code::Unavailable, "{status}");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    timeout(PATIENCE, asked).await.expect("answers in time");
}
