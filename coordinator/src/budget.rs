//! How often a task is tried: failures of its own and losses of its worker have separate budgets,
//! interruptions are free.

use picofarm_catalog::Exception;
use picofarm_proto::model::{FailureKind, Limits};

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

/// Charges a failure to a task's budgets. `before` is its record so far, `fresh` one without failures.
pub fn charge(
    before: Option<&Exception>,
    fresh: Exception,
    kind: FailureKind,
    message: &str,
    limits: &Limits,
    backoff: &Backoff,
    now_ms: i64,
) -> Verdict {
    let mut exception = before.cloned().unwrap_or(fresh);
    let tries = match kind {
        FailureKind::Interrupted => {
            return Verdict {
                retry_at_ms: Some(now_ms + backoff.after(1)),
                exception: before.cloned(),
            };
        }
        // Its store's own wait decides, and of what is damaged the caller, who counts the tries.
        FailureKind::Store | FailureKind::Damaged => {
            return Verdict {
                retry_at_ms: Some(now_ms + 1),
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
    exception.last_error = message.to_owned();
    exception.dead =
        exception.failures >= limits.max_failures || exception.crashes >= limits.max_crashes;
    Verdict {
        retry_at_ms: (!exception.dead).then(|| now_ms + backoff.after(tries)),
        exception: Some(exception),
    }
}
