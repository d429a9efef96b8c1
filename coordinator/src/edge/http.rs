//! `/healthz`, `/readyz` and `/metrics` over plain HTTP/1.1, for probes and Prometheus: three
//! fixed, read-only pages. They contain counts, never names, paths or URLs. Details of a failure
//! are shown only on this machine. The pages therefore need no token, and a token sent here by
//! mistake is ignored: only the method and path of a request are read.
//!
//! A separate thread with its own runtime and bounds serves them, so that an answer takes less than
//! a second whatever happens at the gRPC port, in the actor or in the catalog. hyper speaks HTTP.
//! Connections are accepted, counted and ended here.

use std::{
    convert::Infallible,
    net::SocketAddr,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use http::{
    HeaderValue, Method, Response, StatusCode,
    header::{ALLOW, CACHE_CONTROL, CONTENT_TYPE},
};
use hyper::{server::conn::http1, service::service_fn};
use hyper_util::rt::TokioIo;
use tokio::{
    net::{TcpListener, TcpStream},
    runtime::Handle,
    sync::Semaphore,
    time::timeout,
};
use tokio_util::sync::CancellationToken;

use super::{
    connections::{ConnectionSlot, ConnectionSlots},
    rpc::Link,
};
use crate::{
    actor::Command,
    auth::Throttle,
    memory::Memory,
    observe::{
        health::Health,
        metrics::{Gauges, Metrics},
    },
};

/// Longest time that a page waits for fresh gauges, and the greatest age of the gauges shown
/// otherwise.
const WAIT: Duration = Duration::from_millis(500);
const OLD: Duration = Duration::from_secs(30);
/// Gauges are read from the catalog at most once in this interval, and for at most a tenth of the
/// time.
const FRESH: Duration = Duration::from_secs(1);
/// Most concurrent connections. A further one replaces the one that has waited longest to send its
/// request.
const CONNECTIONS: usize = 256;
/// The longest request head, bytes.
const HEAD: usize = 8 << 10;
/// Time limit of a request head, and of the delivery of its answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// The sources of the pages.
pub(crate) struct Pages {
    pub link: Link,
    pub metrics: Arc<Metrics>,
    pub health: Arc<Health>,
    /// Connections of the gRPC port.
    pub slots: Arc<ConnectionSlots>,
    pub memory: Arc<Memory>,
    pub gauges: GaugeCache,
    /// The runtime of the actor and of the catalog's connections.
    pub main: Handle,
}

/// The gauges as last read.
pub(crate) struct GaugeCache {
    read: Mutex<Option<CachedGauges>>,
    /// The holder of the permit reads them again.
    reading: Arc<Semaphore>,
}

impl Default for GaugeCache {
    fn default() -> Self {
        Self {
            read: Mutex::default(),
            reading: Arc::new(Semaphore::new(1)),
        }
    }
}

#[derive(Clone, Copy)]
struct CachedGauges {
    at: Instant,
    fresh_until: Instant,
    gauges: Gauges,
}

/// Serves the pages from a separate thread, until `stop`.
///
/// # Errors
/// Returns an error if the system provides no thread or no runtime.
pub(crate) fn start(
    listener: std::net::TcpListener,
    pages: Arc<Pages>,
    stop: CancellationToken,
) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let listener = {
        let _in = runtime.enter();
        TcpListener::from_std(listener)?
    };
    std::thread::Builder::new()
        .name("http".into())
        .spawn(move || runtime.block_on(run(listener, pages, stop)))?;
    Ok(())
}

async fn run(listener: TcpListener, pages: Arc<Pages>, stop: CancellationToken) {
    let slots = Arc::new(ConnectionSlots::new(CONNECTIONS, CONNECTIONS, CONNECTIONS));
    let failed = Throttle::default();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = stop.cancelled() => return,
        };
        match accepted {
            Ok((stream, peer)) => {
                // All places have connections with answers being written, which takes a moment.
                let Ok(held) = slots.enter(peer.ip()) else {
                    continue;
                };
                let pages = Arc::clone(&pages);
                tokio::spawn(async move {
                    // hyper's own time limit would need a timer and do the same.
                    let ended = Arc::clone(held.slot()).ended(PATIENCE, PATIENCE);
                    tokio::select! {
                        // A client that disconnects early is no loss.
                        _ = serve(pages, stream, peer, held.slot()) => {}
                        _ = ended => {}
                    }
                });
            }
            Err(error) => {
                if let Some(unsaid) = failed.allows() {
                    tracing::warn!(%error, unsaid, "the HTTP endpoint cannot accept");
                }
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    }
}

