//! Answers of the HTTP endpoint to requests of all kinds, and to invalid ones.

use std::time::Duration;

use picofarm_coordinator::{CoordinatorConfig, Running, serve};
use picofarm_database::CatalogPlace;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    time::timeout,
};
use tokio_util::sync::CancellationToken;

use super::PATIENCE;

pub(super) async fn start(folder: &tempfile::TempDir) -> Running {
    let any = "127.0.0.1:0".parse().unwrap();
    let mut config = CoordinatorConfig::new(
        CatalogPlace::from(folder.path().join("catalog.sqlite")),
        any,
    );
    config.http = Some(any);
    serve(config, CancellationToken::new()).await.unwrap()
}

/// Returns everything received until the connection ends. It may end with a reset, because the
/// server closes without reading the rest of a refused request.
async fn heard(stream: &mut TcpStream) -> String {
    let mut bytes = Vec::new();
    let end = timeout(PATIENCE, stream.read_to_end(&mut bytes)).await;
    let _ = end.expect("the connection is closed in time");
    String::from_utf8(bytes).unwrap()
}

pub(super) async fn answer(to: &Running, request: impl AsRef<[u8]>) -> String {
    let mut stream = TcpStream::connect(to.http.unwrap()).await.unwrap();
    // The server may close before everything is written.
    let _ = stream.write_all(request.as_ref()).await;
    heard(&mut stream).await
}

fn code(answer: &str) -> &str {
    answer.split(' ').nth(1).unwrap_or_default()
}

/// Returns the value of a header, ignoring the case of its name.
fn header<'a>(answer: &'a str, name: &str) -> Option<&'a str> {
    let head = answer.split("\r\n\r\n").next()?;
    head.lines()
        .filter_map(|line| line.split_once(": "))
        .find_map(|(found, value)| found.eq_ignore_ascii_case(name).then_some(value))
}

pub(super) fn body(answer: &str) -> &str {
    answer.split_once("\r\n\r\n").unwrap().1
}

#[tokio::test]
async fn pages_are_for_get_and_head() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(&folder).await;
    for (request, expected) in [
        ("GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n", "200"),
        ("GET /healthz?verbose HTTP/1.1\r\n\r\n", "200"),
        ("GET /metrics HTTP/1.0\r\n\r\n", "200"),
        ("HEAD /metrics HTTP/1.1\r\n\r\n", "200"),
        ("GET / HTTP/1.1\r\n\r\n", "404"),
        ("GET /metrics/ HTTP/1.1\r\n\r\n", "404"),
        ("HEAD /jobs HTTP/1.1\r\n\r\n", "404"),
        ("POST /healthz HTTP/1.1\r\n\r\n", "405"),
        (
            "POST /jobs HTTP/1.1\r\nContent-Length: 5\r\n\r\nhello",
            "405",
        ),
        (
            "PUT /metrics HTTP/1.1\r\nExpect: 100-continue\r\nContent-Length: 5\r\n\r\n",
            "405",
        ),
        ("OPTIONS * HTTP/1.1\r\n\r\n", "405"),
        ("CONNECT a:1 HTTP/1.1\r\n\r\n", "405"),
    ] {
        let answer = answer(&running, request).await;
        assert_eq!(code(&answer), expected, "{request:?}: {answer}");
        // HTTP/1.0 closes by default.
        if request.contains("HTTP/1.1") {
            assert_eq!(header(&answer, "connection"), Some("close"), "{answer}");
        }
        assert_eq!(header(&answer, "cache-control"), Some("no-store"));
        assert_eq!(
            header(&answer, "content-type"),
            Some("text/plain; version=0.0.4; charset=utf-8")
        );
        let allow = (expected == "405").then_some("GET, HEAD");
        assert_eq!(header(&answer, "allow"), allow, "{answer}");
        let length: usize = header(&answer, "content-length").unwrap().parse().unwrap();
        let sent = body(&answer).len();
        match request.starts_with("HEAD") {
            true => assert!(sent == 0 && length > 0, "{answer}"),
            false => assert_eq!(sent, length, "{answer}"),
        }
    }
    let page = answer(&running, "GET /metrics HTTP/1.1\r\n\r\n").await;
    assert!(page.contains("\npicofarm_ready "), "{page}");
}

