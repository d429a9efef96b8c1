//! Lanes in AVX-512 and in AVX2 registers (proof in the parent module).

use std::arch::x86_64::*;

use super::{Lanes, Op};

/// Enters with AVX-512 enabled.
#[target_feature(enable = "avx2,fma,avx512f,avx512vl,avx512dq,avx512bw")]
pub(super) fn wide<O: Op>(op: O) -> O::Out {
    op.run::<Wide>()
}

/// Enters with AVX2 and FMA enabled.
#[target_feature(enable = "avx2,fma")]
pub(super) fn pair<O: Op>(op: O) -> O::Out {
    op.run::<Pair>()
}

/// One register of sixteen lanes.
#[derive(Clone, Copy)]
pub(super) struct Wide(__m512);

/// Two registers of eight lanes.
#[derive(Clone, Copy)]
pub(super) struct Pair(__m256, __m256);

// SAFETY of every block below: wherever a value of the type exists, the machine has the
// instructions (module proof).
impl Lanes for Wide {
    const WIDE: bool = true;
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self(unsafe { _mm512_set1_ps(x) })
    }
    #[inline(always)]
    unsafe fn read(p: *const f32) -> Self {
        Self(unsafe { _mm512_loadu_ps(p) })
    }
    #[inline(always)]
    unsafe fn write(self, p: *mut f32) {
        unsafe { _mm512_storeu_ps(p, self.0) };
    }
    #[inline(always)]
    fn add(self, o: Self) -> Self {
        Self(unsafe { _mm512_add_ps(self.0, o.0) })
    }
    #[inline(always)]
    fn sub(self, o: Self) -> Self {
        Self(unsafe { _mm512_sub_ps(self.0, o.0) })
    }
    #[inline(always)]
    fn mul(self, o: Self) -> Self {
        Self(unsafe { _mm512_mul_ps(self.0, o.0) })
    }
    #[inline(always)]
    fn div(self, o: Self) -> Self {
        Self(unsafe { _mm512_div_ps(self.0, o.0) })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(unsafe { _mm512_sqrt_ps(self.0) })
    }
    #[inline(always)]
    fn fma(self, a: Self, b: Self) -> Self {
        Self(unsafe { _mm512_fmadd_ps(self.0, a.0, b.0) })
    }
    #[inline(always)]
    fn relu(self) -> Self {
        Self(unsafe { _mm512_max_ps(_mm512_setzero_ps(), self.0) })
    }
    #[inline(always)]
    fn where_positive(self, gate: Self) -> Self {
        Self(unsafe {
            let on = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(gate.0, _mm512_setzero_ps());
            _mm512_maskz_mov_ps(on, self.0)
        })
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        Self(unsafe { _mm512_max_ps(self.0, o.0) })
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        Self(unsafe {
            let exponent = _mm512_add_epi32(_mm512_cvtps_epi32(self.0), _mm512_set1_epi32(127));
            _mm512_castsi512_ps(_mm512_slli_epi32::<23>(exponent))
        })
    }
    #[inline(always)]
    fn unzip(a: Self, b: Self) -> (Self, Self) {
        unsafe {
            let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            let odd = _mm512_or_si512(even, _mm512_set1_epi32(1));
            let of = _mm512_permutex2var_ps(a.0, even, b.0);
            (Self(of), Self(_mm512_permutex2var_ps(a.0, odd, b.0)))
        }
    }
    #[inline(always)]
    fn zip(even: Self, odd: Self) -> (Self, Self) {
        unsafe {
            let low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
            let high = _mm512_add_epi32(low, _mm512_set1_epi32(8));
            let first = _mm512_permutex2var_ps(even.0, low, odd.0);
            (
                Self(first),
                Self(_mm512_permutex2var_ps(even.0, high, odd.0)),
            )
        }
    }
    #[inline(always)]
    fn transpose(rows: [Self; 16]) -> [Self; 16] {
        let mut r = [rows[0].0; 16];
        for i in 0..16 {
            r[i] = rows[i].0;
        }
        let r = unsafe { transpose(r) };
        let mut rows = rows;
        for i in 0..16 {
            rows[i] = Self(r[i]);
        }
        rows
    }
}

