//! The kernels by instruction set: the only unsafe code of this crate.
//!
//! Proof: the intrinsics here need AVX2 ([`native::Eight`]) or AVX-512F ([`native::Sixteen`]) and
//! touch no memory except by unaligned loads and stores of one whole register, from and to slices
//! that are checked to be that long; a prefetch may name any address. The functions `*_avx2` are
//! called only through a [`Bvh`](super::Bvh) with the kernel AVX2 or AVX-512, those `*_avx512` only
//! through one with the kernel AVX-512; `build` and `with_kernel` set these only if [`available`]
//! returns true. Features are enabled for these functions alone; everything below is inlined into
//! them. Nothing below may be a closure that is not inlined: closures do not inherit features,
//! which costs much speed (not correctness).
#![cfg_attr(
    target_arch = "x86_64",
    expect(
        unsafe_code,
        reason = "vector intrinsics behind run-time detection; proof above"
    )
)]

use picofarm_scene::Vec3;

use crate::scene::bvh::{
    bundle::bundle,
    nodes::{EMPTY, Kernel},
    traverse::traverse,
    tree::{Bvh, Stack},
};

/// Returns whether this machine can run a kernel.
pub(crate) fn available(kernel: Kernel) -> bool {
    match kernel {
        Kernel::Portable => true,
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx2 => std::arch::is_x86_feature_detected!("avx2"),
        #[cfg(target_arch = "x86_64")]
        Kernel::Avx512 => {
            std::arch::is_x86_feature_detected!("avx2")
                && std::arch::is_x86_feature_detected!("avx512f")
                && std::arch::is_x86_feature_detected!("avx512vl")
        }
        #[cfg(not(target_arch = "x86_64"))]
        Kernel::Avx2 | Kernel::Avx512 => false,
    }
}

pub(crate) fn closest_portable(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
    traverse::<[f32; 8], false>(b, &mut s.entries, 0, o, d, t)
}

