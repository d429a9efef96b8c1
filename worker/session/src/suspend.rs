//! Detects suspends of the machine. During a suspend, the monotonic clock that times everything
//! here stands still, while the coordinator's does not.

use std::time::Duration;

use rustix::time::{ClockId, Timespec, clock_gettime};

/// Smaller differences come from reading two clocks one after the other.
const NOTHING: Duration = Duration::from_millis(200);

/// A detector of suspends.
#[derive(Debug)]
pub(crate) struct Suspends {
    known: Duration,
}

impl Suspends {
    /// Starts the detection.
    pub(crate) fn new() -> Self {
        Self { known: suspended() }
    }

    /// Returns the duration of suspends since the last call; `None` if there were none.
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

/// Returns the total duration of suspends since the machine was started.
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
