//! The parent of a worker process: starts it, notices its end, and starts the next one.
//!
//! Each worker has a thread that starts its processes and waits for them. The kernel signals a
//! child when the thread that started it dies, so this thread must live as long as the farm.

use std::{
    io::{BufRead, BufReader, Write},
    os::unix::process::ExitStatusExt,
    process::{Child, ChildStdin, ExitStatus, Stdio},
    sync::{Arc, Condvar, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use tokio::sync::oneshot;
use tracing::{error, info};

use crate::{
    commands::local_worker::{self, Order, STOP, Verdict},
    error::{CliError, Code, Result},
};

/// After a process with a shorter life than this, the next one starts only after a wait, which
/// doubles each time.
const SHORT_LIFE: Duration = Duration::from_secs(5);
const FIRST_WAIT: Duration = Duration::from_millis(100);
const LONGEST_WAIT: Duration = Duration::from_secs(10);

/// The parent of one worker.
pub(super) struct Keeper(Arc<Shared>);

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    stopped: Condvar,
}

#[derive(Default)]
struct State {
    /// No further process is started.
    stopping: bool,
    /// Standard input of the running process.
    stdin: Option<ChildStdin>,
}

impl Keeper {
    /// Starts a worker's thread and its first process. The receiver gets a message when the worker
    /// has ended for good: because it was asked to, or with the error that would also end any
    /// further process.
    ///
    /// # Errors
    /// Fails if the system cannot start a thread.
    pub fn start(order: Order) -> Result<(Self, oneshot::Receiver<Result<()>>)> {
        let shared = Arc::<Shared>::default();
        let (ended, receiver) = oneshot::channel();
        let theirs = Arc::clone(&shared);
        std::thread::Builder::new()
            .name(order.name.clone())
            .spawn(move || {
                // When the whole farm ends, nobody receives the message.
                let _ = ended.send(theirs.keep(order));
            })
            .map_err(|e| CliError::new(Code::Resource, format!("cannot start a thread: {e}")))?;
        Ok((Self(shared), receiver))
    }

    /// Tells the worker to stop. It hands back or finishes its tasks.
    pub fn stop(&self) {
        let mut state = self.0.lock();
        state.stopping = true;
        if let Some(stdin) = &mut state.stdin {
            // A process that has just ended does not read the line and does not need it.
            let _ = writeln!(stdin, "{STOP}").and_then(|()| stdin.flush());
        }
        self.0.stopped.notify_all();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn keep(&self, mut order: Order) -> Result<()> {
        let mut wait = FIRST_WAIT;
        loop {
            let began = Instant::now();
            let Some(child) = self.begin(&order)? else {
                return Ok(());
            };
            let (status, verdict) = self.end(child)?;
            if let Some(verdict) = verdict {
                return verdict.into();
            }
            order.ended = ending(status);
            if self.lock().stopping {
                return Ok(());
            }
            error!(
                worker = order.name,
                "the worker's process ended: {}; a new one is started", order.ended
            );
            if began.elapsed() >= SHORT_LIFE {
                wait = FIRST_WAIT;
                continue;
            }
            self.pause(wait);
            wait = (2 * wait).min(LONGEST_WAIT);
        }
    }

    /// Starts a process; `None` if the worker must stop.
    fn begin(&self, order: &Order) -> Result<Option<Child>> {
        let failed = |e: std::io::Error| {
            let what = format!("cannot start a process for the worker {}: {e}", order.name);
            CliError::new(Code::Resource, what)
        };
        let mut state = self.lock();
        if state.stopping {
            return Ok(None);
        }
        let mut child = crate::this_program()
            .map_err(failed)?
            .arg(local_worker::COMMAND)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let mut stdin = child.stdin.take().expect("asked for above");
        let text = serde_json::to_string(order).expect("an order is plain data");
        // A process that ends at once reports the reason at its end.
        if let Err(e) = writeln!(stdin, "{text}").and_then(|()| stdin.flush()) {
            info!(worker = order.name, error = %e, "the worker's process did not read its order");
        }
        state.stdin = Some(stdin);
        Ok(Some(child))
    }

    /// Waits for the end of a process. Returns its status, and its last line if it ended by itself.
    fn end(&self, mut child: Child) -> Result<(ExitStatus, Option<Verdict>)> {
        let failed = |e: std::io::Error| {
            CliError::new(
                Code::Failed,
                format!("cannot wait for a worker's process: {e}"),
            )
        };
        let stdout = child.stdout.take().expect("asked for at its start");
        let last = BufReader::new(stdout)
            .lines()
            .map_while(std::result::Result::ok)
            .last();
        let status = child.wait().map_err(failed)?;
        self.lock().stdin = None;
        let verdict = last.filter(|_| status.signal().is_none());
        Ok((
            status,
            verdict.and_then(|text| serde_json::from_str(&text).ok()),
        ))
    }

    /// Waits for a time, or until the worker must stop.
    fn pause(&self, wait: Duration) {
        let until = Instant::now() + wait;
        let mut state = self.lock();
        while !state.stopping {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            let waited = self.stopped.wait_timeout(state, left);
            state = waited.unwrap_or_else(std::sync::PoisonError::into_inner).0;
        }
    }
}

/// Describes the end of a process that did not report it, for the history of its current task.
fn ending(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(9), _) => "killed by signal 9: probably out of memory".into(),
        (Some(6), _) => {
            "aborted (signal 6): memory could not be had, or a stack overflowed; its last words are on stderr".into()
        }
        (Some(7), _) => "killed by signal 7: a disk or memory file gave out under it".into(),
        (Some(signal), _) => format!("killed by signal {signal}"),
        (None, Some(code)) => format!("ended with exit code {code} without a word"),
        (None, None) => "ended in an unknown way".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_end_by_a_signal_is_told_with_its_likely_cause() {
        let killed = ending(ExitStatus::from_raw(9));
        assert_eq!(killed, "killed by signal 9: probably out of memory");
        assert!(ending(ExitStatus::from_raw(6)).starts_with("aborted (signal 6)"));
        assert_eq!(ending(ExitStatus::from_raw(11)), "killed by signal 11");
        let code = ending(ExitStatus::from_raw(3 << 8));
        assert_eq!(code, "ended with exit code 3 without a word");
    }
}
