//! Writes the metrics as text for Prometheus.

use std::{
    fmt::{Display, Write},
    sync::atomic::Ordering::Relaxed,
};

use super::{ConnectionCounts, Gauges, Histogram, Metrics};
use crate::{core::VERSION, memory::MemoryUse};

impl Metrics {
    /// Returns the text for Prometheus. `gauges` is missing if the catalog cannot be read.
    pub(crate) fn page(
        &self,
        gauges: Option<Gauges>,
        connections: ConnectionCounts,
        memory: MemoryUse,
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
        let methods = self
            .methods
            .iter()
            .map(|path| path.trim_start_matches("/picofarm.v1."));
        for (method, calls) in methods.chain(["other"]).zip(&self.calls) {
            page.histogram(name, Some(("method", method)), calls);
        }
    }
}

/// A page under construction. Label values come from fixed sets, so nothing needs escaping.
struct Page(String);

impl Page {
    fn connections(&mut self, counts: ConnectionCounts) {
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

    fn memory(&mut self, used: MemoryUse) {
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
