//! The lanes on which tasks run. A task that uses all threads of the worker runs alone, in the
//! first lane. Several small tasks of one stage run at the same time, each in a lane with threads
//! of its own, because one of them cannot use all threads, and waits for its store in between.

use std::{future::poll_fn, sync::Arc, task::Poll};

use picofarm_proto::{ids::LeaseRef, messages::TaskAt};
use tracing::Span;

use crate::{
    AgentError, Control, Executor, Output, Task, TaskError,
    allow::StorePrefixes,
    assignments::CurrentTask,
    log::{Collector, TaskLine},
    runner::Runner,
};

/// The lanes, of which the first has all threads.
pub(crate) struct Lanes {
    executor: Arc<dyn Executor>,
    threads: usize,
    allowed: StorePrefixes,
    lanes: Vec<Lane>,
}

struct Lane {
    runner: Runner,
    threads: usize,
    running: Option<Running>,
}

/// A running task.
struct Running {
    lease: LeaseRef,
    index: u64,
    control: Arc<Control>,
}

impl Lanes {
    /// Starts the first lane, with `threads`. Tasks that access places other than those `allowed`
    /// fail without being run.
    ///
    /// # Errors
    /// [`AgentError::Threads`].
    pub(crate) fn start(
        executor: Arc<dyn Executor>,
        threads: usize,
        allowed: StorePrefixes,
    ) -> Result<Self, AgentError> {
        let mut lanes = Self {
            executor,
            threads,
            allowed,
            lanes: Vec::new(),
        };
        let first = lanes.lane(threads)?;
        lanes.lanes.push(first);
        Ok(lanes)
    }

    fn lane(&self, threads: usize) -> Result<Lane, AgentError> {
        let runner = Runner::start(self.executor.clone(), threads, self.allowed.clone())?;
        Ok(Lane {
            runner,
            threads,
            running: None,
        })
    }

    /// Returns how many tasks like this one may run at the same time.
    pub(crate) fn together(&self, task: &Task) -> usize {
        self.executor.together(task, self.threads).max(1)
    }

    /// Begins a task, within `span`, in a free lane.
    ///
    /// # Errors
    /// [`AgentError::Threads`].
    pub(crate) fn begin(
        &mut self,
        task: Task,
        lease: LeaseRef,
        control: Arc<Control>,
        span: Span,
    ) -> Result<(), AgentError> {
        let together = self.together(&task);
        let free = self.lanes.iter().position(|lane| lane.running.is_none());
        let at = free.unwrap_or(self.lanes.len());
        if at > 0 {
            let threads = (self.threads / together).max(1);
            if at == self.lanes.len() {
                let lane = self.lane(threads)?;
                self.lanes.push(lane);
            } else if self.lanes[at].threads != threads {
                self.lanes[at] = self.lane(threads)?;
            }
        }
        let lane = &mut self.lanes[at];
        lane.running = Some(Running {
            lease,
            index: task.index,
            control: control.clone(),
        });
        lane.runner.begin(task, control, span);
        Ok(())
    }

    /// Waits for the end of a running task. Returns its lease, its index, its last log lines and
    /// its result. Cancel-safe; it never returns while no task is running.
    pub(crate) async fn finished(
        &mut self,
    ) -> (LeaseRef, u64, Vec<TaskLine>, Result<Output, TaskError>) {
        let (lane, result) = poll_fn(|context| {
            for (at, lane) in self.lanes.iter_mut().enumerate() {
                if let Poll::Ready(result) = lane.runner.poll_finished(context) {
                    return Poll::Ready((at, result));
                }
            }
            Poll::Pending
        })
        .await;
        let lane = &mut self.lanes[lane];
        let running = lane.running.take().expect("only a running task ends");
        let lines = lane.runner.log().end();
        (running.lease, running.index, lines, result)
    }

    /// Returns the log lines of the running tasks since the last call, with lease and index.
    pub(crate) fn logs(&self) -> impl Iterator<Item = (LeaseRef, u64, Vec<TaskLine>)> {
        let running = |lane: &Lane| {
            let running = lane.running.as_ref()?;
            let log: &Collector = lane.runner.log();
            Some((running.lease, running.index, log.take()))
        };
        self.lanes.iter().filter_map(running)
    }

    /// Returns the progress and the current activity of a running task.
    pub(crate) fn progress(&self, task: &CurrentTask) -> (f32, TaskAt) {
        let control = self.control(task);
        control.map(Control::progress).unwrap_or_default()
    }

    /// Returns the control of a running task.
    pub(crate) fn control(&self, task: &CurrentTask) -> Option<&Control> {
        let running = self.lanes.iter().filter_map(|lane| lane.running.as_ref());
        let mut same = running.filter(|r| (r.lease, r.index) == (task.lease, task.task.index));
        same.next().map(|running| &*running.control)
    }

    /// Asks all running tasks to stop.
    pub(crate) fn stop(&self) {
        for running in self.lanes.iter().filter_map(|lane| lane.running.as_ref()) {
            running.control.stop();
        }
    }

    /// Asks the running tasks of a lease to stop without saving their progress.
    pub(crate) fn give_up(&self, lease: LeaseRef) {
        let running = self.lanes.iter().filter_map(|lane| lane.running.as_ref());
        for running in running.filter(|running| running.lease == lease) {
            running.control.give_up();
        }
    }
}
