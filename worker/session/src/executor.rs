//! The interface between the session and the work: an [`Executor`] runs a task and returns
//! its result.

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
    messages::{Check, Examine, TaskAt},
    spec::StageSpec,
};

/// One task to run.
#[derive(Debug, Clone)]
pub struct Task {
    /// The job.
    pub job: JobId,
    /// The stage. Its lists contain only the entries that the lease's tasks need.
    pub spec: Arc<StageSpec>,
    /// The stage's key.
    pub stage: StageKey,
    /// Task index; if tasks are scenes, also the scene's index in the data set.
    pub index: u64,
}

impl Task {
    /// Returns the key of the task's result.
    pub fn key(&self) -> TaskKey {
        task_key(&self.stage, self.index)
    }
}

/// A finished task, with its output durably in the store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Output {
    /// SHA-256 of the manifest, in hexadecimal.
    pub manifest_sha256: String,
    /// Size of the published objects in bytes.
    pub bytes: u64,
    /// Whether the output already existed, so that nothing was computed.
    pub adopted: bool,
}

/// A reason why a task did not finish. The text is for people.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TaskError {
    /// Its own input or settings are wrong, so retrying elsewhere will not help.
    #[error("{0}")]
    User(String),
    /// The executor crashed.
    #[error("{0}")]
    Crash(String),
    /// The task is valid, but this machine has a problem.
    #[error("{0}")]
    Interrupted(String),
    /// The task is valid, but its store is unreachable or not writable.
    #[error("{0}")]
    Store(String),
    /// The task is valid and its store reachable, but an object in it is damaged or missing.
    #[error("{0}")]
    Damaged(String),
    /// [`Control::stop`] was called.
    #[error("stopped on request")]
    Stopped,
}

/// Runs tasks. It is called on threads of the worker's own rayon pools and may block. A task runs
/// alone, unless [`Executor::together`] allows others like it at the same time. A panic counts as
/// [`TaskError::Crash`], and the worker continues.
pub trait Executor: Send + Sync + 'static {
    /// Returns the supported kinds of tasks, each with its code version.
    fn kinds(&self) -> BTreeMap<String, String>;

    /// Returns the fingerprints of the available furniture.
    fn assets(&self) -> Vec<String>;

    /// Returns the names of the GPUs in use.
    fn gpus(&self) -> Vec<String> {
        Vec::new()
    }

    /// Returns how many tasks like this one may run at the same time on a worker with `threads`. 1
    /// means that the task uses all of them.
    fn together(&self, _task: &Task, _threads: usize) -> usize {
        1
    }

    /// Checks what tasks need from this machine. The places are allowed. It may block, and runs
    /// while tasks run.
    fn examine(&self, _what: &Examine) -> Vec<Check> {
        Vec::new()
    }

    /// Runs `task` to its end, reports its progress to `control`, and stops on request.
    ///
    /// # Errors
    /// [`TaskError`], by the cause of the failure.
    fn run(&self, task: &Task, control: &Control) -> Result<Output, TaskError>;
}

/// The link between the session and the running task: its progress, and whether it must stop.
pub struct Control {
    begun: Instant,
    /// Bits of an f32 in [0, 1]. For non-negative floats, the bits have the same order as the
    /// values.
    fraction: AtomicU32,
    at: Mutex<TaskAt>,
    stop: AtomicBool,
    /// Whether the task's progress is not wanted either.
    unwanted: AtomicBool,
    /// The expected identities of stores, by place.
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
    /// Returns a control for a task that expects these identities of stores, by place.
    pub fn expecting(stores: &BTreeMap<String, String>) -> Self {
        Self {
            stores: stores.clone(),
            ..Self::default()
        }
    }

    /// Returns the identity that the store at a place must have, if the task expects one.
    pub fn identity(&self, place: &str) -> Option<&str> {
        let identity = self.stores.get(place.trim_end_matches('/'))?;
        Some(identity)
    }

    /// Returns the places of stores with an expected identity.
    pub fn identified(&self) -> impl Iterator<Item = &str> {
        self.stores.keys().map(String::as_str)
    }

    /// Returns how long the task has been running.
    pub fn elapsed(&self) -> Duration {
        self.begun.elapsed()
    }

    /// Sets the task's progress, in [0, 1]; a smaller value than before changes nothing. Returns
    /// `false` if the task must stop.
    pub fn at(&self, fraction: f32) -> bool {
        let bits = fraction.clamp(0.0, 1.0).to_bits();
        if !fraction.is_nan() {
            self.fraction.fetch_max(bits, Ordering::Relaxed);
        }
        !self.stopped()
    }

    /// Sets a description of the task's current activity: a text, and named figures.
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

    /// Returns the task's progress and current activity.
    pub fn progress(&self) -> (f32, TaskAt) {
        let at = self.at.lock().expect("no panic while locked").clone();
        (self.fraction(), at)
    }

    /// Returns the completed fraction in [0, 1].
    pub fn fraction(&self) -> f32 {
        f32::from_bits(self.fraction.load(Ordering::Relaxed))
    }

    /// Asks the task to stop as soon as possible.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Asks the task to stop as soon as possible without saving its progress, because another
    /// worker has the task or nobody wants it.
    pub fn give_up(&self) {
        self.unwanted.store(true, Ordering::Relaxed);
        self.stop();
    }

    /// Returns whether the task's progress is unwanted.
    pub fn unwanted(&self) -> bool {
        self.unwanted.load(Ordering::Relaxed)
    }

    /// Returns whether the task must stop.
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
