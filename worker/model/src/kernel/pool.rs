//! Max-pool 2×2 and nearest upsampling ×2, plane by plane, with their gradients.

use rayon::prelude::*;

use super::simd::{Kernels, Lanes, Op};

/// Planes of one size; for pooling the large ones, for upsampling the small ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaneShape {
    /// The number of planes: images times channels.
    pub planes: usize,
    /// The number of rows of a plane.
    pub height: usize,
    /// The number of pixels of a row.
    pub width: usize,
}

impl PlaneShape {
    /// Returns the number of values of the planes.
    pub fn len(&self) -> usize {
        self.planes * self.height * self.width
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the planes at half the size; an odd last row or column is dropped.
    pub fn halved(&self) -> Self {
        Self {
            height: self.height / 2,
            width: self.width / 2,
            ..*self
        }
    }

    /// Returns the planes at twice the size.
    pub fn doubled(&self) -> Self {
        Self {
            height: self.height * 2,
            width: self.width * 2,
            ..*self
        }
    }
}

impl Kernels {
    /// Computes max-pool 2×2 with stride 2 of planes `s`. Writes `y` and, for the gradient, the
    /// index `which` of the selected pixel of four (0 to 3, row by row), both as
    /// [`PlaneShape::halved`]. Of equal values, the first is selected; NaN is always selected.
    pub fn max_pool(self, s: &PlaneShape, x: &[f32], y: &mut [f32], which: &mut [u8]) {
        let small = s.halved();
        assert_eq!(x.len(), s.len(), "input length");
        assert_eq!(
            (y.len(), which.len()),
            (small.len(), small.len()),
            "output length"
        );
        if small.is_empty() {
            return;
        }
        let (large, little) = (s.height * s.width, small.height * small.width);
        x.par_chunks_exact(large)
            .zip(y.par_chunks_exact_mut(little))
            .zip(which.par_chunks_exact_mut(little))
            .for_each(|((x, y), which)| {
                self.run(Pool {
                    x,
                    width: s.width,
                    y,
                    which,
                })
            });
    }

    /// Computes the gradient of [`Kernels::max_pool`]. Writes all of `dx`.
    pub fn max_pool_grad(self, s: &PlaneShape, dy: &[f32], which: &[u8], dx: &mut [f32]) {
        let small = s.halved();
        assert_eq!(dx.len(), s.len(), "input gradient length");
        assert_eq!(
            (dy.len(), which.len()),
            (small.len(), small.len()),
            "gradient length"
        );
        if small.is_empty() {
            return dx.fill(0.0);
        }
        let (large, little) = (s.height * s.width, small.height * small.width);
        dx.par_chunks_exact_mut(large)
            .zip(dy.par_chunks_exact(little))
            .zip(which.par_chunks_exact(little))
            .for_each(|((dx, dy), which)| {
                self.run(Unpool {
                    dy,
                    which,
                    width: s.width,
                    dx,
                })
            });
    }

    /// Computes nearest upsampling ×2 of planes `s`. Writes all of `y`, as [`PlaneShape::doubled`].
    pub fn upsample(self, s: &PlaneShape, x: &[f32], y: &mut [f32]) {
        assert_eq!(
            (x.len(), y.len()),
            (s.len(), s.doubled().len()),
            "input and output length"
        );
        if s.is_empty() {
            return;
        }
        let plane = s.height * s.width;
        x.par_chunks_exact(plane)
            .zip(y.par_chunks_exact_mut(4 * plane))
            .for_each(|(x, y)| {
                self.run(Up {
                    x,
                    width: s.width,
                    y,
                })
            });
    }

    /// Computes the gradient of [`Kernels::upsample`]: each pixel of `dx` is the sum of its four
    /// pixels of `dy`.
    pub fn upsample_grad(self, s: &PlaneShape, dy: &[f32], dx: &mut [f32]) {
        assert_eq!(
            (dx.len(), dy.len()),
            (s.len(), s.doubled().len()),
            "gradient lengths"
        );
        if s.is_empty() {
            return;
        }
        let plane = s.height * s.width;
        dx.par_chunks_exact_mut(plane)
            .zip(dy.par_chunks_exact(4 * plane))
            .for_each(|(dx, dy)| {
                self.run(Down {
                    dy,
                    width: s.width,
                    dx,
                })
            });
    }
}

struct Pool<'a> {
    x: &'a [f32],
    width: usize,
    y: &'a mut [f32],
    which: &'a mut [u8],
}

impl Op for Pool<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let half = self.width / 2;
        let rows = self
            .y
            .chunks_exact_mut(half)
            .zip(self.which.chunks_exact_mut(half));
        for ((y, which), x) in rows.zip(self.x.chunks_exact(2 * self.width)) {
            let (top, bottom) = x.split_at(self.width);
            let pairs = top.chunks_exact(2).zip(bottom.chunks_exact(2));
            for ((y, which), (t, b)) in y.iter_mut().zip(which).zip(pairs) {
                let (mut best, mut at) = (t[0], 0);
                for (i, x) in [(1, t[1]), (2, b[0]), (3, b[1])] {
                    let wins = (x > best) | x.is_nan();
                    best = if wins { x } else { best };
                    at = if wins { i } else { at };
                }
                (*y, *which) = (best, at);
            }
        }
    }
}

struct Unpool<'a> {
    dy: &'a [f32],
    which: &'a [u8],
    width: usize,
    dx: &'a mut [f32],
}

impl Op for Unpool<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let half = self.width / 2;
        let rows = self
            .dy
            .chunks_exact(half)
            .zip(self.which.chunks_exact(half));
        let done = rows.len() * 2 * self.width;
        for ((dy, which), dx) in rows.zip(self.dx.chunks_exact_mut(2 * self.width)) {
            let (top, bottom) = dx.split_at_mut(self.width);
            if self.width % 2 == 1 {
                (top[self.width - 1], bottom[self.width - 1]) = (0.0, 0.0);
            }
            let pairs = top.chunks_exact_mut(2).zip(bottom.chunks_exact_mut(2));
            for ((dy, which), (t, b)) in dy.iter().zip(which).zip(pairs) {
                // A mask of all bits or none, which the compiler vectorises, unlike a branch.
                let of =
                    |i: u8| f32::from_bits(dy.to_bits() & u32::from(*which == i).wrapping_neg());
                t[0] = of(0);
                t[1] = of(1);
                b[0] = of(2);
                b[1] = of(3);
            }
        }
        self.dx[done..].fill(0.0);
    }
}

struct Up<'a> {
    x: &'a [f32],
    width: usize,
    y: &'a mut [f32],
}

impl Op for Up<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let rows = self.x.chunks_exact(self.width);
        for (x, y) in rows.zip(self.y.chunks_exact_mut(4 * self.width)) {
            let (top, bottom) = y.split_at_mut(2 * self.width);
            for (x, y) in x.iter().zip(top.chunks_exact_mut(2)) {
                y[0] = *x;
                y[1] = *x;
            }
            bottom.copy_from_slice(top);
        }
    }
}

struct Down<'a> {
    dy: &'a [f32],
    width: usize,
    dx: &'a mut [f32],
}

impl Op for Down<'_> {
    type Out = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let rows = self.dx.chunks_exact_mut(self.width);
        for (dx, dy) in rows.zip(self.dy.chunks_exact(4 * self.width)) {
            let (top, bottom) = dy.split_at(2 * self.width);
            let pairs = top.chunks_exact(2).zip(bottom.chunks_exact(2));
            for (dx, (t, b)) in dx.iter_mut().zip(pairs) {
                *dx = (t[0] + t[1]) + (b[0] + b[1]);
            }
        }
    }
}
