//! Sixteen lanes by instruction set and the two inner loops of the convolutions: the only unsafe code here.
//!
//! Proof. The intrinsics need AVX-512 ([`native::Wide`]) or AVX2 with FMA ([`native::Pair`]). Values of these
//! types are made only below [`Kernels::run`], which enters the function that enables the feature, and only
//! where a [`Kernels`] says so; [`Kernels::with`] makes one only after the run-time check. [`Lanes::load`] and
//! [`Lanes::store`] check the length of their slice. The two loops [`shifted`] and [`outer`] read through raw
//! pointers; each asserts at entry that the largest offset it forms lies inside its slices.
//!
//! Nothing below [`Op::run`] may be a closure that is not inlined: closures do not inherit the enabled
//! features, which costs speed (not correctness).
#![expect(
    unsafe_code,
    reason = "vector intrinsics behind run-time detection, unchecked inner loops; proof above"
)]

/// The number of virtual lanes of every kernel, on every instruction set.
pub(super) const LANES: usize = 16;

/// An instruction set the kernels are written for. The results' bits are the same on all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    /// Plain Rust with [`f32::mul_add`].
    Portable,
    /// AVX2 and FMA.
    Avx2,
    /// AVX-512 F, VL, DQ and BW.
    Avx512,
}

/// The kernels on one instruction set that this machine has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kernels(Isa);

impl Kernels {
    /// The kernels on the widest instruction set of this machine.
    pub fn best() -> Self {
        let wide = Self::with(Isa::Avx512).or_else(|| Self::with(Isa::Avx2));
        wide.unwrap_or(Self(Isa::Portable))
    }

    /// The kernels on one instruction set; none where this machine lacks it.
    pub fn with(isa: Isa) -> Option<Self> {
        let there = match isa {
            Isa::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => {
                std::arch::is_x86_feature_detected!("avx2")
                    && std::arch::is_x86_feature_detected!("fma")
            }
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => {
                std::arch::is_x86_feature_detected!("avx2")
                    && std::arch::is_x86_feature_detected!("fma")
                    && std::arch::is_x86_feature_detected!("avx512f")
                    && std::arch::is_x86_feature_detected!("avx512vl")
                    && std::arch::is_x86_feature_detected!("avx512dq")
                    && std::arch::is_x86_feature_detected!("avx512bw")
            }
            #[cfg(not(target_arch = "x86_64"))]
            Isa::Avx2 | Isa::Avx512 => false,
        };
        there.then_some(Self(isa))
    }

    /// The instruction set in use.
    pub fn isa(self) -> Isa {
        self.0
    }

    /// Runs an operation on this instruction set.
    pub(super) fn run<O: Op>(self, op: O) -> O::Out {
        match self.0 {
            // SAFETY: `with` has checked that the machine has the features.
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => unsafe { native::wide(op) },
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => unsafe { native::pair(op) },
            _ => op.run::<[f32; LANES]>(),
        }
    }
}

/// A piece of work written once for all instruction sets. `run` must be `#[inline(always)]`.
pub(super) trait Op {
    /// What it returns.
    type Out;
    /// Does it with one kind of lanes.
    fn run<L: Lanes>(self) -> Self::Out;
}

/// Sixteen `f32` lanes.
pub(super) trait Lanes: Copy {
    /// True with thirty-two registers of sixteen lanes: decides the register tile, never a result.
    const WIDE: bool;
    fn splat(x: f32) -> Self;
    /// The sixteen values at `p`.
    ///
    /// # Safety
    /// Sixteen values at `p` may be read.
    unsafe fn read(p: *const f32) -> Self;
    /// Stores the sixteen values at `p`.
    ///
    /// # Safety
    /// Sixteen values at `p` may be written.
    unsafe fn write(self, p: *mut f32);
    fn add(self, o: Self) -> Self;
    fn sub(self, o: Self) -> Self;
    fn mul(self, o: Self) -> Self;
    fn div(self, o: Self) -> Self;
    fn sqrt(self) -> Self;
    /// `self · a + b`, rounded once.
    fn fma(self, a: Self, b: Self) -> Self;
    /// `0 > self ? 0 : self`: NaN stays NaN.
    fn relu(self) -> Self;
    /// `self` where `gate > 0`, else +0.
    fn where_positive(self, gate: Self) -> Self;

