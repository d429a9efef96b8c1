//! The states of tasks, from the events of their jobs. A job's history is read once, and later only
//! its new events, so that the page of a job with many tasks costs the coordinator little.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use picofarm_proto::{
    ids::JobId,
    messages::{Event, EventKind},
};
use tokio::sync::OwnedMutexGuard;

use crate::{App, Events, answer::Problem};

/// Most jobs whose history is in memory.
const JOBS: usize = 48;
/// Events of a request, the most that a coordinator gives.
const PAGE: u32 = 1000;
/// Time after which no further request is made for a page; the rest is read for the next one.
const PATIENCE: Duration = Duration::from_millis(150);
/// Most tasks of a stage that are kept; no coordinator takes as many by default.
const TASKS: u64 = 20_000_000;

/// How a task stands, as far as its events tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Known {
    /// Neither done nor dead.
    Open,
    /// Computed.
    Done,
    /// Found in the store.
    Reused,
    /// Failed too often.
    Dead,
}

/// Failures with messages that differ only in numbers.
#[derive(Debug, Clone)]
pub struct Failures {
    /// Their number.
    pub count: u64,
    /// The newest.
    pub last: Event,
}

/// The history of a job up to an event.
#[derive(Debug, Default)]
pub struct History {
    /// The last event that was read.
    last: u64,
    /// Number of events that were read.
    pub events: u64,
    /// Whether all events were read.
    pub whole: bool,
    stages: BTreeMap<u32, Vec<Known>>,
    failures: BTreeMap<String, Failures>,
}

/// The histories of the jobs that were looked at, the least recent first.
#[derive(Default)]
pub struct Histories(Mutex<VecDeque<Held>>);

type Held = (JobId, Arc<tokio::sync::Mutex<History>>);

impl Histories {
    fn of_job(&self, job: JobId) -> Arc<tokio::sync::Mutex<History>> {
        let mut all = self.0.lock().expect("no holder panics");
        let found = all.iter().position(|(id, _)| *id == job);
        let held = found.and_then(|at| all.remove(at));
        let held = held.unwrap_or_else(|| (job, Arc::default()));
        let history = Arc::clone(&held.1);
        all.push_back(held);
        if all.len() > JOBS {
            all.pop_front();
        }
        history
    }
}

/// Returns a job's history, with its new events. A long one may not be whole yet.
///
/// # Errors
/// Fails if the coordinator does not answer.
pub async fn read(app: &App, job: JobId) -> Result<OwnedMutexGuard<History>, Problem> {
    let mut history = app.histories.of_job(job).lock_owned().await;
    let start = Instant::now();
    loop {
        let page = app.farm.events(Events {
            job: Some(job),
            after: history.last,
            limit: PAGE,
            ..Events::default()
        });
        let page = page.await?;
        history.add(&page);
        history.whole = page.len() < PAGE as usize;
        if history.whole || start.elapsed() > PATIENCE {
            return Ok(history);
        }
    }
}

impl History {
    /// Returns how the tasks of a stage stand. Later tasks are open.
    pub fn stage(&self, position: u32) -> &[Known] {
        self.stages.get(&position).map_or(&[], Vec::as_slice)
    }

    /// Returns the failures by message, the most frequent first.
    pub fn failures(&self) -> Vec<&Failures> {
        let mut groups: Vec<_> = self.failures.values().collect();
        groups.sort_by_key(|group| std::cmp::Reverse(group.count));
        groups
    }

    fn add(&mut self, page: &[Event]) {
        for event in page {
            self.last = self.last.max(event.sequence);
            self.events += 1;
            self.task(event);
            if matches!(event.kind, EventKind::Failed | EventKind::Dead) {
                let group = self.failures.entry(shape(&event.message));
                let group = group.or_insert_with(|| Failures {
                    count: 0,
                    last: event.clone(),
                });
                group.count += 1;
                group.last = event.clone();
            }
        }
    }

    fn task(&mut self, event: &Event) {
        let known = match event.kind {
            EventKind::Committed => Known::Done,
            EventKind::Reused => Known::Reused,
            EventKind::Dead => Known::Dead,
            EventKind::Retried => Known::Open,
            _ => return,
        };
        let (lo, hi) = match (event.task, event.lo, event.hi) {
            (Some(task), _, _) => (task, task.saturating_add(1)),
            (None, Some(lo), Some(hi)) => (lo, hi),
            _ => return,
        };
        let (Some(stage), true) = (event.stage, lo < hi && hi <= TASKS) else {
            return;
        };
        let tasks = self.stages.entry(stage).or_default();
        if tasks.len() < hi as usize {
            tasks.resize(hi as usize, Known::Open);
        }
        for task in &mut tasks[lo as usize..hi as usize] {
            // Of a range of tasks that are tried again, only the dead ones change.
            if event.kind != EventKind::Retried || *task == Known::Dead {
                *task = known;
            }
        }
    }
}

/// A message with its numbers replaced: failures with equal shapes are one group.
fn shape(message: &str) -> String {
    let mut text = String::with_capacity(message.len());
    for c in message.chars() {
        match c {
            '0'..='9' if text.ends_with('#') => {}
            '0'..='9' => text.push('#'),
            c => text.push(c),
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(sequence: u64, kind: EventKind, lo: u64, hi: u64, message: &str) -> Event {
        Event {
            sequence,
            at_ms: 0,
            job: "0190b5d8-0000-7000-8000-000000000000".parse().unwrap(),
            stage: Some(1),
            kind,
            task: (hi == lo + 1).then_some(lo),
            lo: Some(lo),
            hi: Some(hi),
            worker: String::new(),
            message: message.into(),
            seconds: 0.0,
        }
    }

    #[test]
    fn messages_that_differ_in_numbers_have_one_shape() {
        assert_eq!(shape("scene 12 of 340: full"), shape("scene 7 of 9: full"));
        assert_ne!(shape("scene 12: full"), shape("scene 12: empty"));
    }

    #[test]
    fn a_history_that_is_read_in_parts_is_that_of_all_events() {
        let events = [
            event(1, EventKind::Reused, 0, 3, ""),
            event(2, EventKind::Failed, 4, 5, "scene 4: full"),
            event(3, EventKind::Dead, 4, 5, "scene 5: full"),
            event(5, EventKind::Committed, 3, 4, ""),
            event(7, EventKind::Retried, 0, 6, ""),
        ];
        let read = |size: usize| {
            let mut history = History::default();
            events.chunks(size).for_each(|part| history.add(part));
            history
        };
        for size in [1, 2, 5] {
            let history = read(size);
            use Known::{Done, Open, Reused};
            assert_eq!(
                history.stage(1),
                [Reused, Reused, Reused, Done, Open, Open],
                "{size}"
            );
            assert_eq!((history.last, history.events), (7, 5));
            let failures = history.failures();
            assert_eq!((failures.len(), failures[0].count), (1, 2));
            assert_eq!(failures[0].last.sequence, 3);
            assert!(history.stage(0).is_empty());
        }
    }
}
