//! Reports whether a worker may run a stage's tasks, and which worker runs one.

/// Why a worker may not run a job's tasks, in words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NotEligible {
    /// Their store cannot be used now.
    Store(String),
    /// The jobs of the user use as many cores as they may.
    Quota(String),
    /// Anything else.
    Otherwise(String),
}

impl NotEligible {
    /// The words.
    pub fn words(&self) -> &str {
        match self {
            Self::Store(words) | Self::Quota(words) | Self::Otherwise(words) => words,
        }
    }
}

impl From<String> for NotEligible {
    fn from(words: String) -> Self {
        Self::Otherwise(words)
    }
}

impl From<&str> for NotEligible {
    fn from(words: &str) -> Self {
        Self::Otherwise(words.to_owned())
    }
}

/// A connected worker with regard to a job.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Name of the worker.
    pub name: String,
    /// Whether it may run the job's tasks, or why not.
    pub may_run: Result<(), NotEligible>,
    /// Bytes of memory that a task takes and that the worker has for it, where that is too little.
    pub lacks_memory: Option<(u64, u64)>,
    /// Expected duration of a task, milliseconds, if the worker ends earlier.
    pub lacks_time: Option<i64>,
    /// Whether the worker asks for work.
    pub idle: bool,
    /// Whether there is, or may be, a task for the worker now.
    pub gets: bool,
    /// Whether the worker runs a range that crashed other workers, and therefore gets nothing else.
    pub quarantined: bool,
    /// Milliseconds since the worker's last message, if longer than expected.
    pub silent_ms: Option<i64>,
}

/// The progress of a running task.
#[derive(Debug, Clone, PartialEq)]
pub struct RunningOn {
    /// Name of the task's worker.
    pub worker: String,
    /// Completed fraction in [0, 1].
    pub fraction: f32,
    /// The current step in the task's own words; may be empty.
    pub text: String,
    /// Unix time of the first report, milliseconds.
    pub since_ms: i64,
}
