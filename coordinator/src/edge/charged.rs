//! The layer that charges requests and answers. It comes after the guard, so that no part of a
//! request's body is read before its caller is known.

use std::{
    collections::VecDeque,
    future::{Future, poll_fn},
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use bytes::Bytes;
use http_body::{Body as HttpBody, Frame, SizeHint};
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::{Status, body::Body};
use tower::{Layer, Service};

use super::connections::{ConnectionSlot, Peer};
use crate::{
    auth::Caller,
    memory::{Account, Charge, Charged, Memory, TWICE},
};

/// Largest message in either direction: a job of 100,000 scene files is about 15 MB.
pub(super) const MAX_MESSAGE_BYTES: usize = 64 << 20;
/// The only method with a stream of requests. Its messages are small.
const SESSION: &str = "/picofarm.v1.Farm/Session";
/// Length of a message's flags and length field.
const PREFIX: usize = 5;
/// Memory of an open request without its message: headers, task, buffers.
const CALL: u64 = 16 << 10;
/// Time limit for the beginning of a message.
const BEGINNING: Duration = Duration::from_secs(20);
/// Time limit for the rest of a message.
const WHOLE: Duration = Duration::from_secs(120);
/// Messages of a session up to this length are free, because memory is reserved for them.
const FREE: u64 = 16 << 10;
/// Parts of an answer longer than this must be received in time.
const LARGE: usize = 32 << 10;
/// Time limit for receiving a part, plus the same for each MiB.
const TAKEN: Duration = Duration::from_secs(30);

/// Charges requests.
#[derive(Clone)]
pub(crate) struct Charging(pub Arc<Memory>);

impl<S> Layer<S> for Charging {
    type Service = ChargedService<S>;

    fn layer(&self, inner: S) -> ChargedService<S> {
        ChargedService {
            inner,
            memory: Arc::clone(&self.0),
        }
    }
}

/// A service that charges its requests.
#[derive(Clone)]
pub(crate) struct ChargedService<S> {
    inner: S,
    memory: Arc<Memory>,
}

impl<S> Service<http::Request<Body>> for ChargedService<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>> + Clone + Send + 'static,
    S::Future: Send + 'static,
{
    type Response = S::Response;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        let slot = request.extensions().get::<Peer>().map(Peer::slot);
        let account = account(&self.memory, &request);
        // `self.inner` is the service that reported ready, so the clone replaces it.
        let ready = self.inner.clone();
        let mut inner = std::mem::replace(&mut self.inner, ready);
        if request.uri().path() == SESSION {
            let request = request.map(|body| Body::new(Messages::new(body, account)));
            return Box::pin(inner.call(request));
        }
        Box::pin(async move {
            let (mut parts, body) = request.into_parts();
            let (body, call, charge) = match begin(body, &account).await {
                Ok(begun) => begun,
                Err(refused) => return Ok(refused.into_http()),
            };
            parts.extensions.insert(account.clone().holding(charge));
            let request = http::Request::from_parts(parts, Body::new(body));
            let answer = inner.call(request).await?;
            Ok(answer.map(|body| {
                Body::new(Answer {
                    body,
                    account,
                    slot,
                    part: None,
                    _call: call,
                })
            }))
        })
    }
}

fn account<B>(memory: &Arc<Memory>, request: &http::Request<B>) -> Account {
    let (caller, peer) = (
        request.extensions().get::<Caller>(),
        request.extensions().get::<Peer>(),
    );
    let address = peer.map(|peer| Charged::Address(peer.address.ip().into()));
    let name = caller.map(|caller| Charged::Name(Arc::clone(&caller.name)));
    let unknown = caller.is_none_or(Caller::is_anyone);
    let who = match unknown {
        true => address.or(name),
        false => name,
    };
    let who = who.unwrap_or_else(|| Charged::Name("".into()));
    let connection = peer.map_or(u64::MAX, |peer| peer.slot().id());
    Account::new(Arc::clone(memory), who, connection)
}

/// Reads a request's body up to the length of its message, and charges that length.
async fn begin(mut body: Body, account: &Account) -> Result<(Begun, Charge, Charge), Status> {
    let mut first = VecDeque::new();
    let mut prefix = Vec::with_capacity(PREFIX);
    let reading = async {
        while prefix.len() < PREFIX {
            let Some(frame) = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await
            else {
                break;
            };
            let frame = frame?;
            if let Some(data) = frame.data_ref() {
                prefix.extend(data.iter().take(PREFIX - prefix.len()));
            }
            first.push_back(frame);
        }
        Ok::<_, Status>(())
    };
    let read = tokio::time::timeout(BEGINNING, reading).await;
    read.map_err(|_| {
        Status::deadline_exceeded("no message within 20 s of the request's headers")
    })??;
    let length = length(&prefix).unwrap_or(0);
    if length > MAX_MESSAGE_BYTES as u64 {
        return Err(Status::resource_exhausted(format!(
            "the message is {length} bytes long; at most {} are allowed",
            MAX_MESSAGE_BYTES
        )));
    }
    let call = account.charge("the request", CALL).await?;
    let charge = account.charge("the request", TWICE * length).await?;
    let begun = Begun {
        first,
        rest: body,
        late: Box::pin(tokio::time::sleep(WHOLE)),
    };
    Ok((begun, call, charge))
}

