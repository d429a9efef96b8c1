//! The seam between the session and the work: one [`Executor`] runs one task at a time and says how it ended.

use std::{
    collections::BTreeMap,
    fmt,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use picofarm_proto::{
    ids::JobId,
    key::{StageKey, TaskKey, task_key},
    model::{StageSpec, TaskAt},
};

/// One task to run.
#[derive(Debug, Clone)]
pub struct Task {
    /// The job.
    pub job: JobId,
    /// Its stage; of lists as much as the lease's tasks need.
    pub spec: Arc<StageSpec>,
    /// The stage's key.
    pub stage: StageKey,
    /// Task index; where tasks are scenes, also the scene's index in the data set.
    pub index: u64,
}

impl Task {
    /// Names the result.
    pub fn key(&self) -> TaskKey {
        task_key(&self.stage, self.index)
    }
}

/// A finished task: its output is in the store for good.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Output {
    /// SHA-256 of the manifest, hexadecimal.
    pub manifest_sha256: String,
    /// Bytes published.
    pub bytes: u64,
    /// It was there already and nothing was computed.
    pub adopted: bool,
}

/// Why a task did not finish; the text is for people.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TaskError {
    /// Its own input or settings: trying again elsewhere will not help.
    #[error("{0}")]
    User(String),
    /// The executor broke down.
    #[error("{0}")]
    Crash(String),
    /// Nothing is wrong with the task, but with this machine.
    #[error("{0}")]
    Interrupted(String),
    /// Nothing is wrong with the task: its store cannot be reached, or takes nothing.
    #[error("{0}")]
    Store(String),
    /// Nothing is wrong with the task: its store answers, but an object in it is damaged or missing.
    #[error("{0}")]
    Damaged(String),
    /// [`Control::stop`] was called.
    #[error("stopped on request")]
    Stopped,
}

/// Runs tasks. Called on a thread of the worker's own rayon pool, one task at a time; it may block. A panic
/// counts as [`TaskError::Crash`] and the worker lives on.
pub trait Executor: Send + Sync + 'static {
    /// The kinds of task that it runs, each with the version of its code.
    fn kinds(&self) -> BTreeMap<String, String>;

    /// Fingerprints of the furniture at hand.
    fn assets(&self) -> Vec<String>;

    /// The graphics processors that it has opened, as they call themselves.
    fn gpus(&self) -> Vec<String> {
        Vec::new()
    }

    /// Runs `task` to its end, reporting its progress to `control`, and stops when asked to.
    ///
    /// # Errors
    /// [`TaskError`], by who is to blame.
    fn run(&self, task: &Task, control: &Control) -> Result<Output, TaskError>;
}

/// Between the session and the running task: how far it is, and whether it is still wanted.
pub struct Control {
    begun: Instant,
    /// Bits of an f32 in [0, 1]: for non-negative floats the order of the bits is that of the values.
    fraction: AtomicU32,
    at: Mutex<TaskAt>,
    stop: AtomicBool,
    /// What it has done is not wanted either.
    unwanted: AtomicBool,
    /// The identities of stores by their places.
    stores: BTreeMap<String, String>,
}

impl Default for Control {
    fn default() -> Self {
        Self {
            begun: Instant::now(),
            fraction: AtomicU32::default(),
            at: Mutex::default(),
            stop: AtomicBool::default(),
            unwanted: AtomicBool::default(),
            stores: BTreeMap::new(),
        }
    }
}

impl Control {
    /// For a task that expects these identities of stores, by their places.
    pub fn expecting(stores: &BTreeMap<String, String>) -> Self {
        Self {
            stores: stores.clone(),
            ..Self::default()
        }
    }

    /// The identity that the store at a place must have, if the task expects one.
    pub fn identity(&self, place: &str) -> Option<&str> {
        let identity = self.stores.get(place.trim_end_matches('/'))?;
        Some(identity)
    }

    /// The places of stores that must have an identity.
    pub fn identified(&self) -> impl Iterator<Item = &str> {
        self.stores.keys().map(String::as_str)
    }

    /// How long the task has been running.
    pub fn elapsed(&self) -> Duration {
        self.begun.elapsed()
    }

    /// Tells how far the task is, in [0, 1]; a smaller value than before changes nothing. `false` if the
    /// task shall stop.
    pub fn at(&self, fraction: f32) -> bool {
        let bits = fraction.clamp(0.0, 1.0).to_bits();
        if !fraction.is_nan() {
            self.fraction.fetch_max(bits, Ordering::Relaxed);
        }
        !self.stopped()
    }

    /// Says what the task is at: in words, and in figures with names.
    pub fn say(&self, text: String, figures: &[(&str, f64)]) {
        let figures = figures
            .iter()
            .map(|(name, value)| ((*name).to_owned(), *value));
        let at = TaskAt {
            text,
            figures: figures.collect(),
        };
        *self.at.lock().expect("no panic while locked") = at.limited();
    }

    /// How far the task is, and what it is at.
    pub fn progress(&self) -> (f32, TaskAt) {
        let at = self.at.lock().expect("no panic while locked").clone();
        (self.fraction(), at)
    }

    /// Share done in [0, 1].
    pub fn fraction(&self) -> f32 {
        f32::from_bits(self.fraction.load(Ordering::Relaxed))
    }

    /// Asks the task to stop as soon as it can.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Asks the task to stop as soon as it can, and to save nothing: it is another worker's, or nobody's.
    pub fn give_up(&self) {
        self.unwanted.store(true, Ordering::Relaxed);
        self.stop();
    }

    /// Whether nobody waits for what it has done.
    pub fn unwanted(&self) -> bool {
        self.unwanted.load(Ordering::Relaxed)
    }

    /// Whether the task shall stop.
    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

impl fmt::Debug for Control {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Control")
            .field("fraction", &self.fraction())
            .field("stopped", &self.stopped())
            .finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_never_goes_back_and_stays_within_its_bounds() {
        let control = Control::default();
        for f in [0.5, 0.2, f32::NAN, -3.0] {
            assert!(control.at(f));
        }
        assert_eq!(control.fraction(), 0.5);
        control.at(7.0);
        assert_eq!(control.fraction(), 1.0);
        control.stop();
        assert!(!control.at(1.0));
    }
}
