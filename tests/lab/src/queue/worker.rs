//! A simulated worker without work. It takes leases, waits for the duration of a task, reports, and
//! retains its leases over reconnects, as a real worker does.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
    time::{Duration, Instant},
};

use picofarm_proto::{
    PROTOCOL,
    ids::{Incarnation, LeaseRef, WorkerId},
    key::{StageKey, task_key},
    messages::{Abilities, Finished, Lease, WorkerHello},
    wire::{
        self, farm_client::FarmClient, session_request::Message as Say,
        session_response::Message as Heard,
    },
};
use tokio::sync::mpsc;
use tokio_stream::wrappers::UnboundedReceiverStream;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::stats::Stats;

/// The renderer version that bench jobs request, so that no real worker takes them.
pub const RENDERER: &str = "bench";
/// Number of leases that a worker of no-op tasks has at a time, so that it never waits for one.
const IN_FLIGHT: u32 = 2;

pub struct Simulated {
    url: String,
    task: Duration,
    stats: Arc<Stats>,
    hello: WorkerHello,
    leases: VecDeque<Held>,
    /// Reported and not acknowledged.
    unacknowledged: BTreeMap<(LeaseRef, u64), Finished>,
    /// When the current task is done.
    done_at: Option<Instant>,
    /// Times of requests for leases that have not been received yet.
    asked: VecDeque<Instant>,
    /// Whether it has been connected before.
    welcomed: bool,
}

struct Held {
    lease: LeaseRef,
    stage: StageKey,
    next: u64,
    hi: u64,
}

enum End {
    Stopped,
    Lost,
    Refused(String),
}

impl Simulated {
    pub fn new(i: usize, url: String, task: Duration, stats: Arc<Stats>) -> Self {
        let hello = WorkerHello {
            id: WorkerId::from_uuid(Uuid::new_v4()),
            incarnation: Incarnation::from_uuid(Uuid::new_v4()),
            name: format!("simulated-{i}"),
            version: env!("CARGO_PKG_VERSION").into(),
            protocol: PROTOCOL,
            held: Vec::new(),
            ended: String::new(),
            ends_in_ms: None,
            abilities: Abilities {
                kinds: [("render".to_owned(), RENDERER.to_owned())].into(),
                cores: 1,
                ..Abilities::default()
            },
        };
        Self {
            url,
            task,
            stats,
            hello,
            leases: VecDeque::new(),
            unacknowledged: BTreeMap::new(),
            done_at: None,
            asked: VecDeque::new(),
            welcomed: false,
        }
    }

    /// Works until `stop`, and reconnects whenever the connection is lost.
    pub async fn live(mut self, stop: CancellationToken) {
        loop {
            match self.session(&stop).await {
                End::Stopped => return,
                End::Refused(why) => return self.stats.fail(why),
                End::Lost => {}
            }
            // Jittered, as in a real worker.
            let wait = Duration::from_millis(100 + u64::from(Uuid::new_v4().as_bytes()[0]));
            tokio::select! {
                () = tokio::time::sleep(wait) => {}
                () = stop.cancelled() => return,
            }
        }
    }

    async fn session(&mut self, stop: &CancellationToken) -> End {
        let Ok(mut client) = FarmClient::connect(self.url.clone()).await else {
            return End::Lost;
        };
        let (to, requests) = mpsc::unbounded_channel();
        let mut hello = self.hello.clone();
        hello.held = self.leases.iter().map(|h| h.lease).collect();
        let reported = self.unacknowledged.keys().map(|(lease, _)| *lease);
        hello.held.extend(reported);
        hello.held.sort_unstable();
        hello.held.dedup();
        say(&to, Say::Hello(hello.into()));
        let opened = client.session(UnboundedReceiverStream::new(requests)).await;
        let mut from = match opened {
            Ok(response) => response.into_inner(),
            Err(status)
                if status.code() == tonic::Code::Unavailable
                    || picofarm_tasks::lost_connection(&status) =>
            {
                return End::Lost;
            }
            Err(status) => return End::Refused(status.message().to_owned()),
        };
        let welcome = match from.message().await {
            Ok(Some(wire::SessionResponse {
                message: Some(Heard::Welcome(w)),
            })) => w,
            Ok(_) | Err(_) => return End::Lost,
        };
        // An attempt that failed before the first welcome is not a reconnect.
        self.stats.welcomed(self.welcomed);
        self.welcomed = true;
        for report in self.unacknowledged.values() {
            say(&to, Say::Done(report.clone().into()));
        }
        self.asked.clear();
        self.ask(&to);
        let mut beat = tokio::time::interval(Duration::from_millis(welcome.heartbeat_ms.into()));
        let mut beats = VecDeque::new();
        loop {
            let done_at = self
                .done_at
                .unwrap_or_else(|| Instant::now() + Duration::from_secs(3600));
            tokio::select! {
                heard = from.message() => match heard {
                    Ok(Some(wire::SessionResponse { message: Some(message) })) => {
                        if let Heard::Renewed(_) = &message
                            && let Some(sent) = beats.pop_front()
                        {
                            self.stats.beaten(Instant::elapsed(&sent));
                        }
                        if let Err(why) = self.heard(message, &to) {
                            return End::Refused(why);
                        }
                    }
                    _ => return End::Lost,
                },
                () = tokio::time::sleep_until(done_at.into()) => self.task_done(&to),
                _ = beat.tick() => {
                    beats.push_back(Instant::now());
                    let leases = self.leases.iter().map(|h| h.lease.into()).collect();
                    say(&to, Say::Heartbeat(wire::Heartbeat { leases, progress: Vec::new(), ends_in_ms: 0 }));
                }
                () = stop.cancelled() => return End::Stopped,
            }
        }
    }

