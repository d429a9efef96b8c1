//! Loops over many things side by side, with the longest registers that the machine has. Products and sums stay apart, so that
//! the bits are the same with any: the compiler's own registers, eight lanes or sixteen.

use pulp::{Arch, Simd, WithSimd};

/// A loop to be run so. `run` must be `#[inline(always)]`, as must be what it calls: only what is inlined has these registers.
pub(crate) trait Wide {
    /// What the loop finds.
    type Output;

    /// The loop.
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

/// Runs a loop with the longest registers.
#[inline]
pub(crate) fn widest<T: Wide>(this: T) -> T::Output {
    Arch::new().dispatch(With(this))
}

/// How many numbers a sum is made of side by side: the same on every machine, since the order is part of the bits.
pub(crate) const SIDE: usize = 8;

/// The sum of many numbers, eight partial sums first.
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
