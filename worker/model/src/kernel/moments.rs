//! Operations along time in networks with one image for each moment: (images, moments, values),
//! with the values of all channels of a moment in a row.

use rayon::prelude::*;

use super::simd::{Kernels, LANES, Lanes, Op};

/// A batch of images with several moments each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MomentShape {
    /// The number of images in the batch.
    pub images: usize,
    /// The number of moments of an image.
    pub moments: usize,
    /// The number of values of a moment.
    pub values: usize,
}

impl MomentShape {
    /// Returns the number of values of the tensor.
    pub fn len(&self) -> usize {
        self.images * self.moments * self.values
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the index of the moment at distance `by` − 1 from moment `at`, if it is in the same
    /// image; `by` is 0, 1 or 2.
    fn adjacent(&self, at: usize, by: usize) -> Option<usize> {
        let moment = (at % self.moments + by).checked_sub(1)?;
        (moment < self.moments).then(|| at / self.moments * self.moments + moment)
    }
}

impl Kernels {
    /// Concatenates the values of the moments before, at and after each, with zeros beyond the
    /// ends. Writes all of `out`, which is three times as long as `x`.
    pub fn adjacent(self, s: &MomentShape, x: &[f32], out: &mut [f32]) {
        assert_eq!((x.len(), out.len()), (s.len(), 3 * s.len()), "lengths");
        if s.is_empty() {
            return;
        }
        let each = out.par_chunks_exact_mut(3 * s.values).enumerate();
        each.for_each(|(at, out)| {
            for (by, out) in out.chunks_exact_mut(s.values).enumerate() {
                match s.adjacent(at, by) {
                    Some(from) => out.copy_from_slice(&x[from * s.values..][..s.values]),
                    None => out.fill(0.0),
                }
            }
        });
    }

    /// Computes the gradient of [`Kernels::adjacent`]. Writes all of `dx`.
    pub fn adjacent_grad(self, s: &MomentShape, dy: &[f32], dx: &mut [f32]) {
        assert_eq!((dx.len(), dy.len()), (s.len(), 3 * s.len()), "lengths");
        if s.is_empty() {
            return;
        }
        let each = dx.par_chunks_exact_mut(s.values).enumerate();
        each.for_each(|(at, dx)| {
            // A moment is the first of three for the next one, and the last for the previous one.
            let part = |by: usize| {
                let of = s.adjacent(at, by)?;
                Some(&dy[(3 * of + 2 - by) * s.values..][..s.values])
            };
            self.run(Sum {
                parts: [part(1), part(0), part(2)],
                to: dx,
            });
        });
    }

    /// Computes the greater of each two consecutive moments. Of equal values, the first is
    /// selected; NaN is greater than any number. Writes all of `y`; `s` must have an even number of
    /// moments.
    pub fn halve_time(self, s: &MomentShape, x: &[f32], y: &mut [f32]) {
        assert_eq!((x.len(), 2 * y.len()), (s.len(), s.len()), "lengths");
        if s.is_empty() {
            return;
        }
        let pairs = x.par_chunks_exact(2 * s.values);
        pairs
            .zip(y.par_chunks_exact_mut(s.values))
            .for_each(|(x, y)| {
                let (first, second) = x.split_at(s.values);
                self.run(Greater { first, second, y });
            });
    }

    /// Computes the gradient of [`Kernels::halve_time`] from its input. Writes all of `dx`.
    pub fn halve_time_grad(self, s: &MomentShape, x: &[f32], dy: &[f32], dx: &mut [f32]) {
        assert_eq!((x.len(), 2 * dy.len()), (s.len(), s.len()), "lengths");
        assert_eq!(dx.len(), s.len(), "input gradient length");
        if s.is_empty() {
            return;
        }
        let pairs = x.par_chunks_exact(2 * s.values);
        pairs
            .zip(dy.par_chunks_exact(s.values))
            .zip(dx.par_chunks_exact_mut(2 * s.values))
            .for_each(|((x, dy), dx)| {
                let (first, second) = x.split_at(s.values);
                let (to_first, to_second) = dx.split_at_mut(s.values);
                self.run(GreaterGrad {
                    first,
                    second,
                    dy,
                    to_first,
                    to_second,
                });
            });
    }
}

/// The sum of the existing parts; the first part always exists.
struct Sum<'a> {
    parts: [Option<&'a [f32]>; 3],
    to: &'a mut [f32],
}

impl Op for Sum<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let [first, rest @ ..] = self.parts;
        if let Some(first) = first {
            self.to.copy_from_slice(first);
        }
        for part in rest.into_iter().flatten() {
            let both = self.to.chunks_mut(LANES).zip(part.chunks(LANES));
            for (to, part) in both {
                let sum = L::load_part(to, 0.0).add(L::load_part(part, 0.0));
                sum.store_part(to);
            }
        }
    }
}

struct Greater<'a> {
    first: &'a [f32],
    second: &'a [f32],
    y: &'a mut [f32],
}

impl Op for Greater<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        for ((first, second), y) in self.first.iter().zip(self.second).zip(self.y) {
            *y = if wins(*first, *second) {
                *second
            } else {
                *first
            };
        }
    }
}

/// Returns whether the second value is the greater; NaN is greater than any number.
#[inline(always)]
fn wins(first: f32, second: f32) -> bool {
    (second > first) | second.is_nan()
}

struct GreaterGrad<'a> {
    first: &'a [f32],
    second: &'a [f32],
    dy: &'a [f32],
    to_first: &'a mut [f32],
    to_second: &'a mut [f32],
}

impl Op for GreaterGrad<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let from = self.first.iter().zip(self.second).zip(self.dy);
        let to = self.to_first.iter_mut().zip(self.to_second);
        for (((first, second), dy), (to_first, to_second)) in from.zip(to) {
            // A mask of all bits or none, which the compiler vectorises, unlike a branch.
            let later = u32::from(wins(*first, *second)).wrapping_neg();
            *to_first = f32::from_bits(dy.to_bits() & !later);
            *to_second = f32::from_bits(dy.to_bits() & later);
        }
    }
}
