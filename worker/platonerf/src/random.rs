//! Random numbers that depend only on their purpose: those of a seed and
//! names, and a shuffled order with elements that can be computed one by one.

use picofarm_settings::random::{GOLDEN, SplitMix64, mix};

/// The purpose of random numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Purpose {
    Weights = 1,
    Order = 2,
    Samples = 3,
}

/// A sequence of random numbers.
#[derive(Debug, Clone)]
pub(crate) struct Random(SplitMix64);

impl Random {
    /// Returns the sequence of a purpose and two numbers.
    pub fn new(seed: u64, purpose: Purpose, a: u64, b: u64) -> Self {
        let mut state = mix(seed ^ GOLDEN);
        for part in [purpose as u64, a, b] {
            state = mix(state ^ mix(part.wrapping_add(0xd1b5_4a32_d192_ed03)));
        }
        Self(SplitMix64(state))
    }

    fn bits(&mut self) -> u64 {
        self.0.bits()
    }

    /// Returns a uniform number in [0, 1), a multiple of 2⁻²⁴.
    pub fn unit(&mut self) -> f32 {
        self.0.unit()
    }
}

/// Returns element `place` of the numbers 0..n in the shuffled order of an epoch: four Feistel
/// rounds over the next power of four, repeated until the result is below n. `place` must be less
/// than n.
pub(crate) fn shuffled(seed: u64, epoch: u64, n: u64, place: u64) -> u64 {
    let half = (64 - (n - 1).leading_zeros()).div_ceil(2).max(1);
    let mask = (1u64 << half) - 1;
    let mut x = place;
    loop {
        let (mut left, mut right) = (x >> half, x & mask);
        for round in 0..4 {
            let key = Random::new(seed, Purpose::Order, epoch, round << 32 | right).bits();
            (left, right) = (right, left ^ (key & mask));
        }
        x = left << half | right;
        if x < n {
            return x;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_visits_each_ray_once_and_epochs_differ() {
        for n in [1u64, 2, 5, 16, 1000] {
            let mut seen: Vec<u64> = (0..n).map(|i| shuffled(7, 0, n, i)).collect();
            seen.sort_unstable();
            assert_eq!(seen, (0..n).collect::<Vec<_>>());
        }
        let first = |epoch| {
            (0..50)
                .map(|i| shuffled(7, epoch, 1000, i))
                .collect::<Vec<_>>()
        };
        assert_ne!(first(0), first(1));
    }
}
