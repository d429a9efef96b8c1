//! The pace of a training.

use std::time::{Duration, Instant};

/// Measures the time for which the network waited.
pub(super) struct Clock {
    pub began: Instant,
    pub waited: Duration,
    pub samples: usize,
}

impl Clock {
    pub fn new() -> Self {
        Self {
            began: Instant::now(),
            waited: Duration::ZERO,
            samples: 0,
        }
    }

    pub fn share(&self) -> f64 {
        self.waited.as_secs_f64() / self.began.elapsed().as_secs_f64().max(f64::MIN_POSITIVE)
    }
}