/// Returns the length in a message's prefix.
fn length(prefix: &[u8]) -> Option<u64> {
    let length: [u8; 4] = prefix.get(1..PREFIX)?.try_into().ok()?;
    Some(u32::from_be_bytes(length).into())
}

/// A request body after its beginning was read.
struct Begun {
    first: VecDeque<Frame<Bytes>>,
    rest: Body,
    late: Pin<Box<tokio::time::Sleep>>,
}

impl HttpBody for Begun {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if let Some(frame) = self.first.pop_front() {
            return Poll::Ready(Some(Ok(frame)));
        }
        match Pin::new(&mut self.rest).poll_frame(context) {
            Poll::Pending => self.late.as_mut().poll(context).map(|()| {
                Some(Err(Status::deadline_exceeded(
                    "the request's message did not arrive within 120 s",
                )))
            }),
            frame => frame,
        }
    }

    fn is_end_stream(&self) -> bool {
        self.first.is_empty() && self.rest.is_end_stream()
    }
}

/// The messages of a session as they arrive. The buffer keeps the size of the longest one.
struct Messages {
    body: Body,
    account: Account,
    prefix: Vec<u8>,
    /// Missing bytes of the current message.
    left: u64,
    longest: u64,
    charges: Vec<Charge>,
}

impl Messages {
    fn new(body: Body, account: Account) -> Self {
        Self {
            body,
            account,
            prefix: Vec::with_capacity(PREFIX),
            left: 0,
            longest: FREE,
            charges: Vec::new(),
        }
    }

    fn pass(&mut self, mut data: &[u8]) -> Result<(), Status> {
        while !data.is_empty() {
            if self.left > 0 {
                let some = self.left.min(data.len() as u64);
                self.left -= some;
                data = data.get(some as usize..).unwrap_or_default();
                continue;
            }
            let some = (PREFIX - self.prefix.len()).min(data.len());
            let (begin, rest) = data.split_at(some);
            self.prefix.extend_from_slice(begin);
            data = rest;
            if let Some(length) = length(&self.prefix) {
                self.prefix.clear();
                self.left = length;
                if length > self.longest {
                    let more = TWICE * (length - self.longest);
                    let charge = self.account.charge_now("a worker's message", more)?;
                    self.charges.push(charge);
                    self.longest = length;
                }
            }
        }
        Ok(())
    }
}

impl HttpBody for Messages {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let polled = Pin::new(&mut self.body).poll_frame(context);
        if let Poll::Ready(Some(Ok(frame))) = &polled
            && let Some(data) = frame.data_ref()
            && let Err(refused) = self.pass(data)
        {
            return Poll::Ready(Some(Err(refused)));
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }
}

/// An answer that keeps its request charged until it ends. Each part is charged until the next one
/// is requested.
struct Answer {
    body: Body,
    account: Account,
    slot: Option<Arc<ConnectionSlot>>,
    part: Option<(Charge, Option<DropGuard>)>,
    _call: Charge,
}

impl HttpBody for Answer {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        // The next part is requested only after the previous one was received.
        self.part = None;
        let polled = Pin::new(&mut self.body).poll_frame(context);
        if let Poll::Ready(Some(Ok(frame))) = &polled
            && let Some(data) = frame.data_ref()
        {
            let charge = self.account.count(data.len() as u64);
            let slot = self.slot.as_ref().filter(|_| data.len() > LARGE);
            let watched = slot.map(|slot| watch(Arc::clone(slot), data.len()));
            self.part = Some((charge, watched));
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// Ends a connection that does not receive a part of an answer, unless the value is dropped first.
fn watch(slot: Arc<ConnectionSlot>, bytes: usize) -> DropGuard {
    let taken = CancellationToken::new();
    let guard = taken.clone().drop_guard();
    let patience = TAKEN * u32::try_from(1 + (bytes >> 20)).unwrap_or(u32::MAX);
    tokio::spawn(async move {
        if tokio::time::timeout(patience, taken.cancelled())
            .await
            .is_err()
        {
            slot.hang_up();
        }
    });
    guard
}
