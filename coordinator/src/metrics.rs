//! Metrics for Prometheus, counted when the actor makes changes durable, and read without the
//! actor. No metric is global: each coordinator has its own.

use std::{
    fmt::{Display, Write},
    sync::atomic::{AtomicU64, Ordering::Relaxed},
    time::Duration,
};

use picofarm_catalog::Changes;
use picofarm_proto::model::{EventKind, FailureKind, TaskCounts};

use crate::{
    VERSION,
    auth::METHODS,
    connections::Counts,
    core::{Say, SessionId},
    memory::Used,
};

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
    /// Histograms in the order of [`METHODS`]; the last one is for all other methods.
    calls: Vec<Histogram>,
}

impl Default for Metrics {
    fn default() -> Self {
        let calls = (0..=METHODS.len()).map(|_| Histogram::new(SECONDS));
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
    pub(crate) fn note(&mut self, changes: &Changes, say: &[(SessionId, Say)]) {
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
        let refused = |(_, say): &&(SessionId, Say)| {
            matches!(
                say,
                Say::Acknowledge {
                    accepted: false,
                    ..
                }
            )
        };
        self.refused += say.iter().filter(refused).count() as u64;
    }
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
        let at = METHODS.iter().position(|(method, _)| *method == path);
        self.calls[at.unwrap_or(METHODS.len())].observe(took.as_secs_f64());
    }

    /// Returns the text for Prometheus. `gauges` is missing if the catalog cannot be read.
    pub(crate) fn page(
        &self,
        gauges: Option<Gauges>,
        connections: Counts,
        memory: Used,
        ready: bool,
    ) -> String {
        let mut page = Page(String::with_capacity(16 << 10));
        page.family(
            "build_info",
            "gauge",
            "Version of this coordinator; always 1.",
        );
        page.sample("build_info", &[("version", VERSION)], 1);
        page.one(
            "ready",
            "gauge",
            "Whether the catalog answers (1) or not (0), as /readyz says.",
            u8::from(ready),
        );
        if let Some(gauges) = gauges {
            page.gauges(&gauges);
        }
        page.connections(connections);
        page.memory(memory);
        self.counters(&mut page);
        self.histograms(&mut page);
        page.0
    }

    fn counters(&self, page: &mut Page) {
        page.one(
            "leases_granted_total",
            "counter",
            "Leases granted to workers.",
            self.granted.load(Relaxed),
        );
        page.one(
            "leases_expired_total",
            "counter",
            "Leases taken back because nothing was heard of their worker.",
            self.expired.load(Relaxed),
        );
        let name = "tasks_committed_total";
        page.family(
            name,
            "counter",
            "Results committed: computed (adopted=\"false\"), or found in the store by a worker (adopted=\"true\").",
        );
        page.sample(name, &[("adopted", "false")], self.computed.load(Relaxed));
        page.sample(name, &[("adopted", "true")], self.adopted.load(Relaxed));
        let name = "task_failures_total";
        page.family(
            name,
            "counter",
            "Failed attempts by kind: user (the task's own fault), crash (the worker was lost or broke), interrupted (free).",
        );
        page.sample(name, &[("kind", "user")], self.user.load(Relaxed));
        page.sample(name, &[("kind", "crash")], self.crash.load(Relaxed));
        page.sample(
            name,
            &[("kind", "interrupted")],
            self.interrupted.load(Relaxed),
        );
        page.one(
            "tasks_dead_total",
            "counter",
            "Tasks given up.",
            self.dead.load(Relaxed),
        );
        page.one(
            "reports_refused_total",
            "counter",
            "Reports of workers that were refused because their lease was no longer live.",
            self.refused.load(Relaxed),
        );
    }

    fn histograms(&self, page: &mut Page) {
        page.family(
            "catalog_commit_seconds",
            "histogram",
            "Time of a commit to the catalog.",
        );
        page.histogram("catalog_commit_seconds", None, &self.commit);
        page.family(
            "batch_messages",
            "histogram",
            "Messages handled in one commit.",
        );
        page.histogram("batch_messages", None, &self.batch);
        page.family(
            "task_seconds",
            "histogram",
            "Time of a computed task on its worker.",
        );
        page.histogram("task_seconds", None, &self.task);
        let name = "grpc_request_seconds";
        page.family(
            name,
            "histogram",
            "Time to the answer of a gRPC call, of a stream to its beginning.",
        );
        let methods = METHODS
            .iter()
            .map(|(path, _)| path.trim_start_matches("/picofarm.v1."));
        for (method, calls) in methods.chain(["other"]).zip(&self.calls) {
            page.histogram(name, Some(("method", method)), calls);
        }
    }
}

