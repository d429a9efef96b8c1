//! A thread that runs tasks, with its own rayon pool. It is a plain thread instead of a tokio
//! thread, because a task that does not stop must not prevent the process from ending.
//!
//! A task checks for stop requests often, but not everywhere: a library may be decoding a file, or
//! an optimiser taking a step. Therefore it is given a moment, and then abandoned: the session is
//! told that it stopped, and the next task waits until the abandoned one has noticed. Until then it
//! may still write, but only what any worker may write: whole objects with the same bytes.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError, channel},
    },
    task::{Context, Poll},
    time::{Duration, Instant},
};

use tokio::sync::mpsc;
use tracing::{Span, info};

use crate::{
    AgentError, Control, Executor, Output, Task, TaskError, allow::StorePrefixes, log::Collector,
};

/// Maximum time for a task to notice a stop request before it is abandoned.
const NOTICE: Duration = Duration::from_millis(500);
/// Interval for checking whether a task must stop.
const LOOK: Duration = Duration::from_millis(20);

type Job = (Task, Arc<Control>, Span);
type Ended = Result<Output, TaskError>;

/// Passes tasks to the executor, one at a time.
pub(crate) struct Runner {
    jobs: std::sync::mpsc::Sender<Job>,
    results: mpsc::UnboundedReceiver<Ended>,
    log: Arc<Collector>,
}

/// Everything needed to run a task.
struct Means {
    executor: Arc<dyn Executor>,
    allowed: StorePrefixes,
    pool: rayon::ThreadPool,
}

impl Runner {
    /// Starts the thread and a pool of `threads`. Tasks that access places other than those
    /// `allowed` fail without being run.
    pub(crate) fn start(
        executor: Arc<dyn Executor>,
        threads: usize,
        allowed: StorePrefixes,
    ) -> Result<Self, AgentError> {
        let failed = |reason: String| AgentError::Threads { threads, reason };
        let log = Arc::new(Collector::default());
        let (ours, theirs) = (log.clone(), log.clone());
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("render-{i}"))
            .start_handler(move |_| theirs.serve())
            .build()
            .map_err(|e| failed(e.to_string()))?;
        let means = Arc::new(Means {
            executor,
            allowed,
            pool,
        });
        let (jobs, inbox) = channel::<Job>();
        let (outbox, results) = mpsc::unbounded_channel();
        std::thread::Builder::new()
            .name("executor".into())
            .spawn(move || {
                ours.serve();
                let mut left: Option<Receiver<Ended>> = None;
                for (task, control, span) in inbox {
                    if let Some(left) = left.take() {
                        // It ends sooner or later; its result is discarded.
                        let _ = left.recv();
                    }
                    ours.begin();
                    let saves = task.spec.task.resumes();
                    let running = begin(&means, task, control.clone(), span);
                    let result = match wait(&running, &control, saves) {
                        Some(ended) => ended,
                        None => {
                            info!("the task has not noticed yet that it shall stop; it is left");
                            left = Some(running);
                            Err(TaskError::Stopped)
                        }
                    };
                    if outbox.send(result).is_err() {
                        return;
                    }
                }
            })
            .map_err(|e| failed(e.to_string()))?;
        Ok(Self { jobs, results, log })
    }

    /// Begins `task`, within `span`. [`Runner::poll_finished`] returns its result.
    pub(crate) fn begin(&self, task: Task, control: Arc<Control>, span: Span) {
        self.jobs
            .send((task, control, span))
            .expect("the executor's thread lives as long as its runner: it catches every panic");
    }

    /// Returns the log of the running task.
    pub(crate) fn log(&self) -> &Collector {
        &self.log
    }

    /// Returns the result of the running task once it has ended; pending while no task is running.
    pub(crate) fn poll_finished(&mut self, context: &mut Context<'_>) -> Poll<Ended> {
        self.results.poll_recv(context).map(|ended| {
            ended
                .expect("the executor's thread lives as long as its runner: it catches every panic")
        })
    }
}

/// Runs a task on the pool. Its result is sent exactly once.
fn begin(means: &Arc<Means>, task: Task, control: Arc<Control>, span: Span) -> Receiver<Ended> {
    let (outbox, result) = channel();
    let theirs = means.clone();
    means.pool.spawn(move || {
        let ended = catch_unwind(AssertUnwindSafe(|| {
            let Means {
                executor, allowed, ..
            } = &*theirs;
            allowed
                .check(&task.spec, task.index)
                .map_err(TaskError::User)?;
            let _in = span.enter();
            executor.run(&task, &control)
        }))
        .unwrap_or_else(|panic| Err(TaskError::Crash(panic_message(panic.as_ref()))));
        // The span's time ends here, and not with the answer to the report.
        drop(span);
        // There is no receiver if the task was abandoned and the worker has ended.
        let _ = outbox.send(ended);
    });
    result
}

/// Waits for a task's end. Returns `None` if it was asked to stop and has not noticed. A task that
/// saves its progress may take longer, if the progress is wanted.
fn wait(running: &Receiver<Ended>, control: &Control, saves: bool) -> Option<Ended> {
    let mut asked: Option<Instant> = None;
    loop {
        match running.recv_timeout(LOOK) {
            Ok(ended) => return Some(ended),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                let what = "the executor ended without a word".into();
                return Some(Err(TaskError::Crash(what)));
            }
        }
        let over = control.stopped() && (!saves || control.unwanted());
        if over && asked.get_or_insert_with(Instant::now).elapsed() >= NOTICE {
            return None;
        }
    }
}

/// Returns the message of a panic.
fn panic_message(panic: &(dyn Any + Send)) -> String {
    let text = panic
        .downcast_ref::<&str>()
        .map(|s| (*s).to_owned())
        .or_else(|| panic.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "no message".into());
    format!("the executor panicked: {text}; the worker's own log has the place")
}

#[cfg(test)]
mod tests;
