//! Service `Farm`: the session of a worker.

use std::{
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};

use futures::{Stream, TryStreamExt};
use picofarm_proto::{
    PROTOCOL, compatibility,
    convert::ConvertError,
    ids::LeaseRef,
    messages::WorkerHello,
    spec::bounds,
    wire::{
        self, farm_server::Farm, session_request::Message as From, session_response::Message as To,
    },
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::{
    beats::Beats,
    link::{Link, caller, invalid},
};
use crate::{
    actor::{Command, FromWorker, HeartbeatQueue},
    auth::{Caller, Quotas, WorkerIds},
    core::{SessionId, ToWorker, VERSION},
    edge::guard::SameMachine,
};

/// Time limit for a worker's hello.
const HELLO: Duration = Duration::from_secs(20);
/// Messages that may wait for a worker. A worker that reads none of them is disconnected.
const OUTBOX: usize = 16_384;

/// Most heartbeats of a session that wait for the actor, and the interval at which their number is
/// checked.
const BEATS: u32 = 4;
const PAUSE: Duration = Duration::from_millis(20);

pub(crate) struct FarmService {
    link: Link,
    quotas: Quotas,
    sessions: Arc<AtomicU64>,
    open: Arc<AtomicUsize>,
    ids: Arc<WorkerIds>,
}

impl FarmService {
    pub(crate) fn new(link: Link, quotas: Quotas) -> Self {
        Self {
            link,
            quotas,
            sessions: Arc::new(AtomicU64::new(1)),
            open: Arc::default(),
            ids: Arc::default(),
        }
    }

    /// Counts a session until the value is dropped.
    fn enter(&self) -> Result<Counted, Status> {
        let (open, most) = (Arc::clone(&self.open), self.quotas.sessions);
        let counted = Counted(open);
        if counted.0.fetch_add(1, Ordering::Relaxed) >= most {
            return Err(Status::resource_exhausted(format!(
                "{most} workers are connected, the most that --max-sessions allows"
            )));
        }
        Ok(counted)
    }
}

/// A counted session.
struct Counted(Arc<AtomicUsize>);

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Boxed, because a channel allocates room for 32 items from the start.
type Out = mpsc::Sender<Result<Box<wire::SessionResponse>, Status>>;

#[tonic::async_trait]
impl Farm for FarmService {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<wire::SessionResponse, Status>> + Send>>;

    async fn session(
        &self,
        request: Request<Streaming<wire::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let counted = self.enter()?;
        let session = self.sessions.fetch_add(1, Ordering::Relaxed);
        let (out, stream) = mpsc::channel(16);
        let (link, ids) = (self.link.clone(), Arc::clone(&self.ids));
        let caller = caller(&request);
        let here = request.extensions().get::<SameMachine>();
        let here = here.is_some_and(|same| same.0);
        tokio::spawn(async move {
            run(
                link,
                (session, here),
                caller,
                ids,
                request.into_inner(),
                out,
            )
            .await;
            drop(counted);
        });
        // The answer is immediate, because a client may wait for it before its hello.
        let stream = ReceiverStream::new(stream).map_ok(|response| *response);
        Ok(Response::new(Box::pin(stream)))
    }
}

async fn run(
    link: Link,
    (session, here): (SessionId, bool),
    caller: Caller,
    ids: Arc<WorkerIds>,
    mut input: Streaming<wire::SessionRequest>,
    out: Out,
) {
    let greeted = greeting(&mut input).await.and_then(|hello| {
        let held = ids.take(hello.id, &caller.name)?;
        Ok((hello, held))
    });
    let (hello, _held) = match greeted {
        Ok(greeted) => greeted,
        Err(status) => {
            tracing::warn!("a worker was refused: {}", status.message());
            let _ = out.send(Err(status)).await;
            return;
        }
    };
    let worker = hello.name.clone();
    let welcome = To::Welcome(wire::Welcome {
        coordinator_version: VERSION.into(),
        heartbeat_ms: link.heartbeat_ms,
        lease_ms: link.lease_ms,
    });
    if send(&out, welcome).await.is_err() {
        return;
    }
    tracing::info!(worker, session, caller = %caller.name, "worker connected");
    let (say, mut said) = mpsc::channel(OUTBOX);
    let waiting = HeartbeatQueue::default();
    let open = Command::Open {
        session,
        hello,
        say,
        waiting: waiting.clone(),
        here,
    };
    if link.commands.send(open).await.is_err() {
        return;
    }
    let beats = Beats::new(link.lease_ms);
    let listener = Listener {
        link: &link,
        session,
        waiting: &waiting,
        beats: &beats,
        out: &out,
    };
    let end = tokio::select! {
        end = listener.listen(&mut input) => end,
        end = speak(&mut said, &out, &beats) => end,
        revoked = caller.revoked() => Err(revoked),
        () = link.stop.cancelled() => Err(Status::unavailable("the coordinator is stopping; reconnect")),
    };
    tracing::info!(worker, session, "worker disconnected");
    // The actor is gone if the coordinator is stopping.
    let _ = link
        .commands
        .send(Command::Worker(session, FromWorker::Closed))
        .await;
    if let Err(status) = end {
        let _ = out.send(Err(status)).await;
    }
}

/// Reads the first message. Returns the hello if this worker may work here.
async fn greeting(input: &mut Streaming<wire::SessionRequest>) -> Result<WorkerHello, Status> {
    let first = tokio::time::timeout(HELLO, input.message())
        .await
        .map_err(|_| Status::deadline_exceeded("no hello within 20 s"))??;
    let Some(wire::SessionRequest {
        message: Some(From::Hello(hello)),
    }) = first
    else {
        return Err(Status::invalid_argument(
            "the first message of a session must be hello",
        ));
    };
    compatibility::serves(VERSION, &hello.version, hello.protocol).map_err(|why| {
        Status::failed_precondition(format!(
            "worker {} is picofarm version {} (protocol {}), the coordinator is picofarm version {VERSION} (protocol \
             {PROTOCOL}): {why}",
            bounds::quoted(&hello.name),
            bounds::cut(&hello.version, bounds::NAME_BYTES),
            hello.protocol
        ))
    })?;
    WorkerHello::try_from(hello).map_err(invalid)
}

/// Receives a worker's messages in its session.
struct Listener<'a> {
    link: &'a Link,
    session: SessionId,
    waiting: &'a HeartbeatQueue,
    beats: &'a Beats,
    out: &'a Out,
}

