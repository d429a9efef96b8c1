//! The two inner loops of the convolutions, over raw pointers (proof in the parent module).

#![expect(
    clippy::needless_range_loop,
    reason = "plain indices over register tiles unroll"
)]

use super::{LANES, Lanes};

/// Computes `acc[m][v] += Σ_channel Σ_tap w[channel][tap][m] · x[channel][at[v] + tap]` for a K×K
/// stencil, in this order. `x` has `channels` planes of `plane` values and rows of `row`; `w` is
/// `[channels][K·K][8]`.
#[inline(always)]
pub(in super::super) fn shifted<L: Lanes, const M: usize, const V: usize, const K: usize>(
    x: &[f32],
    at: [usize; V],
    (channels, plane, row): (usize, usize, usize),
    w: &[f32],
    mut acc: [[L; V]; M],
) -> [[L; V]; M] {
    if channels == 0 {
        return acc;
    }
    let last = (channels - 1) * plane + (K - 1) * (row + 1) + LANES;
    assert!(
        at.iter().all(|a| a + last <= x.len()),
        "tile inside the input"
    );
    assert!(
        M <= 8 && channels * K * K * 8 <= w.len() + 8 - M,
        "tile inside the weights"
    );
    let mut p = at.map(|a| x[a..].as_ptr());
    let mut q = w.as_ptr();
    for c in 0..channels {
        for ky in 0..K {
            for kx in 0..K {
                // SAFETY: the largest offsets are those asserted above; pointers advance only while
                // channels remain.
                unsafe {
                    let mut xs = [L::splat(0.0); V];
                    for v in 0..V {
                        xs[v] = L::read(p[v].add(ky * row + kx));
                    }
                    for m in 0..M {
                        let b = L::splat(*q.add((ky * K + kx) * 8 + m));
                        for v in 0..V {
                            acc[m][v] = b.fma(xs[v], acc[m][v]);
                        }
                    }
                }
            }
        }
        if c + 1 < channels {
            // SAFETY: another channel follows, so the pointers stay inside.
            unsafe {
                for v in 0..V {
                    p[v] = p[v].add(plane);
                }
                q = q.add(K * K * 8);
            }
        }
    }
    acc
}

/// The positions of [`outer`]: `rows × width`. The scalars of consecutive rows and columns are
/// `row` and `step` apart. The vectors of consecutive positions are `wide` apart, over all rows in
/// one run; the vectors of one position are `apart` apart.
#[derive(Clone, Copy)]
pub(in super::super) struct Positions {
    pub rows: usize,
    pub width: usize,
    pub row: usize,
    pub step: usize,
    pub wide: usize,
    pub apart: usize,
}

/// Computes `sum[r][c][v] = Σ_position x[at[r] + c + position] · g[position][v]`, from zero, in
/// order of positions.
#[inline(always)]
pub(in super::super) fn outer<L: Lanes, const V: usize, const R: usize, const C: usize>(
    x: &[f32],
    at: [usize; R],
    g: &[f32],
    s: Positions,
) -> [[[L; V]; C]; R] {
    let mut acc = [[[L::splat(0.0); V]; C]; R];
    if s.rows == 0 || s.width == 0 {
        return acc;
    }
    let last = (s.rows - 1) * s.row + (s.width - 1) * s.step + C;
    assert!(at.iter().all(|a| a + last <= x.len()), "scalars inside");
    let vectors = (s.rows * s.width - 1) * s.wide + (V - 1) * s.apart + LANES;
    assert!(vectors <= g.len(), "vectors inside");
    let mut q = g.as_ptr();
    for y in 0..s.rows {
        let p = at.map(|a| x[a + y * s.row..].as_ptr());
        for i in 0..s.width {
            // SAFETY: the largest offsets are those asserted above; `q` steps by wrapping.
            unsafe {
                let mut gs = [L::splat(0.0); V];
                for v in 0..V {
                    gs[v] = L::read(q.add(v * s.apart));
                }
                for r in 0..R {
                    for c in 0..C {
                        let b = L::splat(*p[r].add(i * s.step + c));
                        for v in 0..V {
                            acc[r][c][v] = b.fma(gs[v], acc[r][c][v]);
                        }
                    }
                }
            }
            q = q.wrapping_add(s.wide);
        }
    }
    acc
}