    /// The first sixteen values of a slice.
    #[inline(always)]
    fn load(a: &[f32]) -> Self {
        let a = &a[..LANES];
        // SAFETY: the slice is that long.
        unsafe { Self::read(a.as_ptr()) }
    }
    /// Stores to the first sixteen values of a slice.
    #[inline(always)]
    fn store(self, a: &mut [f32]) {
        let a = &mut a[..LANES];
        // SAFETY: the slice is that long.
        unsafe { self.write(a.as_mut_ptr()) };
    }
    /// The lanes as an array.
    #[inline(always)]
    fn array(self) -> [f32; LANES] {
        let mut a = [0.0; LANES];
        self.store(&mut a);
        a
    }
    /// Up to sixteen values of a slice, the missing ones filled with `pad`.
    #[inline(always)]
    fn load_part(a: &[f32], pad: f32) -> Self {
        if a.len() >= LANES {
            return Self::load(a);
        }
        let mut t = [pad; LANES];
        t[..a.len()].copy_from_slice(a);
        Self::load(&t)
    }
    /// Stores to up to sixteen values of a slice, dropping the rest.
    #[inline(always)]
    fn store_part(self, a: &mut [f32]) {
        if a.len() >= LANES {
            return self.store(a);
        }
        let n = a.len();
        a.copy_from_slice(&self.array()[..n]);
    }
    /// The sum by a fixed tree: halves onto each other.
    #[inline(always)]
    fn sum(self) -> f32 {
        let mut a = self.array();
        let mut half = LANES / 2;
        while half > 0 {
            for i in 0..half {
                a[i] += a[i + half];
            }
            half /= 2;
        }
        a[0]
    }
}

/// `acc[m][v] += Σ_channel Σ_tap w[channel][tap][m] · x[channel][at[v] + tap]` for a K×K stencil, in this
/// order. `x` has `channels` planes of `plane` values and rows of `row`; `w` is `[channels][K·K][8]`.
#[inline(always)]
pub(super) fn shifted<L: Lanes, const M: usize, const V: usize, const K: usize>(
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
                // SAFETY: the largest offsets are those asserted above; pointers advance only while channels
                // remain.
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

/// The positions of [`outer`]: `rows × width`, whose scalars lie `row` and `step` apart and whose vectors lie
/// `wide` apart, all rows in one run.
#[derive(Clone, Copy)]
pub(super) struct Positions {
    pub rows: usize,
    pub width: usize,
    pub row: usize,
    pub step: usize,
    pub wide: usize,
}

/// `sum[r][k][v] = Σ_position x[at[r] + k + position] · g[position][v]`, from zero, in order of positions.
#[inline(always)]
pub(super) fn outer<L: Lanes, const V: usize, const R: usize>(
    x: &[f32],
    at: [usize; R],
    g: &[f32],
    s: Positions,
) -> [[[L; V]; 3]; R] {
    let mut acc = [[[L::splat(0.0); V]; 3]; R];
    if s.rows == 0 || s.width == 0 {
        return acc;
    }
    let last = (s.rows - 1) * s.row + (s.width - 1) * s.step + 3;
    assert!(at.iter().all(|a| a + last <= x.len()), "scalars inside");
    let vectors = (s.rows * s.width - 1) * s.wide + V * LANES;
    assert!(vectors <= g.len(), "vectors inside");
    let mut q = g.as_ptr();
    for y in 0..s.rows {
        let p = at.map(|a| x[a + y * s.row..].as_ptr());
        for i in 0..s.width {
            // SAFETY: the largest offsets are those asserted above; `q` steps by wrapping.
            unsafe {
                let mut gs = [L::splat(0.0); V];
                for v in 0..V {
                    gs[v] = L::read(q.add(v * LANES));
                }
                for r in 0..R {
                    for k in 0..3 {
                        let b = L::splat(*p[r].add(i * s.step + k));
                        for v in 0..V {
                            acc[r][k][v] = b.fma(gs[v], acc[r][k][v]);
                        }
                    }
                }
            }
            q = q.wrapping_add(s.wide);
        }
    }
    acc
}

impl Lanes for [f32; LANES] {
    const WIDE: bool = false;
    #[inline(always)]
    fn splat(x: f32) -> Self {
        [x; LANES]
    }
    #[inline(always)]
    unsafe fn read(p: *const f32) -> Self {
        // SAFETY: the caller's; alignment is not assumed.
        unsafe { p.cast::<Self>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn write(self, p: *mut f32) {
        // SAFETY: the caller's; alignment is not assumed.
        unsafe { p.cast::<Self>().write_unaligned(self) };
    }
    #[inline(always)]
    fn add(self, o: Self) -> Self {
        std::array::from_fn(|i| self[i] + o[i])
    }
    #[inline(always)]
    fn sub(self, o: Self) -> Self {
        std::array::from_fn(|i| self[i] - o[i])
    }
    #[inline(always)]
    fn mul(self, o: Self) -> Self {
        std::array::from_fn(|i| self[i] * o[i])
    }
    #[inline(always)]
    fn div(self, o: Self) -> Self {
        std::array::from_fn(|i| self[i] / o[i])
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.map(f32::sqrt)
    }
    #[inline(always)]
    fn fma(self, a: Self, b: Self) -> Self {
        std::array::from_fn(|i| self[i].mul_add(a[i], b[i]))
    }
    #[inline(always)]
    fn relu(self) -> Self {
        self.map(|x| if 0.0 > x { 0.0 } else { x })
    }
    #[inline(always)]
    fn where_positive(self, gate: Self) -> Self {
        std::array::from_fn(|i| if gate[i] > 0.0 { self[i] } else { 0.0 })
    }
}

#[cfg(target_arch = "x86_64")]
mod native {
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

    // SAFETY of every block below: the instructions exist wherever a value of the type does (module proof).
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
    }
}