impl Listener<'_> {
    /// Forwards the worker's messages until it closes its side.
    async fn listen(&self, input: &mut Streaming<wire::SessionRequest>) -> Result<(), Status> {
        loop {
            let Some(request) = input.message().await? else {
                return Ok(());
            };
            if let Some(From::Examined(examined)) = request.message {
                let answer = (self.session, examined.into(), self.link.clock.now_ms());
                self.link.examinations.answered(answer).await;
                continue;
            }
            let said = match checked(request).map_err(invalid)? {
                Ok(said) => said,
                Err(why) => {
                    let session = self.session;
                    tracing::warn!(session, "a worker's log lines cannot be used: {why}");
                    continue;
                }
            };
            if let FromWorker::Heartbeat(leases, _, _) = &said
                && !self.beat(leases).await?
            {
                continue;
            }
            if matches!(said, FromWorker::Credit(0)) {
                self.beats.withdraw();
            }
            let command = Command::Worker(self.session, said);
            if self.link.commands.send(command).await.is_err() {
                return Err(Status::unavailable(
                    "the coordinator is stopping; reconnect",
                ));
            }
        }
    }

    /// Answers a heartbeat, if possible without the actor. Returns `false` if the actor need not
    /// receive it, because the previous one is still waiting.
    async fn beat(&self, leases: &[LeaseRef]) -> Result<bool, Status> {
        let answered = self.beats.answer(leases);
        let behind = self.waiting.count() > 0;
        // Waiting heartbeats are all in memory, and the number that a worker sends is not limited.
        while answered.is_none() && self.waiting.count() >= BEATS {
            tokio::time::sleep(PAUSE).await;
        }
        let pass_on = answered.is_none() || !behind;
        if pass_on {
            // This comes before the answer. From then on no lease of this session runs out until
            // the actor has handled the heartbeat.
            self.waiting.arrived();
            self.beats.tell(answered.clone());
        }
        if let Some(leases) = answered {
            let renewed = To::Renewed(wire::Renewed {
                leases: leases.into_iter().map(Into::into).collect(),
                ttl_ms: self.link.lease_ms,
            });
            send(self.out, renewed).await?;
        }
        Ok(pass_on)
    }
}

