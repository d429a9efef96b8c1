//! The order and parameters of visits to scenes. They depend only on the seed, the epoch and the
//! position, so a training can resume anywhere.

use crate::{
    Random,
    input::{Question, Visit},
};

/// Returns the scenes of an epoch, in order.
pub fn epoch(seed: u64, epoch: u64, scenes: usize) -> Vec<usize> {
    Random::new(seed, &[2, epoch]).permutation(scenes)
}

/// Returns the parameters of visit `at` of an epoch: a random spot if the network is queried by
/// spot, and random mirroring.
pub fn visit(seed: u64, epoch: u64, at: u64, question: &Question, augment: bool) -> Visit {
    let mut random = Random::new(seed, &[3, epoch, at]);
    let spot = random.below(question.spots.max(1) as u64) as usize;
    let mut coin = || augment && question.may_flip() && random.bits() >> 63 == 1;
    Visit {
        spot: if question.by_spot() { spot } else { 0 },
        flip_columns: coin(),
        flip_rows: coin(),
    }
}
