//! Waits for a visible condition, with a timeout.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

/// Timeout of every wait. No passing test comes near it; it stops a broken test from hanging.
pub const PATIENCE: Duration = Duration::from_secs(300);

/// The shortest and longest pause between two looks.
const SHORT: Duration = Duration::from_millis(20);
const LONG: Duration = Duration::from_millis(500);

/// Polls until `look` returns a value. Between looks it pauses twice as long as a look took,
/// because a look that starts a program would otherwise keep a core busy.
///
/// # Panics
/// If it does not within [`PATIENCE`].
pub fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        let begun = Instant::now();
        if let Some(found) = look() {
            return found;
        }
        assert!(start.elapsed() < PATIENCE, "waited {PATIENCE:?} for {what}");
        sleep((2 * begun.elapsed()).clamp(SHORT, LONG));
    }
}
