//! Processes that train one network together.
//!
//! A step has [`super::Plan::accumulate`] batches. Each process takes a part of them, their gradients are summed over all
//! processes, and every process takes the same step of the optimiser, so that all stand at the same numbers. Batch norm sees a
//! batch of one process at a time, and running statistics follow the first batch of a step, as in PyTorch's
//! `DistributedDataParallel` with the released code's settings.
//!
//! Sums have one order, whoever has which batches: blocks of 2^k batches that begin at a multiple of 2^k are summed in pairs
//! ([`Blocks`]). So the bits do not depend on the number of processes, processes may come and go between two steps, and one
//! process alone comes to what many come to.

use std::ops::Range;

use super::position::Line;
use crate::ModelError;

/// Where a training stands: steps done, lines of its history written. Two processes that stand at the same place have the same numbers.
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
    /// Steps of the optimiser.
    pub step: u64,
    /// Lines of the history: a step that ends an epoch, or that a validation follows, is done before its line is.
    pub lines: u64,
}

/// A training as a group sees it.
pub trait Member {
    /// Where it stands.
    fn standing(&self) -> Standing;

    /// Batches of a step.
    fn batches(&self) -> usize;

    /// Everything that it is, as bytes.
    fn state(&self) -> Vec<u8>;

    /// Becomes what another one was.
    ///
    /// # Errors
    /// [`ModelError::Weights`] for bytes that are of no such training.
    fn become_state(&mut self, state: &[u8]) -> Result<(), ModelError>;
}

/// What a process does next.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Next {
    /// It trains: these are its batches of each step, until the group changes. `leads` where it validates and keeps what comes out.
    Train {
        /// Which of a step's batches.
        share: Range<usize>,
        /// It leads.
        leads: bool,
    },
    /// The training is over, and the leading process has kept what came out.
    Over,
    /// This process was asked to stop.
    Stop,
}

/// What a process has of a segment ([`crate::net::Net::segments`]) of a step: the sums of blocks of batches; with the first segment,
/// which comes last, running statistics where it has the step's first batch.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Part {
    /// Values of each block's sum.
    pub len: usize,
    /// Gradients of the segment's learned parameters by declaration, one after the other, and the loss, summed over blocks of
    /// batches.
    pub blocks: Blocks<Vec<f32>>,
    /// Running statistics after the first batch, each by the place of its declaration.
    pub moved: Vec<(usize, Vec<f32>)>,
}

/// Computes what a process has of a step, and hands over one part after the other.
pub type Compute<'a> = &'a mut dyn FnMut(&mut dyn FnMut(Part)) -> Result<(), ModelError>;

/// Processes that train one network together, as one of them sees them.
pub trait Group {
    /// Agrees with the others on who does what; a process that is behind is put where the furthest stands. Called at the
    /// beginning and whenever the group has changed.
    ///
    /// # Errors
    /// [`ModelError`] where this process cannot go on.
    fn agree(&mut self, member: &mut dyn Member) -> Result<Next, ModelError>;

    /// Whether all go on as agreed; called before each step. `false`: [`Self::agree`] again.
    ///
    /// # Errors
    /// As [`Self::agree`].
    fn go_on(&mut self) -> Result<bool, ModelError>;

    /// Whether there is no other process now: then there is nothing to add up.
    fn is_alone(&self) -> bool;

    /// The sums over all processes of what each of them computes, part by part; a part is added up while the next is computed.
    /// `None` where a process was lost on the way: nothing is decided, [`Self::agree`] again.
    ///
    /// # Errors
    /// What `compute` fails with; as [`Self::agree`].
    fn sum(&mut self, step: u64, compute: Compute<'_>) -> Result<Option<Vec<Part>>, ModelError>;

    /// Tells the others the line of an epoch's end or of a validation, by whoever leads; `digest` is of its numbers.
    fn tell(&mut self, line: &Line, digest: u64);

    /// The line that the leading process wrote; `None` where it was lost.
    ///
    /// # Errors
    /// [`ModelError::Group`] where the leading process has other numbers than those of `digest`; as [`Self::agree`].
    fn hear(&mut self, digest: u64) -> Result<Option<Line>, ModelError>;
}

/// Sums of blocks of items 0, 1, 2, …, in the one order that does not depend on who has which: blocks have 2^k items, begin at
/// a multiple of 2^k, and are as large as what is there allows.
#[derive(Debug, Clone, PartialEq)]
pub struct Blocks<T>(Vec<Block<T>>);

/// The sum of a block.
#[derive(Debug, Clone, PartialEq)]
pub struct Block<T> {
    /// Its first item.
    pub begin: usize,
    /// How many: a power of two.
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
    /// Adds a block that begins where the last one ends, or later.
    ///
    /// # Panics
    /// Where it begins before.
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

    /// The blocks, in order.
    pub fn as_slice(&self) -> &[Block<T>] {
        &self.0
    }

    /// One block of items 0 to `count`.
    pub fn whole(count: usize, sum: T) -> Self {
        Self(vec![Block {
            begin: 0,
            len: count,
            sum,
        }])
    }

    /// Whether a block may be pushed: it begins where the last one ends, or later, and is one of those that there may be.
    pub fn fits(&self, block: &Block<T>) -> bool {
        let end = self.0.last().map_or(0, |last| last.begin + last.len);
        block.begin >= end && block.len.is_power_of_two() && block.begin.is_multiple_of(block.len)
    }

    /// Whether it holds items 0 to `count` and nothing else.
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

    /// The sum of all, from the last to the first; `None` where there is nothing.
    pub fn total(mut self, add: &mut dyn FnMut(T, T) -> T) -> Option<T> {
        let mut sum = self.0.pop()?.sum;
        while let Some(block) = self.0.pop() {
            sum = add(block.sum, sum);
        }
        Some(sum)
    }

    /// The same blocks with what follows from each sum.
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

    /// The same blocks with other sums.
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
    /// The same blocks with some of their values.
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

/// Adds one to another, value by value.
///
/// # Panics
/// Where they have other lengths.
pub fn add_values(mut one: Vec<f32>, other: &[f32]) -> Vec<f32> {
    assert_eq!(one.len(), other.len(), "sums are of one length");
    for (a, b) in one.iter_mut().zip(other) {
        *a += b;
    }
    one
}

/// The batches of a step that the `which`th of `of` processes computes.
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