/// Checks a worker's message. An invalid report that names its task counts as that task's failure;
/// if it ended the session, the worker would send it again in the next one. Invalid log lines are
/// dropped (the inner error), because nobody waits for an answer to them.
///
/// # Errors
/// Returns an error for an empty message, which no worker of this version sends. It ends the
/// session.
fn checked(
    request: wire::SessionRequest,
) -> Result<Result<FromWorker, ConvertError>, ConvertError> {
    let lease = |lease: Option<wire::LeaseRef>| -> Result<LeaseRef, ConvertError> {
        lease
            .ok_or(ConvertError::Missing { field: "lease" })?
            .try_into()
    };
    let unusable = |about: Option<wire::LeaseRef>, index: u64, why: ConvertError| match lease(about)
    {
        Ok(lease) => Ok(FromWorker::Unusable(lease, index, why.to_string())),
        Err(why) => Err(why),
    };
    Ok(Ok(match request.message {
        None => return Err(ConvertError::Missing { field: "message" }),
        Some(From::Hello(_)) => {
            return Err(ConvertError::Invalid {
                field: "hello",
                what: "is only the first message of a session".into(),
            });
        }
        Some(From::Examined(_)) => {
            return Err(ConvertError::Invalid {
                field: "examined",
                what: "is answered before".into(),
            });
        }
        Some(From::Credit(credit)) => FromWorker::Credit(credit.leases),
        Some(From::Heartbeat(beat)) => FromWorker::Heartbeat(
            beat.leases
                .into_iter()
                .map(TryInto::try_into)
                .collect::<Result<_, _>>()?,
            beat.progress
                .into_iter()
                .map(TryInto::try_into)
                .collect::<Result<_, _>>()?,
            (beat.ends_in_ms > 0).then_some(beat.ends_in_ms),
        ),
        Some(From::Done(done)) => {
            let (about, index) = (done.lease.clone(), done.index);
            match done.try_into() {
                Ok(report) => FromWorker::Done(report),
                Err(why) => unusable(about, index, why)?,
            }
        }
        Some(From::Failed(failed)) => {
            let (about, index) = (failed.lease.clone(), failed.index);
            match failed.try_into() {
                Ok(failure) => FromWorker::Failed(failure),
                Err(why) => unusable(about, index, why)?,
            }
        }
        Some(From::Log(log)) => match log.try_into() {
            Ok(log) => FromWorker::Log(log),
            Err(why) => return Ok(Err(why)),
        },
        Some(From::Release(release)) => {
            FromWorker::Release(lease(release.lease)?, bounds::message(&release.reason))
        }
    }))
}

/// Sends the actor's messages to the worker until the actor ends the session.
async fn speak(
    said: &mut mpsc::Receiver<ToWorker>,
    out: &Out,
    beats: &Beats,
) -> Result<(), Status> {
    while let Some(say) = said.recv().await {
        for say in beats.hear(say) {
            send(out, message(say)?).await?;
        }
    }
    Err(Status::unavailable(
        "the coordinator let this session go; reconnect",
    ))
}

/// Converts a message of the actor to its wire form.
fn message(say: ToWorker) -> Result<To, Status> {
    Ok(match say {
        ToWorker::Lease(lease) => To::Lease((*lease).into()),
        ToWorker::Acknowledge {
            lease,
            index,
            accepted,
            reason,
        } => To::Acknowledge(wire::Acknowledge {
            lease: Some(lease.into()),
            index,
            accepted,
            reason,
        }),
        ToWorker::Renewed { leases, ttl_ms } => To::Renewed(wire::Renewed {
            leases: leases.into_iter().map(Into::into).collect(),
            ttl_ms,
        }),
        ToWorker::Revoke { lease, reason } => To::Revoke(wire::Revoke {
            lease: Some(lease.into()),
            reason,
        }),
        ToWorker::Trim { lease, hi } => To::Trim(wire::Trim {
            lease: Some(lease.into()),
            hi,
        }),
        ToWorker::Drain => To::Drain(wire::Drain {}),
        ToWorker::Examine(what) => To::Examine(what.into()),
        ToWorker::Replaced => {
            return Err(Status::aborted(
                "a newer session of this worker id took over; if that is another worker, give each its own id",
            ));
        }
    })
}

async fn send(out: &Out, message: To) -> Result<(), Status> {
    let response = wire::SessionResponse {
        message: Some(message),
    };
    out.send(Ok(Box::new(response)))
        .await
        .map_err(|_| Status::cancelled("the worker is gone"))
}