#[tokio::test]
async fn what_is_no_request_is_refused_and_nothing_of_it_is_repeated() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(&folder).await;
    for bad in [
        "GET\r\n\r\n",
        "GET /healthz\r\n\r\n",
        "GET /healthz HTTP/3\r\n\r\n",
        "GET /healthz HTTP/1.1\r\nsecret\r\n\r\n",
        "GET /healthz HTTP/1.1\r\nsecret: a\0b\r\n\r\n",
        "\x16\x03\x01\x02 secret\r\n\r\n",
    ] {
        let answer = answer(&running, bad).await;
        assert_eq!(code(&answer), "400", "{bad:?}: {answer}");
        assert!(!answer.contains("secret"), "{answer}");
    }
    let strange = answer(&running, "GET secret HTTP/1.1\r\ntoken: secret\r\n\r\n").await;
    assert_eq!(code(&strange), "404", "{strange}");
    assert!(!strange.contains("secret"), "{strange}");
    // gRPC at the wrong port.
    let preface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
    let answer = answer(&running, preface).await;
    assert!(!answer.contains(" 200 "), "{answer}");
}

#[tokio::test]
async fn what_follows_a_request_gets_no_answer() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(&folder).await;
    let first = "GET /healthz HTTP/1.1\r\n\r\n";
    for more in ["\0\u{1}garbage\r\n\r\n", first, "GET /metr", "\r\n\r\n\r\n"] {
        let answer = answer(&running, format!("{first}{more}")).await;
        assert_eq!(code(&answer), "200", "{more:?}: {answer}");
        assert_eq!(answer.matches("HTTP/1.1").count(), 1, "{more:?}: {answer}");
        assert!(body(&answer).starts_with("ok, the loop turned"), "{answer}");
    }
}

#[tokio::test]
async fn a_head_may_have_eight_kibibytes() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(&folder).await;
    let head = |length: usize| {
        let (before, after) = ("GET /healthz HTTP/1.1\r\nx: ", "\r\n\r\n");
        format!(
            "{before}{}{after}",
            "x".repeat(length - before.len() - after.len())
        )
    };
    let answer_to = async |length| answer(&running, head(length)).await;
    assert_eq!(code(&answer_to(8 << 10).await), "200");
    for long in [(8 << 10) + 1, 16 << 10] {
        let answer = answer_to(long).await;
        assert_eq!(code(&answer), "431", "{long}: {answer}");
    }
    // A request without an end is cut off much earlier.
    let mut stream = TcpStream::connect(running.http.unwrap()).await.unwrap();
    let endless = async { while stream.write_all(&[b'x'; 1 << 16]).await.is_ok() {} };
    timeout(PATIENCE, endless).await.expect("it is cut off");
}

#[tokio::test]
async fn a_head_that_trickles_in_ends_its_connection() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(&folder).await;
    let stream = TcpStream::connect(running.http.unwrap()).await.unwrap();
    let (mut from, mut to) = stream.into_split();
    let trickle = async {
        to.write_all(b"GET /healthz HTTP/1.1\r\nx: ").await.unwrap();
        while to.write_all(b"x").await.is_ok() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    let mut bytes = Vec::new();
    let both = async { tokio::join!(trickle, from.read_to_end(&mut bytes)) };
    let (_, _) = timeout(PATIENCE, both).await.expect("it is cut off");
    assert!(!String::from_utf8_lossy(&bytes).contains(" 200 "));
}

#[tokio::test]
async fn a_client_that_ends_its_side_gets_its_answer() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(&folder).await;
    for page in ["/healthz", "/metrics"] {
        let mut stream = TcpStream::connect(running.http.unwrap()).await.unwrap();
        let request = format!("GET {page} HTTP/1.1\r\n\r\n");
        stream.write_all(request.as_bytes()).await.unwrap();
        stream.shutdown().await.unwrap();
        let answer = heard(&mut stream).await;
        assert_eq!(code(&answer), "200", "{page}: {answer}");
    }
}
