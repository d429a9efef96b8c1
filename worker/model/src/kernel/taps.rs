//! Gathers the inputs of a 3×3×3 convolution with stride 2 over a volume as channels of a 1×1
//! convolution.

use rayon::prelude::*;

use super::simd::Kernels;

/// Volumes (images, moments, streams, height, width).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TapShape {
    /// The number of volumes in the batch.
    pub images: usize,
    /// The number of moments of a volume.
    pub moments: usize,
    /// The number of streams of a moment.
    pub streams: usize,
    /// The number of rows.
    pub height: usize,
    /// The number of columns.
    pub width: usize,
    /// Whether the outermost values are repeated beyond the ends; if not, values there are 0.
    pub repeated: bool,
}

impl TapShape {
    /// Returns the numbers of output moments, rows and columns.
    pub fn halved(&self) -> [usize; 3] {
        [self.moments.div_ceil(2), self.height / 2, self.width / 2]
    }

    /// Returns position 2·`at` + `by` − 1. A position outside 0..`len` is clamped if ends are
    /// repeated, and `None` otherwise.
    fn place(&self, at: usize, by: usize, len: usize) -> Option<usize> {
        let place = 2 * at + by;
        match self.repeated {
            true => Some(place.clamp(1, len) - 1),
            false => (1..=len).contains(&place).then(|| place - 1),
        }
    }
}

impl Kernels {
    /// Writes all of `out`, (images·⌈moments/2⌉, 27, streams, height/2, width/2), ordered by the
    /// tap's moment, then by its row.
    pub fn taps(self, s: &TapShape, x: &[f32], out: &mut [f32]) {
        let ([moments, rows, columns], plane) = (s.halved(), s.height * s.width);
        let len = s.images * s.moments * s.streams * plane;
        assert_eq!(x.len(), len, "input length");
        let seen = 27 * s.streams * rows * columns;
        assert_eq!(out.len(), s.images * moments * seen, "output length");
        if out.is_empty() {
            return;
        }
        let each = out.par_chunks_exact_mut(seen).enumerate();
        each.for_each(|(at, out)| {
            let (image, moment) = (at / moments, at % moments);
            let rows_out = out.chunks_exact_mut(columns).enumerate();
            for (i, to) in rows_out {
                let (row, i) = (i % rows, i / rows);
                let (stream, tap) = (i % s.streams, i / s.streams);
                let moment = s.place(moment, tap / 9, s.moments);
                let place = moment.zip(s.place(row, tap / 3 % 3, s.height));
                let Some((moment, row)) = place else {
                    to.fill(0.0);
                    continue;
                };
                let plane_at = (image * s.moments + moment) * s.streams + stream;
                let from = &x[plane_at * plane + row * s.width..][..s.width];
                match tap % 3 {
                    0 => {
                        to[0] = if s.repeated { from[0] } else { 0.0 };
                        for (to, x) in to[1..].iter_mut().zip(from[1..].iter().step_by(2)) {
                            *to = *x;
                        }
                    }
                    by => {
                        for (to, x) in to.iter_mut().zip(from[by - 1..].iter().step_by(2)) {
                            *to = *x;
                        }
                    }
                }
            }
        });
    }
}
