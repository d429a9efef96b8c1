//! `/healthz`, `/readyz` and `/metrics` over plain HTTP/1.1, for probes and Prometheus: three fixed pages, read only.
//! They hold counts, never names, paths or URLs; details of a failure are for this machine alone. So there is no token,
//! and none could be sent here by mistake: headers are not read.

use std::{
    fmt,
    net::SocketAddr,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use tokio::{
    io::{AsyncRead, AsyncReadExt, AsyncWriteExt},
    net::{TcpListener, TcpStream},
    sync::{Mutex as AsyncMutex, Semaphore},
    time::timeout,
};
use tokio_util::sync::CancellationToken;

use crate::{
    actor::Command,
    metrics::{Gauges, Metrics},
    rpc::Link,
};

/// How long the actor may take to say that it lives.
const ALIVE: Duration = Duration::from_secs(5);
/// The catalog is thought gone when it has not answered for so long.
const READY: Duration = Duration::from_secs(10);
/// Gauges are read from the catalog at most once in this time, and at most for a tenth of the time.
const FRESH: Duration = Duration::from_secs(1);
/// Connections answered at a time; others wait.
const CONNECTIONS: usize = 32;
/// The longest request head, bytes, and the longest time it may take.
const HEAD: usize = 8 << 10;
const HEAD_TIME: Duration = Duration::from_secs(5);

/// How the actor does with its catalog.
#[derive(Default)]
pub(crate) struct Pulse(Mutex<State>);

#[derive(Default)]
struct State {
    beaten: Option<Instant>,
    trouble: Option<String>,
}

/// Why no work can be taken: for anyone, and for people on this machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Unready {
    what: String,
    detail: Option<String>,
}

impl fmt::Display for Unready {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

impl Pulse {
    /// The catalog has answered.
    pub(crate) fn beat(&self) {
        *self.lock() = State {
            beaten: Some(Instant::now()),
            trouble: None,
        };
    }

    /// A life of the actor has ended for this reason; another will be tried.
    pub(crate) fn trouble(&self, why: &str) {
        self.lock().trouble = Some(why.to_owned());
    }

    /// Whether jobs and reports can be taken.
    ///
    /// # Errors
    /// Why not.
    pub(crate) fn ready(&self) -> Result<(), Unready> {
        let state = self.lock();
        if let Some(why) = &state.trouble {
            return Err(Unready {
                what: "the catalog failed, and has not answered since".into(),
                detail: Some(why.clone()),
            });
        }
        let what = match state.beaten.map(|at| at.elapsed()) {
            None => "the catalog has not answered yet".into(),
            Some(age) if age > READY => {
                format!("the catalog has not answered for {} s", age.as_secs())
            }
            Some(_) => return Ok(()),
        };
        Err(Unready { what, detail: None })
    }

    /// Whether the actor is between two lives: its silence is the catalog's.
    fn mends(&self) -> bool {
        self.lock().trouble.is_some()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.0.lock().expect("no panic while locked")
    }
}

/// What the pages are made of.
pub(crate) struct Pages {
    pub link: Link,
    pub metrics: Arc<Metrics>,
    pub pulse: Arc<Pulse>,
    pub gauges: AsyncMutex<Option<(Instant, Gauges)>>,
}

/// Answers until `stop`.
pub(crate) async fn run(listener: TcpListener, pages: Arc<Pages>, stop: CancellationToken) {
    let room = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        let permit = Arc::clone(&room).acquire_owned().await;
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = stop.cancelled() => return,
        };
        match accepted {
            Ok((stream, peer)) => {
                let pages = Arc::clone(&pages);
                tokio::spawn(async move {
                    // One that goes away early is no loss.
                    let _ = pages.serve(stream, peer).await;
                    drop(permit);
                });
            }
            Err(error) => {
                tracing::warn!(%error, "the HTTP endpoint cannot accept");
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    }
}

/// An answer.
#[derive(Debug, PartialEq, Eq)]
struct Answer {
    status: &'static str,
    body: String,
}

impl Answer {
    fn new(status: &'static str, body: impl Into<String>) -> Self {
        let body = body.into();
        Self { status, body }
    }

