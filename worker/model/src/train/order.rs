//! In which order scenes are visited, and how: a function of the seed, the epoch and the position, so that a training
//! can go on anywhere.

use crate::{
    Random,
    input::{Question, Visit},
};

/// The scenes of an epoch, in order.
pub fn epoch(seed: u64, epoch: u64, scenes: usize) -> Vec<usize> {
    Random::new(seed, &[2, epoch]).permutation(scenes)
}

/// How the `at`th scene of an epoch is visited: a random spot where the network is asked for one, mirrored at random.
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
