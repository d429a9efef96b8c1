//! Limits on the attempts at a task. Failures of the task, losses of its worker and interruptions
//! have separate budgets.

use picofarm_catalog::Exception;
use picofarm_proto::{ids::StageRef, messages::FailureKind, spec::Limits};

use super::words::span;

/// Delays between attempts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Backoff {
    /// Delay after the first failure, milliseconds. It doubles with each further failure.
    pub first_ms: u32,
    /// Longest delay, milliseconds.
    pub most_ms: u32,
}

impl Default for Backoff {
    fn default() -> Self {
        Self {
            first_ms: 2_000,
            most_ms: 300_000,
        }
    }
}

impl Backoff {
    /// Returns the delay after the `n`-th failure (from 1), milliseconds.
    pub fn after(&self, n: u32) -> i64 {
        let doubled = u64::from(self.first_ms) << n.saturating_sub(1).min(31);
        i64::try_from(doubled.min(u64::from(self.most_ms))).expect("most_ms is a u32")
    }
}

/// The consequence of a failed attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// Time from which the task may run again, Unix milliseconds; `None` if it is given up.
    pub retry_at_ms: Option<i64>,
    /// The updated record of the task; `None` if the failure was free and there is no record.
    pub exception: Option<Exception>,
}

/// An attempt at a task that did not succeed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attempt<'a> {
    /// How the attempt ended.
    pub kind: FailureKind,
    /// Description of the failure.
    pub message: &'a str,
    /// Duration of the attempt, as far as is known, milliseconds.
    pub ms: u64,
    /// Whether the attempt counts against the task. It does not if the worker was at fault, or if
    /// it made progress beyond the previous attempt.
    pub counts: bool,
    /// Whether the task may run again at once the first time, because its worker returned the whole
    /// lease.
    pub at_once: bool,
}

/// Returns the record of a task without failures.
pub fn fresh(stage: StageRef, task: u64) -> Exception {
    Exception {
        stage,
        task,
        failures: 0,
        crashes: 0,
        interruptions: 0,
        longest_ms: 0,
        dead: false,
        last_error: String::new(),
    }
}

/// Charges an attempt to a task's budgets. `before` is the record so far, `fresh` one without
/// failures.
pub fn charge(
    before: Option<&Exception>,
    fresh: Exception,
    attempt: Attempt<'_>,
    limits: &Limits,
    backoff: &Backoff,
    now_ms: i64,
) -> Verdict {
    let mut exception = before.cloned().unwrap_or(fresh);
    let tries = match attempt.kind {
        FailureKind::Interrupted => {
            exception.longest_ms = exception.longest_ms.max(attempt.ms);
            exception.interruptions += u32::from(attempt.counts);
            let tries = exception.interruptions.max(1);
            tries - u32::from(attempt.at_once)
        }
        // The store's own delay decides. For damaged inputs the caller does, which counts the
        // tries.
        FailureKind::Store | FailureKind::Damaged => {
            return Verdict {
                retry_at_ms: Some(now_ms + 1),
                exception: before.cloned(),
            };
        }
        FailureKind::User | FailureKind::Crash if !attempt.counts => {
            return Verdict {
                retry_at_ms: Some(now_ms + backoff.after(1)),
                exception: before.cloned(),
            };
        }
        FailureKind::User => {
            exception.failures += 1;
            exception.failures
        }
        FailureKind::Crash => {
            exception.crashes += 1;
            exception.crashes
        }
    };
    exception.last_error = attempt.message.to_owned();
    let interrupted = exception.interruptions >= limits.max_interruptions;
    if interrupted {
        exception.last_error = format!(
            "interrupted {} times, for at most {} at a time; the last: {}",
            exception.interruptions,
            span(i64::try_from(exception.longest_ms).unwrap_or(i64::MAX)),
            attempt.message
        );
    }
    exception.dead = exception.failures >= limits.max_failures
        || exception.crashes >= limits.max_crashes
        || interrupted;
    Verdict {
        retry_at_ms: (!exception.dead).then(|| match tries {
            0 => 0,
            _ => now_ms + backoff.after(tries),
        }),
        exception: Some(exception),
    }
}
