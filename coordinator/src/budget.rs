//! How often a task is tried: failures of its own, losses of its worker and interruptions have
//! separate budgets.

use picofarm_catalog::Exception;
use picofarm_proto::{
    ids::StageRef,
    model::{FailureKind, Limits},
};

use crate::explain::span;

/// Waiting times between tries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Backoff {
    /// After the first failure, milliseconds; doubles with each further one.
    pub first_ms: u32,
    /// At most, milliseconds.
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
    /// How long to wait after the `n`-th failure (from 1), milliseconds.
    pub fn after(&self, n: u32) -> i64 {
        let doubled = u64::from(self.first_ms) << n.saturating_sub(1).min(31);
        i64::try_from(doubled.min(u64::from(self.most_ms))).expect("most_ms is a u32")
    }
}

/// What becomes of a failed task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// When it may be tried again, Unix milliseconds; `None` = given up.
    pub retry_at_ms: Option<i64>,
    /// Its record after this; `None` where the failure was free and it has none.
    pub exception: Option<Exception>,
}

/// An attempt at a task that did not end well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attempt<'a> {
    /// How it ended.
    pub kind: FailureKind,
    /// The same for people.
    pub message: &'a str,
    /// How long it took, as far as is known, milliseconds.
    pub ms: u64,
    /// It is the task's to answer for: neither its worker's, nor did it come further than the one
    /// before.
    pub counts: bool,
    /// The task need not wait the first time: its worker gave the whole lease back.
    pub at_once: bool,
}

/// A task's record without failures.
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

/// Charges an attempt to a task's budgets. `before` is its record so far, `fresh` one without
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
        // Its store's own wait decides, and of what is damaged the caller, who counts the tries.
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