/// A page under construction. Label values come from fixed sets, so nothing needs escaping.
struct Page(String);

impl Page {
    fn connections(&mut self, counts: Counts) {
        self.one(
            "connections",
            "gauge",
            "Open connections to the gRPC port.",
            counts.open,
        );
        self.one(
            "connections_refused_total",
            "counter",
            "Connections to the gRPC port that were refused: as many were open as there may be.",
            counts.refused,
        );
        self.one(
            "connections_displaced_total",
            "counter",
            "Connections closed before their first request, to make room for others.",
            counts.displaced,
        );
    }

    fn memory(&mut self, used: Used) {
        self.one(
            "request_memory_bytes",
            "gauge",
            "Memory that requests and answers are charged with.",
            used.requests,
        );
        self.one(
            "request_memory_most_bytes",
            "gauge",
            "The most memory that requests and answers were charged with since the start.",
            used.most,
        );
        self.one(
            "request_memory_limit_bytes",
            "gauge",
            "Memory that requests and answers may take now: less with more connections and jobs.",
            used.allowed,
        );
        self.one(
            "job_memory_bytes",
            "gauge",
            "Memory that the specs of jobs are charged with that have not ended.",
            used.jobs,
        );
        self.one(
            "requests_refused_total",
            "counter",
            "Requests and workers' messages refused for lack of memory.",
            used.refused,
        );
    }

    fn family(&mut self, name: &str, kind: &str, help: &str) {
        let _ = writeln!(
            self.0,
            "# HELP picofarm_{name} {help}\n# TYPE picofarm_{name} {kind}"
        );
    }

    fn sample(&mut self, name: &str, labels: &[(&str, &str)], value: impl Display) {
        let _ = write!(self.0, "picofarm_{name}");
        for (i, (label, text)) in labels.iter().enumerate() {
            let _ = write!(
                self.0,
                "{}{label}=\"{text}\"",
                if i == 0 { '{' } else { ',' }
            );
        }
        let end = if labels.is_empty() { "" } else { "}" };
        let _ = writeln!(self.0, "{end} {value}");
    }

    fn one(&mut self, name: &str, kind: &str, help: &str, value: impl Display) {
        self.family(name, kind, help);
        self.sample(name, &[], value);
    }

    fn gauges(&mut self, gauges: &Gauges) {
        let Gauges { tasks, jobs, .. } = gauges;
        self.family(
            "tasks",
            "gauge",
            "Tasks of active jobs by state. Of the whole farm: every coordinator of a catalog says the same.",
        );
        for (state, count) in [
            ("pending", tasks.pending),
            ("leased", tasks.leased),
            ("done", tasks.done),
            ("dead", tasks.dead),
        ] {
            self.sample("tasks", &[("state", state)], count);
        }
        self.one(
            "tasks_pending",
            "gauge",
            "Tasks that wait for workers: what to scale workers by. Of the whole farm.",
            tasks.pending,
        );
        self.one(
            "tasks_ready",
            "gauge",
            "Tasks that could be leased now; those that wait after a failure are not among them. Of the whole farm, \
             without what other coordinators have claimed.",
            gauges.ready,
        );
        self.one(
            "jobs_active",
            "gauge",
            "Jobs that have not ended. Of the whole farm.",
            jobs,
        );
        self.one(
            "workers",
            "gauge",
            "Workers connected to this coordinator.",
            gauges.workers,
        );
        self.one(
            "coordinators",
            "gauge",
            "Coordinators of the catalog that are alive. Of the whole farm.",
            gauges.instances,
        );
    }

    fn histogram(&mut self, name: &str, label: Option<(&str, &str)>, histogram: &Histogram) {
        let labels: Vec<_> = label.into_iter().collect();
        let mut count = 0;
        for (at, counted) in histogram.counts.iter().enumerate() {
            count += counted.load(Relaxed);
            let bound = histogram
                .bounds
                .get(at)
                .map_or_else(|| "+Inf".to_owned(), f64::to_string);
            let labels = [&labels[..], &[("le", &*bound)]].concat();
            self.sample(&format!("{name}_bucket"), &labels, count);
        }
        let sum = f64::from_bits(histogram.sum.load(Relaxed));
        self.sample(&format!("{name}_sum"), &labels, sum);
        self.sample(&format!("{name}_count"), &labels, count);
    }
}

#[cfg(test)]
mod tests;
