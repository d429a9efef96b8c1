//! CPU time of one thread, or of this process.

use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

fn read(clock: ClockId) -> Duration {
    let now = clock_gettime(clock);
    Duration::new(
        now.tv_sec.unsigned_abs(),
        u32::try_from(now.tv_nsec).unwrap_or(0),
    )
}

/// Returns the CPU seconds of the calling thread during `work`.
pub fn of_thread<T>(work: impl FnOnce() -> T) -> (T, f64) {
    measured(ClockId::ThreadCPUTime, work)
}

/// Returns the CPU seconds of all threads of this process during `work`.
pub fn of_process<T>(work: impl FnOnce() -> T) -> (T, f64) {
    measured(ClockId::ProcessCPUTime, work)
}

fn measured<T>(clock: ClockId, work: impl FnOnce() -> T) -> (T, f64) {
    let before = read(clock);
    let result = work();
    (result, read(clock).saturating_sub(before).as_secs_f64())
}
