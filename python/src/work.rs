//! Long work on threads of its own, which leaves the interpreter free and ends on Ctrl-C.

use std::{
    sync::{
        atomic::{AtomicBool, AtomicU32, Ordering},
        mpsc::{RecvTimeoutError, channel},
    },
    time::Duration,
};

use picofarm_transient::Progress;
use pyo3::{
    exceptions::{PyRuntimeError, PyValueError},
    prelude::*,
};

/// Time between two looks at Python's signals and calls of the progress function.
const POLL: Duration = Duration::from_millis(50);

/// The state that the work shares with the waiting interpreter.
#[derive(Default)]
pub(crate) struct Watch {
    stop: AtomicBool,
    /// Share done, millionths.
    done: AtomicU32,
}

impl Progress for Watch {
    fn at(&self, done: f32) -> bool {
        self.done.fetch_max((done * 1e6) as u32, Ordering::Relaxed);
        !self.stop.load(Ordering::Relaxed)
    }
}

/// Runs `work` on a pool of `threads` threads (all cores without a number). Calls `progress` with
/// the share done in [0, 1] about 20 times a second.
///
/// # Errors
/// `ValueError` for 0 threads; the exception of a signal handler (Ctrl-C) or of `progress`, after
/// the work has stopped; `RuntimeError` if the work panics.
pub(crate) fn run<T: Send>(
    py: Python<'_>,
    threads: Option<usize>,
    progress: Option<&Py<PyAny>>,
    work: impl FnOnce(&Watch) -> T + Send,
) -> PyResult<T> {
    let threads = threads.unwrap_or_else(picofarm_tasks::cores);
    if !(1..=4096).contains(&threads) {
        return Err(PyValueError::new_err(format!(
            "threads: expected 1 to 4096, found {threads}"
        )));
    }
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| PyRuntimeError::new_err(format!("cannot start {threads} threads: {e}")))?;
    let watch = &Watch::default();
    let mut failure = None;
    let result = py.detach(|| {
        std::thread::scope(|scope| {
            let (sender, receiver) = channel();
            let worker = scope.spawn(move || {
                // The receiver waits until the sender is gone.
                let _ = sender.send(pool.install(|| work(watch)));
            });
            let result = loop {
                match receiver.recv_timeout(POLL) {
                    Ok(result) => break Some(result),
                    Err(RecvTimeoutError::Disconnected) => break None,
                    Err(RecvTimeoutError::Timeout) if failure.is_none() => {
                        failure = Python::attach(|py| report(py, progress, watch)).err();
                        watch.stop.store(failure.is_some(), Ordering::Relaxed);
                    }
                    Err(RecvTimeoutError::Timeout) => {}
                }
            };
            // A panic has been printed by its thread.
            let _ = worker.join();
            result
        })
    });
    match (failure, result) {
        (Some(e), _) => Err(e),
        (None, Some(result)) => Ok(result),
        (None, None) => Err(PyRuntimeError::new_err(
            "the work broke; please report the message on standard error",
        )),
    }
}

/// Handles signals and reports progress.
fn report(py: Python<'_>, progress: Option<&Py<PyAny>>, watch: &Watch) -> PyResult<()> {
    py.check_signals()?;
    if let Some(progress) = progress {
        let share = f64::from(watch.done.load(Ordering::Relaxed)) / 1e6;
        progress.call1(py, (share,))?;
    }
    Ok(())
}
