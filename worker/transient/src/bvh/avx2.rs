//! The AVX2 kernel: the only unsafe code of this crate.
//!
//! Proof: every intrinsic here needs AVX2 and touches no memory except `_mm256_loadu_ps` and
//! `_mm256_storeu_ps`, which read and write one whole `[f32; 8]` behind a reference and need no
//! alignment. [`closest`] and [`any`] are reached only through a [`Bvh`] whose kernel is
//! [`Kernel::Avx2`], which `build` and `with_kernel` set only where [`available`] is true.
#![cfg_attr(
    target_arch = "x86_64",
    expect(
        unsafe_code,
        reason = "AVX2 intrinsics behind run-time detection; proof above"
    )
)]

use picofarm_scene::Vec3;

use super::{Bvh, Stack};

/// True where this machine has AVX2.
pub(super) fn available() -> bool {
    #[cfg(target_arch = "x86_64")]
    return std::arch::is_x86_feature_detected!("avx2");
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

#[cfg(not(target_arch = "x86_64"))]
pub(super) use portable::{any, closest};

#[cfg(not(target_arch = "x86_64"))]
mod portable {
    use super::*;
    use crate::bvh::traverse::traverse;

    pub(in crate::bvh) fn closest(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
        traverse::<[f32; 8], false>(b, &mut s.entries, o, d, t)
    }

    pub(in crate::bvh) fn any(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
        traverse::<[f32; 8], true>(b, &mut s.entries, o, d, t)
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use native::{any, closest};

#[cfg(target_arch = "x86_64")]
mod native {
    use std::arch::x86_64::*;

    use super::*;
    use crate::bvh::{lanes::Lanes, traverse::traverse};

    pub(in crate::bvh) fn closest(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
        // SAFETY: the kernel is Avx2 only where AVX2 was detected (module proof).
        unsafe { closest_avx2(b, s, o, d, t) }
    }

    pub(in crate::bvh) fn any(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
        // SAFETY: as above.
        unsafe { any_avx2(b, s, o, d, t) }
    }

    #[target_feature(enable = "avx2")]
    fn closest_avx2(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
        traverse::<Wide, false>(b, &mut s.entries, o, d, t)
    }

    #[target_feature(enable = "avx2")]
    fn any_avx2(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
        traverse::<Wide, true>(b, &mut s.entries, o, d, t)
    }

    /// Eight lanes in one register; made only inside the two functions above.
    #[derive(Clone, Copy)]
    struct Wide(__m256);

    // SAFETY of every block below: reached only from `traverse::<Wide, _>` (module proof).
    impl Lanes for Wide {
        #[inline(always)]
        fn splat(x: f32) -> Self {
            Self(unsafe { _mm256_set1_ps(x) })
        }
        #[inline(always)]
        fn load(a: &[f32; 8]) -> Self {
            Self(unsafe { _mm256_loadu_ps(a.as_ptr()) })
        }
        #[inline(always)]
        fn store(self) -> [f32; 8] {
            let mut a = [0.0; 8];
            unsafe { _mm256_storeu_ps(a.as_mut_ptr(), self.0) };
            a
        }
        #[inline(always)]
        fn add(self, o: Self) -> Self {
            Self(unsafe { _mm256_add_ps(self.0, o.0) })
        }
        #[inline(always)]
        fn sub(self, o: Self) -> Self {
            Self(unsafe { _mm256_sub_ps(self.0, o.0) })
        }
        #[inline(always)]
        fn mul(self, o: Self) -> Self {
            Self(unsafe { _mm256_mul_ps(self.0, o.0) })
        }
        #[inline(always)]
        fn div(self, o: Self) -> Self {
            Self(unsafe { _mm256_div_ps(self.0, o.0) })
        }
        #[inline(always)]
        fn min(self, o: Self) -> Self {
            Self(unsafe { _mm256_min_ps(self.0, o.0) })
        }
        #[inline(always)]
        fn max(self, o: Self) -> Self {
            Self(unsafe { _mm256_max_ps(self.0, o.0) })
        }
        #[inline(always)]
        fn le(self, o: Self) -> u32 {
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, o.0)) as u32 }
        }
        #[inline(always)]
        fn gt(self, o: Self) -> u32 {
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(self.0, o.0)) as u32 }
        }
        #[inline(always)]
        fn differs(self, o: Self) -> u32 {
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_NEQ_OQ>(self.0, o.0)) as u32 }
        }
    }
}
