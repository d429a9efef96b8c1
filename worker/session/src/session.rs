//! One connection to the coordinator: opening it, saying hello, passing messages.
//!
//! # Why nothing is lost, and why the outbox may live in memory
//! The order of every task is compute → publish → report → commit. *Publish* ends with the manifest, which
//! is written last, create-only, and is a pure function of the task's key. From that moment the task is
//! finished for good: the manifest **is** the durable outbox. If this process is killed before the report
//! is acknowledged, the lease expires, somebody else gets the task, finds the manifest under the task's
//! key and adopts it instead of rendering again. The reports kept in memory ([`crate::outbox`]) only spare that
//! detour when the process lives and the connection does not.
//!
//! # Self-fencing
//! A lease that has not been renewed for two thirds of its time to live, on this machine's monotonic
//! clock, is *fenced*: no further task of it is **started** until the coordinator renews it ([`crate::assignments`]). A
//! task already running goes on and may publish, because publishing cannot do harm: the put is create-only
//! and an honest rival would have written the same bytes. What fencing prevents is waste: a worker cut off
//! from the farm working through a range that has long been given to another.
//!
//! A lease that a heartbeat's answer leaves out, or that is revoked after its time has run out here, is *lost*
//! (a laptop that slept, a coordinator long away): its waiting tasks are dropped and its running task goes on,
//! since its result can still be adopted. A lease revoked while its time still runs is not *wanted* any more
//! (a cancelled job): its running task is stopped.

use std::time::Duration;

use picofarm_proto::{
    model::WorkerHello,
    wire::{self, farm_client::FarmClient, session_request, session_response},
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::UnboundedReceiverStream;
use tonic::{Code, Status, Streaming};

use crate::{
    Access, AgentError, Target, Trouble, lost_connection,
    message::{Incoming, Outgoing},
};

/// How long a connection, and then the welcome, may take.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);
/// A connection that does not answer a ping within this time is dead.
const KEEPALIVE: Duration = Duration::from_secs(10);
/// A lease carries its job's spec; one that lists 100,000 scene files needs some 20 MB.
const MAX_MESSAGE: usize = 256 << 20;

/// Why a session did not open, or ended.
#[derive(Debug)]
pub(crate) enum LinkError {
    /// Try again later.
    Down(String),
    /// Somebody must repair a setting here or there.
    Mismatch(String),
    /// Trying again would not help.
    Refused(String),
}

impl From<Status> for LinkError {
    fn from(status: Status) -> Self {
        let text = match status.message() {
            "" => status.code().to_string(),
            message => message.to_owned(),
        };
        match status.code() {
            // Aborted: another process took this worker's id. Coming back would only throw that one out.
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

/// What the coordinator demands of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Welcome {
    /// Between two heartbeats.
    pub(crate) heartbeat: Duration,
    /// Life of a lease between renewals.
    pub(crate) lease: Duration,
}

/// An open session.
pub(crate) struct Session {
    to: mpsc::UnboundedSender<wire::SessionRequest>,
    from: Streaming<wire::SessionResponse>,
}

/// The coordinators of a list of URLs with commas between them.
pub(crate) fn targets(urls: &str, access: &Access) -> Result<Vec<Target>, AgentError> {
    urls.split(',')
        .map(|url| target(url.trim(), access))
        .collect()
}

/// Checks a coordinator's URL and what is needed to reach it, and sets how connections to it behave.
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

impl From<Trouble> for LinkError {
    fn from(trouble: Trouble) -> Self {
        match trouble {
            Trouble::Down(why) => Self::Down(why),
            Trouble::Mismatch(why) => Self::Mismatch(why),
        }
    }
}

/// Why a call at the start of a session failed: the coordinator's words, or what is wrong with the connection.
async fn failed(target: &Target, status: Status) -> LinkError {
    if lost_connection(&status) {
        target.trouble(&status).await.into()
    } else {
        status.into()
    }
}

/// Connects, says hello and waits for the welcome.
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
        Err(error) => return Err(target.trouble(&error).await.into()),
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
    /// Queues a message. A dead connection shows in [`Session::receive`], so nothing is said here.
    pub(crate) fn send(&self, message: Outgoing) {
        let _ = self.to.send(message.into());
    }

    /// The next message that can be understood. Safe to cancel.
    pub(crate) async fn receive(&mut self) -> Result<Incoming, LinkError> {
        match self.from.message().await? {
            Some(response) => Ok(Incoming::from_wire(response)),
            None => Err(LinkError::Down("the coordinator closed the session".into())),
        }
    }
}
