//! How long the machine was suspended. The monotonic clock, by which everything here is timed, stands still meanwhile; the
//! coordinator's does not.

use std::time::Duration;

use rustix::time::{ClockId, Timespec, clock_gettime};

/// Differences below this are those of two clocks that are read one after the other.
const NOTHING: Duration = Duration::from_millis(200);

/// Notices suspends.
#[derive(Debug)]
pub(crate) struct Suspends {
    known: Duration,
}

impl Suspends {
    /// From now on.
    pub(crate) fn new() -> Self {
        Self { known: suspended() }
    }

    /// How long the machine was suspended since this was last asked; `None` where it was not.
    pub(crate) fn new_one(&mut self) -> Option<Duration> {
        self.slept(suspended())
    }

    fn slept(&mut self, suspended: Duration) -> Option<Duration> {
        let new = suspended.checked_sub(self.known)?;
        if new < NOTHING {
            return None;
        }
        self.known = suspended;
        Some(new)
    }
}

/// How long the machine has been suspended since it was started.
fn suspended() -> Duration {
    let monotonic = duration(clock_gettime(ClockId::Monotonic));
    duration(clock_gettime(ClockId::Boottime)).saturating_sub(monotonic)
}

fn duration(time: Timespec) -> Duration {
    Duration::new(
        u64::try_from(time.tv_sec).unwrap_or(0),
        u32::try_from(time.tv_nsec).unwrap_or(0),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_suspend_is_told_once_and_noise_never() {
        let s = Duration::from_secs;
        let mut suspends = Suspends { known: s(5) };
        assert_eq!(suspends.slept(s(5) + NOTHING / 2), None);
        assert_eq!(suspends.slept(s(5) - NOTHING / 2), None);
        assert_eq!(suspends.slept(s(65)), Some(s(60)));
        assert_eq!(suspends.slept(s(65)), None);
        assert_eq!(suspends.slept(s(66)), Some(s(1)));
        assert_eq!(Suspends::new().new_one(), None);
    }
}
