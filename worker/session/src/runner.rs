//! The thread that runs tasks, with its own rayon pool. A plain thread and not one of tokio's: a task that
//! will not stop must not keep the process from ending.
//!
//! A task that is asked to stop looks up often, but not everywhere: a library decodes a file, an optimiser takes a step. So
//! it is given a moment, and then left: the session hears that it was stopped, and the next task waits until the one that
//! was left has noticed. What it may still write in between is what any worker may write: whole, and the same bytes.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError, channel},
    },
    time::{Duration, Instant},
};

use tokio::sync::mpsc;
use tracing::{Span, info};

use crate::{
    AgentError, Control, Executor, Output, Task, TaskError, allow::StorePrefixes, log::Collector,
};

/// How long a task may take to notice that it shall stop before it is left.
const NOTICE: Duration = Duration::from_millis(500);
/// How often it is looked at whether a task shall stop.
const LOOK: Duration = Duration::from_millis(20);

type Job = (Task, Arc<Control>, Span);
type Ended = Result<Output, TaskError>;

/// Hands tasks to the executor, one at a time.
pub(crate) struct Runner {
    jobs: std::sync::mpsc::Sender<Job>,
    results: mpsc::UnboundedReceiver<Ended>,
    log: Arc<Collector>,
}

/// What runs a task.
struct Means {
    executor: Arc<dyn Executor>,
    allowed: StorePrefixes,
    pool: rayon::ThreadPool,
}

impl Runner {
    /// Starts the thread and a pool of `threads`. Tasks that touch what is not `allowed` fail without being run.
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
                        // It ends sooner or later; its result is nobody's.
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

    /// Begins `task`, within `span`. Its result comes from [`Runner::finished`].
    pub(crate) fn begin(&self, task: Task, control: Arc<Control>, span: Span) {
        self.jobs
            .send((task, control, span))
            .expect("the executor's thread lives as long as its runner: it catches every panic");
    }

    /// What the task in hand logs.
    pub(crate) fn log(&self) -> &Collector {
        &self.log
    }

    /// Waits for the task in hand. Safe to cancel; pends for ever while none is.
    pub(crate) async fn finished(&mut self) -> Ended {
        self.results
            .recv()
            .await
            .expect("the executor's thread lives as long as its runner: it catches every panic")
    }
}

/// Runs a task on the pool; its result comes once.
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
        .unwrap_or_else(|panic| Err(TaskError::Crash(said(panic.as_ref()))));
        // Its time ends here, and not with the answer to its report.
        drop(span);
        // Nobody listens where it was left and the worker is gone.
        let _ = outbox.send(ended);
    });
    result
}

/// Waits for a task's end; `None` where it was asked to stop and has not noticed. One that saves what it has done may take
/// its time, if anybody wants that.
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

/// What a panic said.
fn said(panic: &(dyn Any + Send)) -> String {
    let text = panic
        .downcast_ref::<&str>()
        .map(|s| (*s).to_owned())
        .or_else(|| panic.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "no message".into());
    format!("the executor panicked: {text}; the worker's own log has the place")
}

#[cfg(test)]
mod tests;
