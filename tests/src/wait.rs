//! Waits for a visible condition, with a timeout.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

/// Timeout of every wait. No passing test comes near it; it stops a broken test from hanging.
pub const PATIENCE: Duration = Duration::from_secs(300);

/// Polls every few milliseconds until `look` returns a value.
///
/// # Panics
/// If it does not within [`PATIENCE`].
pub fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(start.elapsed() < PATIENCE, "waited {PATIENCE:?} for {what}");
        sleep(Duration::from_millis(20));
    }
}