/// Serves one request. Further requests on the connection would keep its place from others.
async fn serve(
    pages: Arc<Pages>,
    stream: TcpStream,
    peer: SocketAddr,
    slot: &Arc<ConnectionSlot>,
) -> hyper::Result<()> {
    let service = service_fn(|request| {
        let pages = Arc::clone(&pages);
        async move {
            let _answering = slot.stream();
            let answer = pages
                .answer(request.method(), request.uri().path(), peer)
                .await;
            Ok::<_, Infallible>(answer)
        }
    });
    http1::Builder::new()
        .keep_alive(false)
        // Some clients close their side right after the request.
        .half_close(true)
        .max_header_size(HEAD)
        .serve_connection(TokioIo::new(stream), service)
        .await
}

fn page(status: StatusCode, body: impl Into<String>) -> Response<String> {
    let mut page = Response::new(body.into());
    *page.status_mut() = status;
    let text = HeaderValue::from_static("text/plain; version=0.0.4; charset=utf-8");
    page.headers_mut().insert(CONTENT_TYPE, text);
    let fresh = HeaderValue::from_static("no-store");
    page.headers_mut().insert(CACHE_CONTROL, fresh);
    page
}

impl Pages {
    async fn answer(
        self: &Arc<Self>,
        method: &Method,
        path: &str,
        peer: SocketAddr,
    ) -> Response<String> {
        if !matches!(*method, Method::GET | Method::HEAD) {
            let mut refusal = page(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD\n");
            let allowed = HeaderValue::from_static("GET, HEAD");
            refusal.headers_mut().insert(ALLOW, allowed);
            return refusal;
        }
        match path {
            "/healthz" => match self.health.alive() {
                Ok(words) => page(StatusCode::OK, words + "\n"),
                Err(words) => page(StatusCode::SERVICE_UNAVAILABLE, words + "\n"),
            },
            "/readyz" => self.readiness(peer),
            "/metrics" => {
                let ready = self.health.ready().is_ok();
                let (gauges, connections) = (self.gauges().await, self.slots.counts());
                page(
                    StatusCode::OK,
                    self.metrics
                        .page(gauges, connections, self.memory.used(), ready),
                )
            }
            _ => page(
                StatusCode::NOT_FOUND,
                "there are /healthz, /readyz and /metrics\n",
            ),
        }
    }

    fn readiness(&self, peer: SocketAddr) -> Response<String> {
        match self.health.ready() {
            Ok(()) => page(StatusCode::OK, "ready\n"),
            Err(why) => {
                // Error texts name files and hosts.
                let detail = why.detail.as_ref().filter(|_| peer.ip().is_loopback());
                let detail = detail.map_or_else(String::new, |d| format!(": {d}"));
                page(StatusCode::SERVICE_UNAVAILABLE, format!("{why}{detail}\n"))
            }
        }
    }

    /// Returns the farm's counts; `None` if they are not available now.
    async fn gauges(self: &Arc<Self>) -> Option<Gauges> {
        let cached = |until: fn(&CachedGauges) -> Instant| {
            let read = *self.gauges.read.lock().expect("no panic while locked");
            read.filter(|read| Instant::now() < until(read))
                .map(|read| read.gauges)
        };
        if let Some(gauges) = cached(|read| read.fresh_until) {
            return Some(gauges);
        }
        let turn = Arc::clone(&self.gauges.reading);
        let pages = Arc::clone(self);
        // This runs on the main runtime, which owns the connections to the catalog. It continues if
        // the page stops waiting.
        let read = self.main.spawn(async move {
            let _turn = turn.acquire().await;
            let fresh = *pages.gauges.read.lock().expect("no panic while locked");
            if fresh.is_some_and(|read| Instant::now() < read.fresh_until) {
                return;
            }
            let began = Instant::now();
            if let Ok(Some(gauges)) = timeout(OLD, pages.read_gauges()).await {
                let at = Instant::now();
                *pages.gauges.read.lock().expect("no panic while locked") = Some(CachedGauges {
                    at,
                    fresh_until: at + FRESH.max(10 * began.elapsed()),
                    gauges,
                });
            }
        });
        let _ = timeout(WAIT, read).await;
        cached(|read| (read.at + OLD).max(read.fresh_until))
    }

    async fn read_gauges(&self) -> Option<Gauges> {
        let look = self.link.ask(Command::FarmSnapshot).await.ok()?;
        Some(Gauges {
            ready: look.ready,
            jobs: look.jobs.len() as u64,
            workers: look.workers.len() as u64,
            instances: u64::from(look.instances),
            tasks: self
                .link
                .read(|catalog| async move { catalog.active_tasks().await })
                .await
                .ok()?,
        })
    }
}
