//! Laws of the kernels: one set of bits on every instruction set and number of threads, and
//! agreement with plain sums in `f64`.

use super::{simd::Isa, *};

mod attention;
mod border;
mod conv;
mod exp;
mod layer_norm;
mod moments;
mod norm;
mod rest;

/// Pseudo-random values in [-1, 1), the same everywhere.
fn noise(len: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    (0..len)
        .map(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        })
        .collect()
}

/// Runs on each instruction set of this machine with one, two and three threads, asserts that the
/// bits are the same, and returns them.
fn same_bits(run: impl Fn(Kernels) -> Vec<Vec<f32>> + Sync) -> Vec<Vec<f32>> {
    let bits = |r: &[Vec<f32>]| -> Vec<Vec<u32>> {
        r.iter()
            .map(|v| v.iter().map(|x| x.to_bits()).collect())
            .collect()
    };
    let first = run(Kernels::with(Isa::Portable).expect("always there"));
    for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512] {
        let Some(k) = Kernels::with(isa) else {
            println!("skipped: this machine has no {isa:?}");
            continue;
        };
        for threads in 1..=3 {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .expect("a pool starts");
            let other = pool.install(|| run(k));
            assert_eq!(bits(&other), bits(&first), "{isa:?}, {threads} threads");
        }
    }
    first
}

/// Asserts closeness to sums in `f64`, relative to the sum of magnitudes where given.
fn close(got: &[f32], want: &[f64], tolerance: f64) {
    assert_eq!(got.len(), want.len());
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        let off = (f64::from(*g) - w).abs();
        assert!(
            off <= tolerance * (1.0 + w.abs()),
            "value {i}: {g}, expected {w}"
        );
    }
}
