//! The audit log records who submitted, cancelled, paused, retried or drained something, or tried
//! to. Each line goes to the coordinator's own log at once (target `picofarm::audit`) and into the
//! catalog, where `picofarm audit` reads it.

use std::{
    collections::{HashMap, VecDeque},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use picofarm_catalog::{Catalog, NewAudit};
use picofarm_proto::{
    ids::JobId,
    messages::{
        Act, Outcome,
        audit::{DETAIL_BYTES, WHO_BYTES},
    },
    show,
};
use tokio::sync::{mpsc, oneshot};
use tonic::{Code, Status};

use crate::core::Clock;

/// The name of callers if no authentication is required.
pub(crate) const ANYONE: &str = "anyone";
/// The name in lines without a caller. No caller can have it.
pub(crate) const COORDINATOR: &str = "(coordinator)";
/// Lines that may wait to be written.
const QUEUE: usize = 4_096;
/// Lines written at a time.
const BATCH: usize = 256;
/// Refused attempts of one caller listed in a window. Further ones are only counted.
const REFUSED: u32 = 60;
const WINDOW: Duration = Duration::from_secs(60);
/// Most callers with counted refused attempts.
const CALLERS: usize = 1_024;
/// Delay before a failed write is tried again.
const AGAIN: Duration = Duration::from_secs(1);
/// Longest time that an answer waits for its line to be written.
const PATIENCE: Duration = Duration::from_secs(2);
/// Interval between removals of old lines.
const FORGET: Duration = Duration::from_secs(3_600);

/// The sending end of the audit log.
#[derive(Clone)]
pub(crate) struct Audit {
    lines: mpsc::Sender<QueuedLine>,
    floods: Arc<Mutex<HashMap<String, Flood>>>,
    clock: Clock,
}

/// The receiving end, which writes the lines.
pub(crate) struct Writer(mpsc::Receiver<QueuedLine>);

struct QueuedLine {
    new: NewAudit,
    /// Notified when the line was written, or cannot be written now.
    tried: Option<oneshot::Sender<()>>,
}

/// Refused attempts of one caller.
struct Flood {
    since: Instant,
    listed: u32,
    unlisted: u64,
}

impl Audit {
    /// Returns both ends. Lines wait until the writer runs.
    pub(crate) fn new(clock: Clock) -> (Self, Writer) {
        let (lines, queue) = mpsc::channel(QUEUE);
        let audit = Self {
            lines,
            floods: Arc::default(),
            clock,
        };
        (audit, Writer(queue))
    }

    /// Records an act, and waits until it is written or cannot be written now.
    pub(crate) async fn record<T>(
        &self,
        who: &str,
        act: Act,
        job: Option<JobId>,
        answer: &Result<T, Status>,
        done: &str,
    ) {
        let (outcome, detail) = match answer {
            Ok(_) => (Outcome::Done, done),
            Err(status) => (outcome(status), status.message()),
        };
        let Some(new) = self.line(who, act, job, outcome, detail) else {
            return;
        };
        let (tried, heard) = oneshot::channel();
        let line = QueuedLine {
            new,
            tried: Some(tried),
        };
        // If the writer is gone, the coordinator is stopping.
        if let Ok(Ok(())) = tokio::time::timeout(PATIENCE, self.lines.send(line)).await {
            let _ = tokio::time::timeout(PATIENCE, heard).await;
        }
    }

    /// Records an act without waiting.
    pub(crate) fn note(&self, who: &str, act: Act, outcome: Outcome, detail: &str) {
        if let Some(new) = self.line(who, act, None, outcome, detail)
            && self
                .lines
                .try_send(QueuedLine { new, tried: None })
                .is_err()
        {
            tracing::error!("the audit log's queue is full: a line is in this log only");
        }
    }

    /// Logs and returns the line; `None` if there are too many like it.
    fn line(
        &self,
        who: &str,
        act: Act,
        job: Option<JobId>,
        outcome: Outcome,
        detail: &str,
    ) -> Option<NewAudit> {
        let who = bounded(who, WHO_BYTES);
        let unlisted = match outcome {
            Outcome::Refused => self.unlisted(&who)?,
            Outcome::Done | Outcome::Failed => 0,
        };
        let mut detail = bounded(detail, DETAIL_BYTES);
        if unlisted > 0 {
            detail = format!(
                "{detail} ({unlisted} earlier refused attempts of this caller are not listed)"
            );
        }
        // Without authentication nobody can be held to account.
        if who == ANYONE {
            tracing::debug!(target: "picofarm::audit", who, act = act.name(), job = job.map(tracing::field::display),
                outcome = outcome.name(), "{detail}");
        } else {
            tracing::info!(target: "picofarm::audit", who, act = act.name(), job = job.map(tracing::field::display),
                outcome = outcome.name(), "{detail}");
        }
        Some(NewAudit {
            at_ms: self.clock.now_ms(),
            who,
            act,
            job,
            outcome,
            detail,
        })
    }

    /// Returns how many refused attempts of this caller were omitted before this one; `None` if
    /// this one is omitted too.
    fn unlisted(&self, who: &str) -> Option<u64> {
        let mut floods = self.floods.lock().expect("no panic while locked");
        let now = Instant::now();
        if floods.len() >= CALLERS && !floods.contains_key(who) {
            floods.retain(|_, flood| now - flood.since < WINDOW);
            if floods.len() >= CALLERS {
                return None;
            }
        }
        let fresh = Flood {
            since: now,
            listed: 0,
            unlisted: 0,
        };
        let flood = floods.entry(who.to_owned()).or_insert(fresh);
        if now - flood.since >= WINDOW {
            (flood.since, flood.listed) = (now, 0);
        }
        if flood.listed >= REFUSED {
            flood.unlisted += 1;
            return None;
        }
        flood.listed += 1;
        Some(std::mem::take(&mut flood.unlisted))
    }
}

/// Converts the status of an answer to the outcome of the attempt.
fn outcome(status: &Status) -> Outcome {
    match status.code() {
        Code::Unavailable | Code::Internal | Code::Unknown | Code::Cancelled | Code::Aborted => {
            Outcome::Failed
        }
        _ => Outcome::Refused,
    }
}

/// Returns one line of text with at most `most` bytes.
fn bounded(text: &str, most: usize) -> String {
    let line = show::line(text);
    match line.len() <= most {
        true => line.into_owned(),
        false => format!("{}…", &line[..line.floor_char_boundary(most - "…".len())]),
    }
}

impl Writer {
    /// Writes lines until every [`Audit`] is dropped, and removes lines older than `keep`. While
    /// the catalog fails, lines wait and no caller waits for them.
    pub(crate) async fn run(mut self, catalog: Arc<dyn Catalog>, keep: Duration, clock: Clock) {
        let mut forget = tokio::time::interval(FORGET);
        let mut again = tokio::time::interval(AGAIN);
        let mut arrived = Vec::with_capacity(BATCH);
        let mut waiting = UnwrittenLines::default();
        loop {
            tokio::select! {
                n = self.0.recv_many(&mut arrived, BATCH) => {
                    if n == 0 {
                        waiting.write(&*catalog).await;
                        return;
                    }
                    let mut tried = Vec::new();
                    for line in arrived.drain(..) {
                        waiting.lines.push_back(line.new);
                        tried.extend(line.tried);
                    }
                    if !waiting.failing {
                        waiting.write(&*catalog).await;
                    }
                    waiting.shorten();
                    for waits in tried {
                        let _ = waits.send(());
                    }
                }
                _ = again.tick(), if waiting.failing => waiting.write(&*catalog).await,
                _ = forget.tick() => {
                    let before = clock.now_ms() - i64::try_from(keep.as_millis()).unwrap_or(i64::MAX);
                    match catalog.forget_audit(before).await {
                        Ok(0) => {}
                        Ok(lines) => tracing::info!(lines, "old lines of the audit log are removed"),
                        Err(error) => tracing::warn!(%error, "old lines of the audit log stay for now"),
                    }
                }
            }
        }
    }
}

/// Lines that are not written yet.
#[derive(Default)]
struct UnwrittenLines {
    lines: VecDeque<NewAudit>,
    /// Whether the last write failed.
    failing: bool,
}

impl UnwrittenLines {
    async fn write(&mut self, catalog: &dyn Catalog) {
        while !self.lines.is_empty() {
            let some = self.lines.len().min(BATCH);
            let lines = &self.lines.make_contiguous()[..some];
            if let Err(error) = catalog.audit(lines).await {
                if !self.failing {
                    tracing::error!(%error, "the audit log cannot be written; its lines wait");
                }
                self.failing = true;
                return;
            }
            self.lines.drain(..some);
        }
        self.failing = false;
    }

    /// Drops the oldest lines if there are too many.
    fn shorten(&mut self) {
        let over = self.lines.len().saturating_sub(QUEUE);
        if over > 0 {
            self.lines.drain(..over);
            tracing::error!(
                lines = over,
                "lines of the audit log are in this log only: the catalog took none for too long"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(audit: &Audit, who: &str) -> Option<NewAudit> {
        audit.line(who, Act::Cancel, None, Outcome::Refused, "no")
    }

    #[tokio::test]
    async fn a_flood_of_refused_attempts_is_counted_and_acts_are_always_listed() {
        let (audit, _writer) = Audit::new(Clock::new(|| 7));
        for _ in 0..REFUSED {
            assert!(refused(&audit, "eve").is_some());
        }
        for _ in 0..5 {
            assert!(refused(&audit, "eve").is_none());
        }
        assert!(refused(&audit, "bob").is_some());
        let done = audit.line("eve", Act::Submit, None, Outcome::Done, "x");
        assert_eq!(done.unwrap().at_ms, 7);
        let long_ago = Instant::now().checked_sub(2 * WINDOW).unwrap();
        audit.floods.lock().unwrap().get_mut("eve").unwrap().since = long_ago;
        let next = refused(&audit, "eve").unwrap().detail;
        assert!(next.starts_with("no (5 earlier"), "{next}");
    }

    #[test]
    fn texts_are_one_line_and_bounded() {
        let text = bounded(
            &format!("a\n\u{1b}[2J\0{}", "ü".repeat(3_000)),
            DETAIL_BYTES,
        );
        assert!(
            text.len() <= DETAIL_BYTES && text.ends_with('…'),
            "{}",
            text.len()
        );
        assert!(text.starts_with("a\\n\\u{1b}[2J\\u{0}ü"), "{text}");
    }
}
