//! Waiting for something that can be seen, with an end.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

/// No wait of a healthy test comes near this; it keeps a broken one from hanging.
pub const PATIENCE: Duration = Duration::from_secs(300);

/// Looks every few milliseconds until there is something.
///
/// # Panics
/// When nothing came in [`PATIENCE`].
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