    fn heard(&mut self, message: Heard, to: &Outgoing) -> Result<(), String> {
        match message {
            Heard::Lease(lease) => {
                let lease = Lease::try_from(lease).map_err(|e| e.to_string())?;
                if let Some(asked) = self.asked.pop_front() {
                    self.stats.leased(asked.elapsed());
                }
                self.leases.push_back(Held {
                    lease: lease.lease,
                    stage: lease.key,
                    next: lease.lo,
                    hi: lease.hi,
                });
                if self.task.is_zero() {
                    self.report_all(to);
                } else if self.done_at.is_none() {
                    self.done_at = Some(Instant::now() + self.task);
                }
            }
            Heard::Acknowledge(answer) => {
                let lease = answer
                    .lease
                    .ok_or("an acknowledgement without a lease")?
                    .try_into()
                    .map_err(|e| format!("{e}"))?;
                if self.unacknowledged.remove(&(lease, answer.index)).is_some() {
                    self.stats.acknowledged(answer.accepted);
                }
                if self.task.is_zero() {
                    self.leases.retain(|h| h.next < h.hi);
                    self.ask(to);
                }
            }
            Heard::Revoke(_) => self.stats.revoke(),
            Heard::Trim(trim) => {
                let lease = trim
                    .lease
                    .ok_or("a trimming without a lease")?
                    .try_into()
                    .map_err(|e| format!("{e}"))?;
                for held in self.leases.iter_mut().filter(|h| h.lease == lease) {
                    held.hi = held.hi.min(trim.hi);
                }
            }
            Heard::Renewed(_) | Heard::Welcome(_) | Heard::Drain(_) | Heard::Examine(_) => {}
        }
        Ok(())
    }

    /// Reports the current task as done, starts the next one, and requests leases if there is none.
    fn task_done(&mut self, to: &Outgoing) {
        self.done_at = None;
        if let Some(held) = self.leases.front_mut() {
            let (lease, stage, index) = (held.lease, held.stage, held.next);
            held.next += 1;
            if held.next == held.hi {
                self.leases.pop_front();
            }
            self.report(lease, &stage, index, to);
        }
        match self.leases.is_empty() {
            true => self.ask(to),
            false => self.done_at = Some(Instant::now() + self.task),
        }
    }

    fn report_all(&mut self, to: &Outgoing) {
        let mut all = Vec::new();
        for held in &mut self.leases {
            all.extend((held.next..held.hi).map(|index| (held.lease, held.stage, index)));
            held.next = held.hi;
        }
        for (lease, stage, index) in all {
            self.report(lease, &stage, index, to);
        }
    }

    fn report(&mut self, lease: LeaseRef, stage: &StageKey, index: u64, to: &Outgoing) {
        let key = task_key(stage, index);
        let report = Finished {
            lease,
            index,
            key,
            manifest_sha256: key.to_string(),
            bytes: 1,
            seconds: self.task.as_secs_f64().max(1e-4),
            adopted: false,
            traceparent: String::new(),
            shared: 1,
        };
        say(to, Say::Done(report.clone().into()));
        self.unacknowledged.insert((lease, index), report);
    }

    /// Requests the missing leases.
    fn ask(&mut self, to: &Outgoing) {
        let wanted = match self.task.is_zero() {
            // Leases with unacknowledged reports count as work in progress.
            true if self.unacknowledged.len() > 1024 => 0,
            true => IN_FLIGHT,
            false => u32::from(self.leases.is_empty()),
        };
        let missing = wanted.saturating_sub(self.asked.len() as u32);
        if missing > 0 {
            say(to, Say::Credit(wire::Credit { leases: missing }));
            self.asked.extend((0..missing).map(|_| Instant::now()));
        }
    }
}

type Outgoing = mpsc::UnboundedSender<wire::SessionRequest>;

fn say(to: &Outgoing, message: Say) {
    // A closed connection is noticed when reading from it.
    let _ = to.send(wire::SessionRequest {
        message: Some(message),
    });
}