pub(crate) fn any_portable(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> bool {
    traverse::<[f32; 8], true>(b, &mut s.entries, 0, o, d, t).1 != EMPTY
}

pub(crate) fn bundle_portable(b: &Bvh, s: &mut Stack, o: Vec3, to: &[Vec3], blocked: &mut [bool]) {
    bundle::<[f32; 8], [f32; 8]>(b, s, o, to, blocked);
}

#[cfg(not(target_arch = "x86_64"))]
pub(crate) use {
    any_portable as any_avx2, any_portable as any_avx512, bundle_portable as bundle_avx2,
    bundle_portable as bundle_avx512, closest_portable as closest_avx2,
    closest_portable as closest_avx512,
};

#[cfg(target_arch = "x86_64")]
pub(crate) use native::*;

#[cfg(target_arch = "x86_64")]
mod native {
    use std::arch::x86_64::*;

    use super::*;
    use crate::scene::bvh::lanes::Lanes;

    /// The three entries of one instruction set: safe wrappers and the functions that enable it.
    macro_rules! kernel {
        ($feature:literal, $wide:ty, $closest:ident, $any:ident, $bundle:ident) => {
            pub(crate) fn $closest(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
                #[target_feature(enable = $feature)]
                fn run(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> (f32, u32) {
                    traverse::<Eight, false>(b, &mut s.entries, 0, o, d, t)
                }
                // SAFETY: the tree's kernel guarantees that the machine has the feature (module
                // proof).
                unsafe { run(b, s, o, d, t) }
            }

            pub(crate) fn $any(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> bool {
                #[target_feature(enable = $feature)]
                fn run(b: &Bvh, s: &mut Stack, o: Vec3, d: Vec3, t: f32) -> bool {
                    traverse::<Eight, true>(b, &mut s.entries, 0, o, d, t).1 != EMPTY
                }
                // SAFETY: as above.
                unsafe { run(b, s, o, d, t) }
            }

            pub(crate) fn $bundle(
                b: &Bvh,
                s: &mut Stack,
                o: Vec3,
                to: &[Vec3],
                blocked: &mut [bool],
            ) {
                #[target_feature(enable = $feature)]
                fn run(b: &Bvh, s: &mut Stack, o: Vec3, to: &[Vec3], blocked: &mut [bool]) {
                    bundle::<Eight, $wide>(b, s, o, to, blocked);
                }
                // SAFETY: as above.
                unsafe { run(b, s, o, to, blocked) }
            }
        };
    }

    kernel!("avx2", Eight, closest_avx2, any_avx2, bundle_avx2);
    kernel!(
        "avx2,avx512f,avx512vl",
        Sixteen,
        closest_avx512,
        any_avx512,
        bundle_avx512
    );

    /// Eight lanes in one register; created only inside the functions above.
    #[derive(Clone, Copy)]
    pub(crate) struct Eight(__m256);

    /// Sixteen lanes in one register; created only inside the AVX-512 functions above.
    #[derive(Clone, Copy)]
    pub(crate) struct Sixteen(__m512);

    /// Lanes over one register type. Comparisons are `$compare!(predicate, a, b)`.
    macro_rules! lanes {
        ($t:ident, $n:literal, $splat:ident, $load:ident, $store:ident, $add:ident, $sub:ident,
         $mul:ident, $div:ident, $min:ident, $max:ident, $least:ident, $greatest:ident, $compare:ident) => {
            // SAFETY of every block: a value of this type exists only if the instructions do
            // (module proof), and the slices are as long as a register.
            impl Lanes for $t {
                const N: usize = $n;
                #[inline(always)]
                fn prefetch<T>(x: &T) {
                    let start = std::ptr::from_ref(x).cast::<i8>();
                    for line in (0..size_of::<T>()).step_by(64) {
                        unsafe { _mm_prefetch::<_MM_HINT_T0>(start.wrapping_add(line)) };
                    }
                }
                #[inline(always)]
                fn splat(x: f32) -> Self {
                    Self(unsafe { $splat(x) })
                }
                #[inline(always)]
                fn load(a: &[f32]) -> Self {
                    let a = &a[..$n];
                    Self(unsafe { $load(a.as_ptr()) })
                }
                #[inline(always)]
                fn store(self, a: &mut [f32]) {
                    let a = &mut a[..$n];
                    unsafe { $store(a.as_mut_ptr(), self.0) };
                }
                #[inline(always)]
                fn add(self, o: Self) -> Self {
                    Self(unsafe { $add(self.0, o.0) })
                }
                #[inline(always)]
                fn sub(self, o: Self) -> Self {
                    Self(unsafe { $sub(self.0, o.0) })
                }
                #[inline(always)]
                fn mul(self, o: Self) -> Self {
                    Self(unsafe { $mul(self.0, o.0) })
                }
                #[inline(always)]
                fn div(self, o: Self) -> Self {
                    Self(unsafe { $div(self.0, o.0) })
                }
                #[inline(always)]
                fn min(self, o: Self) -> Self {
                    Self(unsafe { $min(self.0, o.0) })
                }
                #[inline(always)]
                fn max(self, o: Self) -> Self {
                    Self(unsafe { $max(self.0, o.0) })
                }
                #[inline(always)]
                fn least(self) -> f32 {
                    unsafe { $least(self.0) }
                }
                #[inline(always)]
                fn greatest(self) -> f32 {
                    unsafe { $greatest(self.0) }
                }
                #[inline(always)]
                fn le(self, o: Self) -> u32 {
                    unsafe { $compare!(_CMP_LE_OQ, self.0, o.0) }
                }
                #[inline(always)]
                fn gt(self, o: Self) -> u32 {
                    unsafe { $compare!(_CMP_GT_OQ, self.0, o.0) }
                }
                #[inline(always)]
                fn differs(self, o: Self) -> u32 {
                    unsafe { $compare!(_CMP_NEQ_OQ, self.0, o.0) }
                }
            }
        };
    }

    /// Folds a register in halves.
    macro_rules! fold8 {
        ($name:ident, $f:ident) => {
            #[inline]
            #[target_feature(enable = "avx2")]
            fn $name(a: __m256) -> f32 {
                let a = $f(_mm256_castps256_ps128(a), _mm256_extractf128_ps::<1>(a));
                let a = $f(a, _mm_movehl_ps(a, a));
                _mm_cvtss_f32($f(a, _mm_shuffle_ps::<1>(a, a)))
            }
        };
    }
    fold8!(least8, _mm_min_ps);
    fold8!(greatest8, _mm_max_ps);

    macro_rules! compare8 {
        ($p:ident, $a:expr, $b:expr) => {
            _mm256_movemask_ps(_mm256_cmp_ps::<$p>($a, $b)) as u32
        };
    }

    macro_rules! compare16 {
        ($p:ident, $a:expr, $b:expr) => {
            u32::from(_mm512_cmp_ps_mask::<$p>($a, $b))
        };
    }

    lanes!(
        Eight,
        8,
        _mm256_set1_ps,
        _mm256_loadu_ps,
        _mm256_storeu_ps,
        _mm256_add_ps,
        _mm256_sub_ps,
        _mm256_mul_ps,
        _mm256_div_ps,
        _mm256_min_ps,
        _mm256_max_ps,
        least8,
        greatest8,
        compare8
    );
    lanes!(
        Sixteen,
        16,
        _mm512_set1_ps,
        _mm512_loadu_ps,
        _mm512_storeu_ps,
        _mm512_add_ps,
        _mm512_sub_ps,
        _mm512_mul_ps,
        _mm512_div_ps,
        _mm512_min_ps,
        _mm512_max_ps,
        _mm512_reduce_min_ps,
        _mm512_reduce_max_ps,
        compare16
    );
}
