//! Processes that train one network together.
//!
//! A step has [`super::Plan::accumulate`] batches. Each process computes a part of them. The
//! gradients are summed over all processes, and every process takes the same optimiser step, so all
//! have the same parameters. Batch norm uses the statistics of one batch of one process at a time.
//! Running statistics follow the first batch of a step, as in PyTorch's `DistributedDataParallel`
//! with the released code's settings.
//!
//! The order of summation does not depend on the assignment of batches to processes: blocks of 2^k
//! batches that begin at a multiple of 2^k are summed in pairs ([`Blocks`]). The bits of the result
//! are therefore independent of the number of processes, and processes may join and leave between
//! two steps. One process alone computes the same result as many.

use std::ops::Range;

use super::position::Line;
use crate::ModelError;

/// The progress of a training: finished steps and written lines of its history. Two processes with
/// the same standing have the same parameters.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Default,
    serde::Serialize,
    serde::Deserialize,
)]
pub struct Standing {
    /// The number of finished optimiser steps.
    pub step: u64,
    /// The number of lines of the history. If a step ends an epoch or is followed by a validation,
    /// the step is finished before its line is written.
    pub lines: u64,
}

/// The interface of a training that a [`Group`] uses.
pub trait Member {
    /// Returns the training's progress.
    fn standing(&self) -> Standing;

    /// Returns the number of batches in a step.
    fn batches(&self) -> usize;

    /// Returns the whole state of the training as bytes.
    fn state(&self) -> Vec<u8>;

    /// Takes over the state of another process.
    ///
    /// # Errors
    /// [`ModelError::Weights`] if the bytes are not a state of this training.
    fn become_state(&mut self, state: &[u8]) -> Result<(), ModelError>;
}

/// The next action of a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Next {
    /// The process trains a share of each step's batches until the group changes. If `leads` is
    /// set, it also validates and stores the result.
    Train {
        /// The range of a step's batches.
        share: Range<usize>,
        /// Whether the process leads.
        leads: bool,
    },
    /// The training is over, and the leading process has stored the result.
    Over,
    /// This process was told to stop.
    Stop,
}

/// A process's part of a step's gradients for one segment of the network
/// ([`crate::net::Net::segments`]): sums of blocks of batches. The first segment comes last; its
/// part also contains the running statistics if the process has the step's first batch.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Part {
    /// The number of values in each block's sum.
    pub len: usize,
    /// The gradients of the segment's learned parameters in the order of declaration, concatenated,
    /// and the loss, summed over blocks of batches.
    pub blocks: Blocks<Vec<f32>>,
    /// The running statistics after the first batch, each with the index of its declaration.
    pub moved: Vec<(usize, Vec<f32>)>,
}

/// Computes a process's gradients of a step, and passes them on part by part.
pub type Compute<'a> = &'a mut dyn FnMut(&mut dyn FnMut(Part)) -> Result<(), ModelError>;

/// A group of processes that train one network together, as seen by one of them.
pub trait Group {
    /// Agrees with the other processes on the assignment of work. A process that is behind takes
    /// over the state of the most advanced one. Called at the start and whenever the group has
    /// changed.
    ///
    /// # Errors
    /// [`ModelError`] if this process cannot continue.
    fn agree(&mut self, member: &mut dyn Member) -> Result<Next, ModelError>;

    /// Returns whether all processes continue as agreed; called before each step. If it returns
    /// `false`, call [`Self::agree`] again.
    ///
    /// # Errors
    /// As for [`Self::agree`].
    fn go_on(&mut self) -> Result<bool, ModelError>;

    /// Returns whether there is currently no other process, so that no sums are needed.
    fn is_alone(&self) -> bool;

    /// Returns the sums of the parts over all processes. A part is summed while the next is
    /// computed. If a process was lost meanwhile, returns `None`: the step is undecided, and
    /// [`Self::agree`] must be called again.
    ///
    /// # Errors
    /// The errors of `compute`, and those of [`Self::agree`].
    fn sum(&mut self, step: u64, compute: Compute<'_>) -> Result<Option<Vec<Part>>, ModelError>;

    /// Sends the line of an epoch's end or of a validation to the other processes. Called by the
    /// leading process; `digest` is the digest of its parameters.
    fn tell(&mut self, line: &Line, digest: u64);

    /// Returns the line that the leading process wrote, or `None` if that process was lost.
    ///
    /// # Errors
    /// [`ModelError::Group`] if the leading process's parameters do not have this `digest`; those
    /// of [`Self::agree`].
    fn hear(&mut self, digest: u64) -> Result<Option<Line>, ModelError>;
}

/// Sums of blocks of items 0, 1, 2, …, in an order that does not depend on the process which
/// computed an item. A block has 2^k items, begins at a multiple of 2^k, and is as large as the
/// available items allow.
#[derive(Debug, Clone, PartialEq)]
pub struct Blocks<T>(Vec<Block<T>>);

/// The sum of a block.
#[derive(Debug, Clone, PartialEq)]
pub struct Block<T> {
    /// The index of its first item.
    pub begin: usize,
    /// The number of items: a power of two.
    pub len: usize,
    /// The sum.
    pub sum: T,
}

impl<T> Default for Blocks<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Blocks<T> {
    /// Adds a block that begins at or after the end of the last one.
    ///
    /// # Panics
    /// If it begins before that end.
    pub fn push(&mut self, block: Block<T>, add: &mut dyn FnMut(T, T) -> T) {
        let end = self.0.last().map_or(0, |last| last.begin + last.len);
        assert!(block.begin >= end, "blocks come in order");
        let mut block = block;
        while let Some(last) = self.0.last() {
            let beside = last.len == block.len && last.begin + last.len == block.begin;
            if !beside || !last.begin.is_multiple_of(2 * block.len) {
                break;
            }
            let last = self.0.pop().expect("there is one");
            block = Block {
                begin: last.begin,
                len: 2 * block.len,
                sum: add(last.sum, block.sum),
            };
        }
        self.0.push(block);
    }