    fn bytes(&self, with_body: bool) -> Vec<u8> {
        let allow = if self.status.starts_with("405") {
            "Allow: GET, HEAD\r\n"
        } else {
            ""
        };
        let head = format!(
            "HTTP/1.1 {}\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\nContent-Length: {}\r\n\
             Cache-Control: no-store\r\n{allow}Connection: close\r\n\r\n",
            self.status,
            self.body.len()
        );
        let mut bytes = head.into_bytes();
        if with_body {
            bytes.extend_from_slice(self.body.as_bytes());
        }
        bytes
    }
}

/// The method and path of a request, without its query.
fn request_line(head: &str) -> Result<(&str, &str), Answer> {
    let line = head.lines().next().unwrap_or_default();
    let mut words = line.split(' ');
    match (words.next(), words.next(), words.next(), words.next()) {
        (Some(method), Some(target), Some("HTTP/1.1" | "HTTP/1.0"), None)
            if target.starts_with('/') =>
        {
            Ok((method, target.split('?').next().unwrap_or(target)))
        }
        _ => Err(Answer::new(
            "400 Bad Request",
            "expected GET /PATH HTTP/1.1\n",
        )),
    }
}

/// Reads up to the empty line that ends a head.
async fn head(stream: &mut (impl AsyncRead + Unpin)) -> Result<String, Answer> {
    let mut read = Vec::new();
    let whole = async {
        let mut piece = [0; 1024];
        while !read.windows(4).any(|end| end == b"\r\n\r\n") {
            if read.len() > HEAD {
                return Err(Answer::new(
                    "431 Request Header Fields Too Large",
                    "the request is too long\n",
                ));
            }
            match stream.read(&mut piece).await {
                Ok(n) if n > 0 => read.extend_from_slice(&piece[..n]),
                _ => return Err(Answer::new("400 Bad Request", "the request ended early\n")),
            }
        }
        Ok(())
    };
    match timeout(HEAD_TIME, whole).await {
        Ok(done) => done?,
        Err(_) => return Err(Answer::new("408 Request Timeout", "no request came\n")),
    }
    String::from_utf8(read).map_err(|_| Answer::new("400 Bad Request", "the request is no text\n"))
}

impl Pages {
    async fn serve(&self, mut stream: TcpStream, peer: SocketAddr) -> std::io::Result<()> {
        let (answer, with_body) = match head(&mut stream).await {
            Err(answer) => (answer, true),
            Ok(head) => match request_line(&head) {
                Err(answer) => (answer, true),
                Ok((method, path)) => (self.answer(method, path, peer).await, method != "HEAD"),
            },
        };
        timeout(HEAD_TIME, stream.write_all(&answer.bytes(with_body))).await??;
        stream.shutdown().await
    }

    async fn answer(&self, method: &str, path: &str, peer: SocketAddr) -> Answer {
        if !matches!(method, "GET" | "HEAD") {
            return Answer::new("405 Method Not Allowed", "only GET and HEAD\n");
        }
        match path {
            "/healthz" => self.health().await,
            "/readyz" => self.readiness(peer),
            "/metrics" => {
                let ready = self.pulse.ready().is_ok();
                Answer::new("200 OK", self.metrics.page(self.gauges().await, ready))
            }
            _ => Answer::new(
                "404 Not Found",
                "there are /healthz, /readyz and /metrics\n",
            ),
        }
    }

    /// Whether the process does its work; one that waits for its catalog does.
    async fn health(&self) -> Answer {
        // Any answer will do, be it that the catalog is out of order.
        match timeout(ALIVE, self.link.ask(Command::Look)).await {
            Ok(_) => Answer::new("200 OK", "ok\n"),
            Err(_) if self.pulse.mends() => Answer::new("200 OK", "ok, waiting for the catalog\n"),
            Err(_) => {
                let words = format!(
                    "the coordinator has not answered for {} s\n",
                    ALIVE.as_secs()
                );
                Answer::new("503 Service Unavailable", words)
            }
        }
    }

