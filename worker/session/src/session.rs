//! One connection to the coordinator: opening it, the hello, and passing messages.
//!
//! # Why nothing is lost, and why the outbox may be in memory
//! The order of every task is compute → publish → report → commit. *Publish* ends with the
//! manifest, which is written last, create-only, and is a pure function of the task's key. From
//! that moment the task is finished: the manifest **is** the durable outbox. If this process is
//! killed before the report is acknowledged, the lease expires, and another worker gets the task.
//! It finds the manifest under the task's key and adopts it instead of rendering again. The reports
//! in memory ([`crate::outbox`]) only avoid that detour if the process survives and the connection
//! does not.
//!
//! # Self-fencing
//! A lease that has not been renewed for two thirds of its lifetime, on this machine's monotonic
//! clock, is *fenced*: none of its tasks is **started** until the coordinator renews it
//! ([`crate::assignments`]). A running task continues and may publish. Publishing does no harm,
//! because the put is create-only and an honest rival would have written the same bytes. Fencing
//! prevents waste: a worker cut off from the farm would otherwise work through a range that another
//! worker has had for a long time.
//!
//! A lease is *lost* if a heartbeat's answer does not list it, or if it is revoked after it expired
//! here (a laptop that slept, a coordinator that was unreachable for long). Its waiting tasks are
//! dropped and its running task continues, because its result can still be adopted. A lease revoked
//! before it expires is no longer *wanted* (a cancelled job): its running task is stopped.

use std::time::Duration;

use picofarm_proto::{
    messages::WorkerHello,
    wire::{self, farm_client::FarmClient, session_request, session_response},
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::UnboundedReceiverStream;
use tonic::{Code, Status, Streaming};

use crate::{
    Access, AgentError, ConnectionFailure, Target, lost_connection,
    message::{Incoming, Outgoing},
};

/// Timeout for connecting, and then for the welcome.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);
/// A connection that does not answer a ping within this time is dead.
const KEEPALIVE: Duration = Duration::from_secs(10);
/// A lease contains its job's spec; one with 100,000 scene files needs some 20 MB.
const MAX_MESSAGE: usize = 256 << 20;

/// A reason why a session did not open, or ended.
#[derive(Debug)]
pub(crate) enum LinkError {
    /// Retry later.
    Down(String),
    /// A setting on one of the two sides must be corrected.
    Mismatch(String),
    /// Retrying would not help.
    Refused(String),
}

impl From<Status> for LinkError {
    fn from(status: Status) -> Self {
        let text = match status.message() {
            "" => status.code().to_string(),
            message => message.to_owned(),
        };
        match status.code() {
            // Aborted: another process uses this worker's id. Reconnecting would only evict that
            // one.
            Code::Aborted
            | Code::FailedPrecondition
            | Code::InvalidArgument
            | Code::PermissionDenied
            | Code::Unauthenticated => LinkError::Refused(text),
            Code::Unimplemented => LinkError::Refused(format!(
                "what answers there is no picofarm coordinator ({text}); check the address"
            )),
            _ => LinkError::Down(text),
        }
    }
}

/// The coordinator's parameters for a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Welcome {
    /// Interval between heartbeats.
    pub(crate) heartbeat: Duration,
    /// Lifetime of a lease between renewals.
    pub(crate) lease: Duration,
}

/// An open session.
pub(crate) struct Session {
    to: mpsc::UnboundedSender<wire::SessionRequest>,
    from: Streaming<wire::SessionResponse>,
}

/// Returns the coordinators of a comma-separated list of URLs.
pub(crate) fn targets(urls: &str, access: &Access) -> Result<Vec<Target>, AgentError> {
    urls.split(',')
        .map(|url| target(url.trim(), access))
        .collect()
}

/// Checks a coordinator's URL and the access settings, and configures connections to it.
fn target(url: &str, access: &Access) -> Result<Target, AgentError> {
    let mut target = access.target(url)?;
    target.endpoint = target
        .endpoint
        .connect_timeout(OPEN_TIMEOUT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(KEEPALIVE)
        .keep_alive_timeout(KEEPALIVE)
        .keep_alive_while_idle(true);
    Ok(target)
}

impl From<ConnectionFailure> for LinkError {
    fn from(failure: ConnectionFailure) -> Self {
        match failure {
            ConnectionFailure::Down(why) => Self::Down(why),
            ConnectionFailure::Mismatch(why) => Self::Mismatch(why),
        }
    }
}

/// Returns the reason why a call at the start of a session failed: the coordinator's message, or a
/// diagnosis of the connection.
async fn failed(target: &Target, status: Status) -> LinkError {
    if lost_connection(&status) {
        target.diagnose(&status).await.into()
    } else {
        status.into()
    }
}

/// Connects, sends the hello and waits for the welcome.
pub(crate) async fn open(
    target: Target,
    hello: WorkerHello,
) -> Result<(Welcome, Box<Session>), LinkError> {
    match tokio::time::timeout(OPEN_TIMEOUT, open_patiently(target, hello)).await {
        Ok(opened) => opened,
        Err(_) => Err(LinkError::Down(format!(
            "no welcome within {} s",
            OPEN_TIMEOUT.as_secs()
        ))),
    }
}

async fn open_patiently(
    target: Target,
    hello: WorkerHello,
) -> Result<(Welcome, Box<Session>), LinkError> {
    let channel = match target.endpoint.connect().await {
        Ok(channel) => channel,
        Err(error) => return Err(target.diagnose(&error).await.into()),
    };
    let mut client = FarmClient::with_interceptor(channel, target.bearer.clone())
        .max_decoding_message_size(MAX_MESSAGE)
        .max_encoding_message_size(MAX_MESSAGE);
    let (to, requests) = mpsc::unbounded_channel();
    let first = wire::SessionRequest {
        message: Some(session_request::Message::Hello(hello.into())),
    };
    to.send(first).expect("the receiver is in this function");
    let requests = UnboundedReceiverStream::new(requests);
    let mut from = match client.session(requests).await {
        Ok(response) => response.into_inner(),
        Err(status) => return Err(failed(&target, status).await),
    };
    let first = match from.message().await {
        Ok(message) => message,
        Err(status) => return Err(failed(&target, status).await),
    };
    let welcome = match first {
        Some(wire::SessionResponse {
            message: Some(session_response::Message::Welcome(w)),
        }) if w.heartbeat_ms > 0 && w.lease_ms > w.heartbeat_ms => Welcome {
            heartbeat: Duration::from_millis(w.heartbeat_ms.into()),
            lease: Duration::from_millis(w.lease_ms.into()),
        },
        Some(other) => {
            return Err(LinkError::Down(format!(
                "expected a welcome with 0 < heartbeat_ms < lease_ms, got {other:?}"
            )));
        }
        None => {
            return Err(LinkError::Down(
                "the coordinator closed the session before its welcome".into(),
            ));
        }
    };
    Ok((welcome, Box::new(Session { to, from })))
}

impl Session {
    /// Queues a message. Errors are not reported here, because a dead connection is detected by
    /// [`Session::receive`].
    pub(crate) fn send(&self, message: Outgoing) {
        let _ = self.to.send(message.into());
    }

    /// Returns the next message that can be understood. Cancel-safe.
    pub(crate) async fn receive(&mut self) -> Result<Incoming, LinkError> {
        match self.from.message().await? {
            Some(response) => Ok(Incoming::from_wire(response)),
            None => Err(LinkError::Down("the coordinator closed the session".into())),
        }
    }
}