    /// Returns the blocks, in order.
    pub fn as_slice(&self) -> &[Block<T>] {
        &self.0
    }

    /// Returns one block of items 0 to `count`.
    pub fn whole(count: usize, sum: T) -> Self {
        Self(vec![Block {
            begin: 0,
            len: count,
            sum,
        }])
    }

    /// Returns whether a block may be pushed: it must be valid and begin at or after the end of the
    /// last one.
    pub fn fits(&self, block: &Block<T>) -> bool {
        let end = self.0.last().map_or(0, |last| last.begin + last.len);
        block.begin >= end && block.len.is_power_of_two() && block.begin.is_multiple_of(block.len)
    }

    /// Returns whether the blocks cover exactly items 0 to `count`.
    pub fn is_whole(&self, count: usize) -> bool {
        let mut end = 0;
        for block in &self.0 {
            if block.begin != end {
                return false;
            }
            end += block.len;
        }
        end == count
    }

    /// Returns the sum of all blocks, added from the last to the first, or `None` if there are
    /// none.
    pub fn total(mut self, add: &mut dyn FnMut(T, T) -> T) -> Option<T> {
        let mut sum = self.0.pop()?.sum;
        while let Some(block) = self.0.pop() {
            sum = add(block.sum, sum);
        }
        Some(sum)
    }

    /// Returns the same blocks with a value computed from each sum.
    pub fn each<U>(&self, mut of: impl FnMut(&T) -> U) -> Blocks<U> {
        let blocks = self.0.iter();
        Blocks(
            blocks
                .map(|block| Block {
                    begin: block.begin,
                    len: block.len,
                    sum: of(&block.sum),
                })
                .collect(),
        )
    }

    /// Converts each block's sum.
    pub fn map<U>(self, mut of: impl FnMut(T) -> U) -> Blocks<U> {
        let blocks = self.0.into_iter();
        Blocks(
            blocks
                .map(|block| Block {
                    begin: block.begin,
                    len: block.len,
                    sum: of(block.sum),
                })
                .collect(),
        )
    }
}

impl Blocks<Vec<f32>> {
    /// Returns the same blocks with a range of each sum's values.
    pub fn clone_slice(&self, values: &Range<usize>) -> Vec<Block<Vec<f32>>> {
        let blocks = self.0.iter();
        blocks
            .map(|block| Block {
                begin: block.begin,
                len: block.len,
                sum: block.sum[values.clone()].to_vec(),
            })
            .collect()
    }
}

/// Adds the values of `other` to those of `one`.
///
/// # Panics
/// If the lengths differ.
pub fn add_values(mut one: Vec<f32>, other: &[f32]) -> Vec<f32> {
    assert_eq!(one.len(), other.len(), "sums are of one length");
    for (a, b) in one.iter_mut().zip(other) {
        *a += b;
    }
    one
}

/// Returns the batches of a step that process `which` of `of` computes.
pub fn share(batches: usize, which: usize, of: usize) -> Range<usize> {
    which * batches / of..(which + 1) * batches / of
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn of(items: &[f32], range: Range<usize>) -> Blocks<f32> {
        let mut blocks = Blocks::default();
        for begin in range {
            let block = Block {
                begin,
                len: 1,
                sum: items[begin],
            };
            blocks.push(block, &mut |a, b| a + b);
        }
        blocks
    }

    proptest! {
        #[test]
        fn a_sum_has_the_same_bits_however_its_items_are_shared(
            items in prop::collection::vec(-1e3f32..1e3, 1..40),
            processes in 1usize..9,
        ) {
            let n = items.len();
            let alone = of(&items, 0..n).total(&mut |a, b| a + b).unwrap();
            let mut together = Blocks::default();
            for which in 0..processes {
                for block in of(&items, share(n, which, processes)).0 {
                    together.push(block, &mut |a, b| a + b);
                }
            }
            prop_assert!(together.is_whole(n));
            let together = together.total(&mut |a, b| a + b).unwrap();
            prop_assert_eq!(alone.to_bits(), together.to_bits());
        }

        #[test]
        fn shares_cover_each_batch_once(batches in 1usize..300, processes in 1usize..40) {
            let mut end = 0;
            for which in 0..processes {
                let share = share(batches, which, processes);
                prop_assert_eq!(share.start, end);
                end = share.end;
            }
            prop_assert_eq!(end, batches);
        }
    }

    #[test]
    fn what_is_missing_is_noticed() {
        let items = [1.0; 8];
        let mut blocks = of(&items, 0..3);
        assert!(!blocks.is_whole(4));
        for block in of(&items, 4..8).0 {
            blocks.push(block, &mut |a, b| a + b);
        }
        assert!(!blocks.is_whole(8));
        assert!(of(&items, 0..8).is_whole(8));
    }
}
