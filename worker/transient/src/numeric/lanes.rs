//! Loops over many elements with the widest registers of the machine. Products and sums are not
//! fused, so that the bits are the same with AVX-512, with AVX2, and with the baseline of the
//! architecture.
//!
//! Many loops are over five spots or twenty light vertices. A compiler runs the elements after the
//! last full register one by one, which took most of their time. So columns are stored in whole
//! groups ([`Column`]), and loops work on those.

use std::ops::Deref;

use pulp::{Arch, Simd, WithSimd};

/// A loop for [`widest`]. `run` must be `#[inline(always)]`, and so must the functions that it
/// calls, because only inlined code uses the wide registers.
pub(crate) trait Wide {
    /// The result of the loop.
    type Output;

    /// Runs the loop.
    fn run(self) -> Self::Output;
}

struct With<T>(T);

impl<T: Wide> WithSimd for With<T> {
    type Output = T::Output;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> T::Output {
        self.0.run()
    }
}

/// Runs a loop with the widest registers.
#[inline]
pub(crate) fn widest<T: Wide>(this: T) -> T::Output {
    Arch::new().dispatch(With(this))
}

/// Number of partial sums of a sum. It is the same on every machine, because the order determines
/// the bits.
pub(crate) const SIDE: usize = 8;

/// Numbers in groups of [`SIDE`], followed by zeros, so that a loop may begin at any of them and
/// read whole groups.
#[derive(Debug, Default, Clone)]
pub(crate) struct Column {
    groups: Vec<[f32; SIDE]>,
    len: usize,
}

impl Column {
    pub fn clear(&mut self) {
        self.groups.clear();
        self.len = 0;
    }

    pub fn push(&mut self, x: f32) {
        let at = self.len / SIDE;
        // The last number may be the first of a group to read.
        self.groups.resize(at + 2, [0.0; SIDE]);
        self.groups[at][self.len % SIDE] = x;
        self.len += 1;
    }

    /// Returns `count` numbers from the `first` on, in whole groups.
    #[inline(always)]
    pub fn groups(&self, first: usize, count: usize) -> &[[f32; SIDE]] {
        let all = self.groups.as_flattened();
        let (groups, _) = all[first..][..count.next_multiple_of(SIDE)].as_chunks();
        groups
    }
}

impl Deref for Column {
    type Target = [f32];

    #[inline(always)]
    fn deref(&self) -> &[f32] {
        &self.groups.as_flattened()[..self.len]
    }
}

/// Writes a group at its place: all of it, or as much as fits.
#[inline(always)]
pub(crate) fn put(out: &mut [f32], group: usize, found: &[f32; SIDE]) {
    let out = &mut out[group * SIDE..];
    match out.first_chunk_mut::<SIDE>() {
        Some(whole) => *whole = *found,
        // Avoids a call for a few numbers.
        None => {
            let (room, mut at) = (out.len(), 0);
            for part in [4, 2, 1] {
                if room & part != 0 {
                    out[at..at + part].copy_from_slice(&found[at..at + part]);
                    at += part;
                }
            }
        }
    }
}

/// Returns the sum of many numbers, by eight partial sums.
#[inline(always)]
pub(crate) fn sum(all: &[f32]) -> f32 {
    let (many, few) = all.as_chunks::<SIDE>();
    let mut sums = [0.0f32; SIDE];
    for chunk in many {
        for (sum, x) in sums.iter_mut().zip(chunk) {
            *sum += x;
        }
    }
    for (sum, x) in sums.iter_mut().zip(few) {
        *sum += x;
    }
    let pairs = [
        sums[0] + sums[4],
        sums[1] + sums[5],
        sums[2] + sums[6],
        sums[3] + sums[7],
    ];
    (pairs[0] + pairs[2]) + (pairs[1] + pairs[3])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use crate::numeric::lanes::Column;
    use crate::numeric::lanes::SIDE;
    use crate::numeric::lanes::put;

    proptest! {
        #[test]
        fn groups_hold_the_numbers_from_any_on_and_are_put_back_as_they_were(
            all in prop::collection::vec(1.0f32..2.0, 0..40), first in 0usize..40, count in 0usize..40,
        ) {
            let mut column = Column::default();
            for round in 0..2 {
                column.clear();
                // The second time there are fewer numbers, over the earlier ones.
                let all = &all[..all.len() / (round + 1)];
                all.iter().for_each(|&x| column.push(x));
                prop_assert_eq!(&*column, all);
                let first = first.min(all.len());
                let count = count.min(all.len() - first);
                let groups = column.groups(first, count);
                prop_assert_eq!(groups.len(), count.div_ceil(SIDE));
                let mut back = vec![0.0; count];
                for (k, group) in groups.iter().enumerate() {
                    put(&mut back, k, group);
                }
                prop_assert_eq!(&back[..], &all[first..first + count]);
            }
        }
    }
}
