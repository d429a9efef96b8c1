//! Combined measurements of simulated workers.

use std::{
    sync::{
        Mutex,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};

use serde::Serialize;

/// Measurements shared by all workers of a fleet.
#[derive(Default)]
pub struct Stats {
    connected: AtomicU64,
    reconnects: AtomicU64,
    refused: AtomicU64,
    revoked: AtomicU64,
    measured: Mutex<Measured>,
}

#[derive(Default)]
struct Measured {
    first: Option<Instant>,
    last: Option<Instant>,
    lease: Vec<f64>,
    heartbeat: Vec<f64>,
    trouble: Option<String>,
}

/// Distribution of a duration, in milliseconds.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Latency {
    pub p50_ms: f64,
    pub p99_ms: f64,
    pub most_ms: f64,
}

/// Returns the distribution of durations, given in seconds.
pub fn latency(mut seconds: Vec<f64>) -> Latency {
    seconds.sort_by(f64::total_cmp);
    let at = |share: f64| {
        let last = seconds.len().saturating_sub(1) as f64;
        seconds
            .get((last * share).round() as usize)
            .map_or(0.0, |s| s * 1e3)
    };
    Latency {
        p50_ms: at(0.5),
        p99_ms: at(0.99),
        most_ms: at(1.0),
    }
}

impl Stats {
    fn measured(&self) -> std::sync::MutexGuard<'_, Measured> {
        self.measured.lock().expect("no panic while locked")
    }

    /// Records that a worker was welcomed. `again`: after a reconnect.
    pub fn welcomed(&self, again: bool) {
        match again {
            true => self.reconnects.fetch_add(1, Relaxed),
            false => self.connected.fetch_add(1, Relaxed),
        };
    }

    pub fn leased(&self, waited: Duration) {
        let mut measured = self.measured();
        measured.first.get_or_insert_with(Instant::now);
        measured.lease.push(waited.as_secs_f64());
    }

    pub fn beaten(&self, took: Duration) {
        self.measured().heartbeat.push(took.as_secs_f64());
    }

    pub fn acknowledged(&self, accepted: bool) {
        if !accepted {
            self.refused.fetch_add(1, Relaxed);
        }
        self.measured().last = Some(Instant::now());
    }

    pub fn revoke(&self) {
        self.revoked.fetch_add(1, Relaxed);
    }

    pub fn fail(&self, what: String) {
        self.measured().trouble.get_or_insert(what);
    }

    pub fn connected(&self) -> u64 {
        self.connected.load(Relaxed)
    }

    pub fn reconnects(&self) -> u64 {
        self.reconnects.load(Relaxed)
    }

    pub fn refused(&self) -> u64 {
        self.refused.load(Relaxed)
    }

    pub fn revoked(&self) -> u64 {
        self.revoked.load(Relaxed)
    }

    pub fn trouble(&self) -> Option<String> {
        self.measured().trouble.clone()
    }

    /// Returns the times of the first lease and of the last acknowledgement.
    pub fn span(&self) -> (Instant, Instant) {
        let measured = self.measured();
        let now = Instant::now();
        (measured.first.unwrap_or(now), measured.last.unwrap_or(now))
    }

    pub fn lease(&self) -> Latency {
        latency(self.measured().lease.clone())
    }

    pub fn heartbeat(&self) -> Latency {
        latency(self.measured().heartbeat.clone())
    }
}