    fn readiness(&self, peer: SocketAddr) -> Answer {
        match self.pulse.ready() {
            Ok(()) => Answer::new("200 OK", "ready\n"),
            Err(why) => {
                // Error texts name files and hosts.
                let detail = why.detail.as_ref().filter(|_| peer.ip().is_loopback());
                let detail = detail.map_or_else(String::new, |d| format!(": {d}"));
                Answer::new("503 Service Unavailable", format!("{why}{detail}\n"))
            }
        }
    }

    /// The farm's counts; `None` where they cannot be had now.
    async fn gauges(&self) -> Option<Gauges> {
        // Whoever comes meanwhile waits here, and finds them fresh.
        let mut kept = self.gauges.lock().await;
        if let Some((until, gauges)) = &*kept
            && Instant::now() < *until
        {
            return Some(*gauges);
        }
        *kept = None;
        let began = Instant::now();
        let gauges = timeout(ALIVE, self.read_gauges()).await.ok()??;
        *kept = Some((Instant::now() + FRESH.max(10 * began.elapsed()), gauges));
        Some(gauges)
    }

    async fn read_gauges(&self) -> Option<Gauges> {
        let look = self.link.ask(Command::Look).await.ok()?;
        let mut gauges = Gauges {
            jobs: look.jobs.len() as u64,
            workers: look.workers.len() as u64,
            houses: u64::from(look.houses),
            ..Gauges::default()
        };
        for job in look.jobs {
            if let Some(record) = self.link.catalog.job(job).await.ok()? {
                gauges.tasks += record.counts();
            }
        }
        Some(gauges)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readiness_follows_the_catalog() {
        let pulse = Pulse::default();
        assert!(
            pulse
                .ready()
                .unwrap_err()
                .to_string()
                .contains("not answered yet")
        );
        pulse.beat();
        assert_eq!(pulse.ready(), Ok(()));
        pulse.trouble("no route to db.example");
        let why = pulse.ready().unwrap_err();
        assert!(
            !why.to_string().contains("db.example"),
            "hosts are for this machine alone"
        );
        assert_eq!(why.detail.as_deref(), Some("no route to db.example"));
        assert!(pulse.mends());
        pulse.beat();
        assert_eq!(pulse.ready(), Ok(()));
        let long_ago = Instant::now().checked_sub(2 * READY);
        pulse.lock().beaten = long_ago;
        assert_eq!(pulse.ready().is_err(), long_ago.is_some());
    }

    #[tokio::test]
    async fn requests_are_read_or_refused_in_words() {
        let line = |text: &'static str| async move {
            let head = head(&mut text.as_bytes()).await?;
            request_line(&head).map(|(m, p)| (m.to_owned(), p.to_owned()))
        };
        let good = line("GET /metrics?x=1 HTTP/1.1\r\nHost: a\r\n\r\n")
            .await
            .unwrap();
        assert_eq!(good, ("GET".into(), "/metrics".into()));
        for bad in [
            "GET /metrics",
            "GET\r\n\r\n",
            "\r\n\r\n",
            "GET x HTTP/1.1\r\n\r\n",
            "GET / HTTP/2\r\n\r\n",
        ] {
            let answer = line(bad).await.unwrap_err();
            assert_eq!(answer.status, "400 Bad Request", "{bad:?}");
        }
        let long = "x".repeat(2 * HEAD);
        let answer = head(&mut long.as_bytes()).await.unwrap_err();
        assert!(answer.status.starts_with("431"), "{answer:?}");
    }

    #[test]
    fn an_answer_to_head_has_no_body() {
        let answer = Answer::new("200 OK", "ready\n");
        let bytes = String::from_utf8(answer.bytes(false)).unwrap();
        assert!(
            bytes.contains("Content-Length: 6\r\n") && bytes.ends_with("\r\n\r\n"),
            "{bytes}"
        );
        let bytes = String::from_utf8(answer.bytes(true)).unwrap();
        assert!(bytes.ends_with("\r\n\r\nready\n"), "{bytes}");
    }
}
