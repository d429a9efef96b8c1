//! How long to wait before trying again: exponential, capped, jittered so that a thousand workers do not
//! come back in the same instant.

use std::time::Duration;

/// Growing waits between `first` and `longest`.
#[derive(Debug, Clone)]
pub struct Backoff {
    first: Duration,
    longest: Duration,
    tries: u32,
}

impl Backoff {
    /// Waits from `first`, doubling up to `longest`.
    pub const fn new(first: Duration, longest: Duration) -> Self {
        Self {
            first,
            longest,
            tries: 0,
        }
    }

    /// The next wait: between half of the doubled wait and all of it, by `random` in [0, 1).
    pub fn next(&mut self, random: f64) -> Duration {
        let full = self
            .first
            .saturating_mul(1 << self.tries.min(20))
            .min(self.longest);
        self.tries = self.tries.saturating_add(1);
        full.mul_f64(0.5 + 0.5 * random)
    }

    /// It worked: begin anew.
    pub fn reset(&mut self) {
        self.tries = 0;
    }
}

/// A random number in [0, 1), for jitter.
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
