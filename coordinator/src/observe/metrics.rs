//! Metrics for Prometheus, counted when the actor makes changes durable, and read without the
//! actor. No metric is global: each coordinator has its own.

mod page;
#[cfg(test)]
mod tests;

use std::{
    sync::atomic::{AtomicU64, Ordering::Relaxed},
    time::Duration,
};

use picofarm_catalog::Changes;
use picofarm_proto::messages::{EventKind, FailureKind, TaskCounts};

use crate::core::{SessionId, ToWorker};

const SECONDS: &[f64] = &[
    0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0,
];
const TASK_SECONDS: &[f64] = &[
    0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0,
];
const MESSAGES: &[f64] = &[1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0];

/// Counts of observations by interval, and their sum.
struct Histogram {
    bounds: &'static [f64],
    /// One count for each bound, and one for observations beyond the last.
    counts: Vec<AtomicU64>,
    /// The bits of an `f64`.
    sum: AtomicU64,
}

impl Histogram {
    fn new(bounds: &'static [f64]) -> Self {
        let counts = (0..=bounds.len()).map(|_| AtomicU64::new(0));
        Self {
            bounds,
            counts: counts.collect(),
            sum: AtomicU64::new(0),
        }
    }

    fn observe(&self, value: f64) {
        let at = self.bounds.partition_point(|bound| *bound < value);
        self.counts[at].fetch_add(1, Relaxed);
        let add = |bits| Some((f64::from_bits(bits) + value).to_bits());
        let _ = self.sum.fetch_update(Relaxed, Relaxed, add);
    }
}

/// All counts since the start of the process.
pub(crate) struct Metrics {
    granted: AtomicU64,
    computed: AtomicU64,
    adopted: AtomicU64,
    refused: AtomicU64,
    user: AtomicU64,
    crash: AtomicU64,
    interrupted: AtomicU64,
    dead: AtomicU64,
    expired: AtomicU64,
    commit: Histogram,
    batch: Histogram,
    task: Histogram,
    /// Paths of the methods whose calls are counted apart.
    methods: Vec<&'static str>,
    /// Histograms in the order of `methods`; the last one is for all other methods.
    calls: Vec<Histogram>,
}

impl Metrics {
    /// Begins to count; the calls of these methods are counted apart.
    pub(crate) fn new(methods: impl IntoIterator<Item = &'static str>) -> Self {
        let methods: Vec<_> = methods.into_iter().collect();
        let calls = (0..=methods.len()).map(|_| Histogram::new(SECONDS));
        Self {
            granted: AtomicU64::default(),
            computed: AtomicU64::default(),
            adopted: AtomicU64::default(),
            refused: AtomicU64::default(),
            user: AtomicU64::default(),
            crash: AtomicU64::default(),
            interrupted: AtomicU64::default(),
            dead: AtomicU64::default(),
            expired: AtomicU64::default(),
            commit: Histogram::new(SECONDS),
            batch: Histogram::new(MESSAGES),
            task: Histogram::new(TASK_SECONDS),
            calls: calls.collect(),
            methods,
        }
    }
}

/// The counts of one commit, added once it is durable.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Tally {
    granted: u64,
    refused: u64,
    user: u64,
    crash: u64,
    interrupted: u64,
    dead: u64,
    expired: u64,
    adopted: u64,
    /// Seconds of each computed task.
    seconds: Vec<f64>,
}

impl Tally {
    /// Counts an accepted report of a failure.
    pub(crate) fn failed(&mut self, kind: FailureKind) {
        match kind {
            FailureKind::User => self.user += 1,
            FailureKind::Crash => self.crash += 1,
            FailureKind::Interrupted | FailureKind::Store | FailureKind::Damaged => {
                self.interrupted += 1;
            }
        }
    }

    /// Counts the core's decisions. Tasks that fail without a report were lost with their worker.
    pub(crate) fn note(&mut self, changes: &Changes, say: &[(SessionId, ToWorker)]) {
        let reported = self.user + self.crash;
        let mut failed = 0;
        for event in &changes.events {
            match event.kind {
                EventKind::Leased => self.granted += 1,
                EventKind::Expired => self.expired += 1,
                EventKind::Failed => failed += 1,
                EventKind::Dead => {
                    failed += 1;
                    self.dead += 1;
                }
                _ => {}
            }
        }
        self.crash += u64::saturating_sub(failed, reported);
        for output in &changes.outputs {
            if output.adopted {
                self.adopted += 1;
            } else {
                self.seconds.push(output.seconds);
            }
        }
        let refused = |(_, say): &&(SessionId, ToWorker)| {
            matches!(
                say,
                ToWorker::Acknowledge {
                    accepted: false,
                    ..
                }
            )
        };
        self.refused += say.iter().filter(refused).count() as u64;
    }
}

/// Counts of connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct ConnectionCounts {
    /// Open connections.
    pub open: u64,
    /// Connections refused because no place was free.
    pub refused: u64,
    /// Connections closed before their first request, to free a place.
    pub displaced: u64,
}

/// Values read from the catalog and the actor on request.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Gauges {
    /// Total tasks of the active jobs.
    pub tasks: TaskCounts,
    /// Tasks that could be leased now.
    pub ready: u64,
    pub jobs: u64,
    pub workers: u64,
    pub instances: u64,
}

impl Metrics {
    /// Adds the counts of a durable commit.
    pub(crate) fn add(&self, tally: &Tally) {
        let computed = tally.seconds.len() as u64;
        for (counter, by) in [
            (&self.granted, tally.granted),
            (&self.computed, computed),
            (&self.adopted, tally.adopted),
            (&self.refused, tally.refused),
            (&self.user, tally.user),
            (&self.crash, tally.crash),
            (&self.interrupted, tally.interrupted),
            (&self.dead, tally.dead),
            (&self.expired, tally.expired),
        ] {
            if by > 0 {
                counter.fetch_add(by, Relaxed);
            }
        }
        for seconds in &tally.seconds {
            self.task.observe(*seconds);
        }
    }

    /// Records the duration of a commit.
    pub(crate) fn committed(&self, took: Duration) {
        self.commit.observe(took.as_secs_f64());
    }

    /// Records the number of messages handled together.
    pub(crate) fn handled(&self, messages: usize) {
        self.batch.observe(messages as f64);
    }

    /// Records the time until a gRPC call was answered, or its stream begun.
    pub(crate) fn called(&self, path: &str, took: Duration) {
        let index = self.methods.iter().position(|method| *method == path);
        self.calls[index.unwrap_or(self.methods.len())].observe(took.as_secs_f64());
    }
}
