//! The thread that runs tasks, with its own rayon pool. A plain thread and not one of tokio's: a task that
//! will not stop must not keep the process from ending.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
};

use tokio::sync::mpsc;
use tracing::Span;

use super::{Control, Executor, Output, Task, TaskError};
use crate::{AgentError, allow::StorePrefixes, log::Collector};

type Job = (Task, Arc<Control>, Span);

/// Hands tasks to the executor, one at a time.
pub(crate) struct Runner {
    jobs: std::sync::mpsc::Sender<Job>,
    results: mpsc::UnboundedReceiver<Result<Output, TaskError>>,
    log: Arc<Collector>,
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
        let (jobs, inbox) = std::sync::mpsc::channel::<Job>();
        let (outbox, results) = mpsc::unbounded_channel();
        std::thread::Builder::new()
            .name("executor".into())
            .spawn(move || {
                ours.serve();
                for (task, control, span) in inbox {
                    ours.begin();
                    let result = catch_unwind(AssertUnwindSafe(|| {
                        allowed
                            .check(&task.spec, task.index)
                            .map_err(TaskError::User)?;
                        pool.install(|| {
                            let _in = span.enter();
                            executor.run(&task, &control)
                        })
                    }))
                    .unwrap_or_else(|panic| Err(TaskError::Crash(said(panic.as_ref()))));
                    // Its time ends here, and not with the answer to its report.
                    drop(span);
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
    pub(crate) async fn finished(&mut self) -> Result<Output, TaskError> {
        self.results
            .recv()
            .await
            .expect("the executor's thread lives as long as its runner: it catches every panic")
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
