//! Connections and their limits. hyper speaks HTTP/1.1; requests are bounded here.

use std::{convert::Infallible, pin::Pin, sync::Arc, time::Duration};

use http::{Method, Request, StatusCode, request::Parts};
use http_body::Body as _;
use hyper::{body::Incoming, server::conn::http1, service::service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::{TcpListener, TcpStream},
    sync::Semaphore,
    time::timeout,
};
use tokio_util::sync::CancellationToken;

use crate::{
    App,
    answer::{Answer, Problem},
    live,
    places::{KNOWN, Place, Places},
    routes,
};

/// Most scenes whose images are read at a time; further requests wait.
const IMAGES: usize = 2;
/// The longest request head, bytes.
const HEAD: usize = 16 << 10;
/// The longest body of a form, bytes.
const FORM: usize = 4 << 10;
/// Time limit of a TLS handshake, of a request head, and of a form.
const PATIENCE: Duration = Duration::from_secs(10);

/// The limits that requests share.
pub struct Limits {
    /// Pages that get events.
    pub live: Arc<Semaphore>,
    /// Scenes whose images are read.
    pub images: Semaphore,
    /// Volumes that are read: one at a time, because each may need a gigabyte, and so that requests
    /// for parts of the same one wait for it.
    pub volumes: Semaphore,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            live: Arc::new(Semaphore::new(live::MOST)),
            images: Semaphore::new(IMAGES),
            volumes: Semaphore::new(1),
        }
    }
}

/// Answers requests until `stop`.
pub async fn run(listener: TcpListener, app: Arc<App>, stop: CancellationToken) {
    let places = Arc::new(Places::default());
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = stop.cancelled() => break,
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!(%error, "the web server cannot accept a connection");
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        let place = Arc::new(places.take(peer.ip()));
        let app = Arc::clone(&app);
        tokio::spawn(async move {
            tokio::select! {
                () = connection(Arc::clone(&app), stream, Arc::clone(&place)) => {}
                () = place.closed().cancelled() => {}
                () = app.stop.cancelled() => {}
            }
        });
    }
    app.stop.cancel();
}

/// Answers the requests of a connection.
async fn connection(app: Arc<App>, stream: TcpStream, place: Arc<Place>) {
    match &app.tls {
        None => serve(app, stream, place).await,
        Some(tls) => {
            let handshake = tls.acceptor().accept(stream);
            // A caller that speaks no TLS, or refuses the certificate, is no error.
            if let Ok(Ok(stream)) = timeout(PATIENCE, handshake).await {
                serve(app, stream, place).await;
            }
        }
    }
}

async fn serve(app: Arc<App>, stream: impl AsyncRead + AsyncWrite + Unpin, place: Arc<Place>) {
    let service = service_fn(|request| {
        let (app, place) = (Arc::clone(&app), Arc::clone(&place));
        async move { Ok::<_, Infallible>(respond(app, request, &place).await) }
    });
    // A browser that leaves early is no error.
    let _ = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(PATIENCE)
        .max_buf_size(HEAD)
        .serve_connection(TokioIo::new(stream), service)
        .await;
}

async fn respond(app: Arc<App>, request: Request<Incoming>, place: &Place) -> Answer {
    let (head, body) = request.into_parts();
    let known = routes::has_key(&app, &head);
    if known && !place.knows_key() {
        let what = format!("{KNOWN} connections are open already, which is the limit");
        let status = StatusCode::SERVICE_UNAVAILABLE;
        return routes::problem(&app, &Problem::new(status, what));
    }
    // Only a form that would be acted on is read.
    let form = match head.method == Method::POST && (known || is_login(&head)) {
        true => match timeout(PATIENCE, form(body)).await {
            Ok(Ok(form)) => form,
            Ok(Err(problem)) => return routes::problem(&app, &problem),
            Err(_) => {
                let status = StatusCode::REQUEST_TIMEOUT;
                return routes::problem(&app, &Problem::new(status, "the form did not arrive"));
            }
        },
        false => String::new(),
    };
    routes::answer(&app, &head, &form).await
}

fn is_login(head: &Parts) -> bool {
    head.uri.path() == routes::LOGIN
}

/// Reads the body of a form.
async fn form(mut body: Incoming) -> Result<String, Problem> {
    let mut bytes = Vec::new();
    let frame =
        |body: &mut Incoming, cx: &mut std::task::Context<'_>| Pin::new(body).poll_frame(cx);
    while let Some(part) = std::future::poll_fn(|cx| frame(&mut body, cx)).await {
        let part = part.map_err(|e| Problem::input(format!("the form broke off: {e}")))?;
        let Ok(data) = part.into_data() else { continue };
        if bytes.len() + data.len() > FORM {
            let what = format!("expected a form of at most {FORM} bytes");
            return Err(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, what));
        }
        bytes.extend_from_slice(&data);
    }
    String::from_utf8(bytes).map_err(|_| Problem::input("expected a form in UTF-8"))
}
