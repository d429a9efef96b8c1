//! Wait times between retries: exponential, capped, and jittered so that a thousand workers do not
//! return at the same moment.

use std::time::Duration;

/// Increasing waits between `first` and `longest`.
#[derive(Debug, Clone)]
pub struct Backoff {
    first: Duration,
    longest: Duration,
    tries: u32,
}

impl Backoff {
    /// Returns waits from `first`, doubling up to `longest`.
    pub const fn new(first: Duration, longest: Duration) -> Self {
        Self {
            first,
            longest,
            tries: 0,
        }
    }

    /// Returns the next wait: between half of the doubled wait and all of it. `random` is in [0,
    /// 1).
    pub fn next(&mut self, random: f64) -> Duration {
        let full = self
            .first
            .saturating_mul(1 << self.tries.min(20))
            .min(self.longest);
        self.tries = self.tries.saturating_add(1);
        full.mul_f64(0.5 + 0.5 * random)
    }

    /// Resets the waits after a success.
    pub fn reset(&mut self) {
        self.tries = 0;
    }
}

/// Returns a random number in [0, 1), for jitter.
pub fn random() -> f64 {
    let bits = uuid::Uuid::new_v4().as_u128() as u32;
    f64::from(bits) / (f64::from(u32::MAX) + 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_double_up_to_the_cap_and_jitter_takes_at_most_half() {
        let mut backoff = Backoff::new(Duration::from_millis(100), Duration::from_secs(1));
        let full: Vec<_> = (0..6).map(|_| backoff.next(1.0).as_millis()).collect();
        assert_eq!(full, [100, 200, 400, 800, 1000, 1000]);
        assert_eq!(backoff.next(0.0).as_millis(), 500);
        backoff.reset();
        assert_eq!(backoff.next(0.0).as_millis(), 50);
        for _ in 0..100 {
            backoff.next(0.0);
        }
        assert_eq!(backoff.next(1.0).as_secs(), 1, "never overflows");
    }
}
