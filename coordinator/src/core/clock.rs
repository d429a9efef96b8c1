//! The clock of the leases. It is injected, so that tests may change it.

use std::{
    fmt,
    sync::Arc,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use rustix::time::{ClockId, clock_gettime};

type Milliseconds = Arc<dyn Fn() -> i64 + Send + Sync>;

/// Returns Unix time in milliseconds, and the time passed whether or not this process ran.
#[derive(Clone)]
pub struct Clock {
    now: Milliseconds,
    passed: Milliseconds,
}

impl Clock {
    /// Creates a custom clock. Stalls of the process are detected with the system's monotonic
    /// clock.
    pub fn new(now_ms: impl Fn() -> i64 + Send + Sync + 'static) -> Self {
        let since = Instant::now();
        Self::with_stalls(now_ms, move || {
            i64::try_from(since.elapsed().as_millis()).unwrap_or(i64::MAX)
        })
    }

    /// Creates a custom clock that also returns the milliseconds since a fixed moment. A jump of
    /// that value means that the process was stalled or the machine suspended.
    pub fn with_stalls(
        now_ms: impl Fn() -> i64 + Send + Sync + 'static,
        passed_ms: impl Fn() -> i64 + Send + Sync + 'static,
    ) -> Self {
        Self {
            now: Arc::new(now_ms),
            passed: Arc::new(passed_ms),
        }
    }

    /// Creates a clock that starts at the system's time and advances with CLOCK_BOOTTIME, which
    /// includes suspended time. Setting the system's time therefore ends no lease, and after a
    /// suspend deadlines and times in the history are right.
    pub fn system() -> Self {
        let start = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .map_or(0, |d| d.as_millis());
        let since = since_boot();
        let passed = move || since_boot().saturating_sub(since).as_millis();
        Self::with_stalls(
            move || i64::try_from(start + passed()).unwrap_or(i64::MAX),
            move || i64::try_from(passed()).unwrap_or(i64::MAX),
        )
    }

    /// Returns Unix time, milliseconds.
    pub fn now_ms(&self) -> i64 {
        (self.now)()
    }

    /// Returns the milliseconds since a fixed moment, including suspends and stalls.
    pub fn passed_ms(&self) -> i64 {
        (self.passed)()
    }
}

fn since_boot() -> Duration {
    let time = clock_gettime(ClockId::Boottime);
    Duration::new(
        u64::try_from(time.tv_sec).unwrap_or(0),
        u32::try_from(time.tv_nsec).unwrap_or(0),
    )
}

impl fmt::Debug for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Clock({} ms)", self.now_ms())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_system_s_clock_tells_unix_time_and_goes_on() {
        let clock = Clock::system();
        let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
        let apart = clock.now_ms() - i64::try_from(unix.as_millis()).unwrap();
        assert!(apart.abs() < 10_000, "{apart} ms");
        let (now, passed) = (clock.now_ms(), clock.passed_ms());
        std::thread::sleep(Duration::from_millis(20));
        assert!(clock.now_ms() >= now + 20 && clock.passed_ms() >= passed + 20);
    }
}