/// The transposition of [`Wide`]: pairs, quads, then quarters of registers.
#[inline]
#[target_feature(enable = "avx512f")]
fn transpose(r: [__m512; 16]) -> [__m512; 16] {
    let mut q = r;
    for i in 0..4 {
        let [a, b, c, d] = [r[4 * i], r[4 * i + 1], r[4 * i + 2], r[4 * i + 3]];
        let low = _mm512_castps_pd(_mm512_unpacklo_ps(a, b));
        let high = _mm512_castps_pd(_mm512_unpackhi_ps(a, b));
        let low2 = _mm512_castps_pd(_mm512_unpacklo_ps(c, d));
        let high2 = _mm512_castps_pd(_mm512_unpackhi_ps(c, d));
        q[4 * i] = _mm512_castpd_ps(_mm512_unpacklo_pd(low, low2));
        q[4 * i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(low, low2));
        q[4 * i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(high, high2));
        q[4 * i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(high, high2));
    }
    // Quarter k of q[4i + j] now contains lanes 4i.. of column 4k + j.
    let mut t = r;
    for j in 0..4 {
        let [a, b, c, d] = [q[j], q[4 + j], q[8 + j], q[12 + j]];
        let even = _mm512_shuffle_f32x4::<0x88>(a, b);
        let odd = _mm512_shuffle_f32x4::<0xdd>(a, b);
        let even2 = _mm512_shuffle_f32x4::<0x88>(c, d);
        let odd2 = _mm512_shuffle_f32x4::<0xdd>(c, d);
        t[j] = _mm512_shuffle_f32x4::<0x88>(even, even2);
        t[8 + j] = _mm512_shuffle_f32x4::<0xdd>(even, even2);
        t[4 + j] = _mm512_shuffle_f32x4::<0x88>(odd, odd2);
        t[12 + j] = _mm512_shuffle_f32x4::<0xdd>(odd, odd2);
    }
    t
}

impl Lanes for Pair {
    const WIDE: bool = false;
    #[inline(always)]
    fn splat(x: f32) -> Self {
        let a = unsafe { _mm256_set1_ps(x) };
        Self(a, a)
    }
    #[inline(always)]
    unsafe fn read(p: *const f32) -> Self {
        unsafe { Self(_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8))) }
    }
    #[inline(always)]
    unsafe fn write(self, p: *mut f32) {
        unsafe {
            _mm256_storeu_ps(p, self.0);
            _mm256_storeu_ps(p.add(8), self.1);
        }
    }
    #[inline(always)]
    fn add(self, o: Self) -> Self {
        unsafe { Self(_mm256_add_ps(self.0, o.0), _mm256_add_ps(self.1, o.1)) }
    }
    #[inline(always)]
    fn sub(self, o: Self) -> Self {
        unsafe { Self(_mm256_sub_ps(self.0, o.0), _mm256_sub_ps(self.1, o.1)) }
    }
    #[inline(always)]
    fn mul(self, o: Self) -> Self {
        unsafe { Self(_mm256_mul_ps(self.0, o.0), _mm256_mul_ps(self.1, o.1)) }
    }
    #[inline(always)]
    fn div(self, o: Self) -> Self {
        unsafe { Self(_mm256_div_ps(self.0, o.0), _mm256_div_ps(self.1, o.1)) }
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        unsafe { Self(_mm256_sqrt_ps(self.0), _mm256_sqrt_ps(self.1)) }
    }
    #[inline(always)]
    fn fma(self, a: Self, b: Self) -> Self {
        unsafe {
            Self(
                _mm256_fmadd_ps(self.0, a.0, b.0),
                _mm256_fmadd_ps(self.1, a.1, b.1),
            )
        }
    }
    #[inline(always)]
    fn relu(self) -> Self {
        unsafe {
            let zero = _mm256_setzero_ps();
            Self(_mm256_max_ps(zero, self.0), _mm256_max_ps(zero, self.1))
        }
    }
    #[inline(always)]
    fn where_positive(self, gate: Self) -> Self {
        unsafe {
            let zero = _mm256_setzero_ps();
            let a = _mm256_cmp_ps::<_CMP_GT_OQ>(gate.0, zero);
            let b = _mm256_cmp_ps::<_CMP_GT_OQ>(gate.1, zero);
            Self(_mm256_and_ps(a, self.0), _mm256_and_ps(b, self.1))
        }
    }
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        unsafe { Self(_mm256_max_ps(self.0, o.0), _mm256_max_ps(self.1, o.1)) }
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        unsafe {
            let of = |n| {
                let exponent = _mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127));
                _mm256_castsi256_ps(_mm256_slli_epi32::<23>(exponent))
            };
            Self(of(self.0), of(self.1))
        }
    }
}
