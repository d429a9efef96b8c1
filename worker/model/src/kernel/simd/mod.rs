//! Sixteen lanes for each instruction set, and the two inner loops of the convolutions: the only
//! unsafe code here.
//!
//! Proof. The intrinsics require AVX-512 ([`native::Wide`]) or AVX2 with FMA ([`native::Pair`]).
//! Values of these types are created only within [`Kernels::run`], which calls the function that
//! enables the feature, and only if a [`Kernels`] has that instruction set; [`Kernels::with`]
//! creates one only after the run-time check. [`Lanes::load`] and [`Lanes::store`] check the length
//! of their slice. The two [`loops`] read through raw pointers; each asserts at entry that the
//! largest offset it forms is inside its slices.
//!
//! No function called by [`Op::run`] may be a closure that is not inlined: closures do not inherit
//! the enabled features, which costs speed (not correctness).
#![expect(
    unsafe_code,
    reason = "vector intrinsics behind run-time detection, unchecked inner loops; proof above"
)]

mod loops;

pub(super) use loops::{Positions, outer, shifted};

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

/// The kernels on an instruction set that this machine supports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kernels(Isa);

impl Kernels {
    /// Returns the kernels on the widest instruction set of this machine.
    pub fn best() -> Self {
        let wide = Self::with(Isa::Avx512).or_else(|| Self::with(Isa::Avx2));
        wide.unwrap_or(Self(Isa::Portable))
    }

    /// Returns the kernels on the given instruction set, or `None` if this machine lacks it.
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

/// An operation written once for all instruction sets. `run` must be `#[inline(always)]`.
pub(super) trait Op {
    /// The operation's result.
    type Out;
    /// Runs the operation with one kind of lanes.
    fn run<L: Lanes>(self) -> Self::Out;
}

/// Sixteen `f32` lanes.
pub(super) trait Lanes: Copy {
    /// Whether there are thirty-two registers of sixteen lanes. It determines the register tile,
    /// never a result.
    const WIDE: bool;
    fn splat(x: f32) -> Self;
    /// Reads the sixteen values at `p`.
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
    /// `self > o ? self : o`: if either is NaN, `o`.
    fn max(self, o: Self) -> Self;
    /// 2 to the power of each lane, which is a whole number from -126 to 127.
    fn power_of_two(self) -> Self;

    /// Loads the first sixteen values of a slice.
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
    /// Returns the lanes as an array.
    #[inline(always)]
    fn array(self) -> [f32; LANES] {
        let mut a = [0.0; LANES];
        self.store(&mut a);
        a
    }
    /// Loads up to sixteen values of a slice; missing ones are filled with `pad`.
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
    /// Returns the even and the odd values of two consecutive registers.
    #[inline(always)]
    fn unzip(a: Self, b: Self) -> (Self, Self) {
        let (a, b) = (a.array(), b.array());
        let at = |i: usize| if i < LANES { a[i] } else { b[i - LANES] };
        let even: [f32; LANES] = std::array::from_fn(|i| at(2 * i));
        let odd: [f32; LANES] = std::array::from_fn(|i| at(2 * i + 1));
        (Self::load(&even), Self::load(&odd))
    }
    /// The reverse of [`Lanes::unzip`].
    #[inline(always)]
    fn zip(even: Self, odd: Self) -> (Self, Self) {
        let (even, odd) = (even.array(), odd.array());
        let at = |i: usize| {
            if i.is_multiple_of(2) {
                even[i / 2]
            } else {
                odd[i / 2]
            }
        };
        let a: [f32; LANES] = std::array::from_fn(at);
        let b: [f32; LANES] = std::array::from_fn(|i| at(i + LANES));
        (Self::load(&a), Self::load(&b))
    }
    /// Exchanges rows and lanes.
    #[inline(always)]
    fn transpose(rows: [Self; LANES]) -> [Self; LANES] {
        let from = rows.map(Self::array);
        let mut to = rows;
        for (i, to) in to.iter_mut().enumerate() {
            let mut t = [0.0; LANES];
            for (t, from) in t.iter_mut().zip(&from) {
                *t = from[i];
            }
            *to = Self::load(&t);
        }
        to
    }
    /// Returns the sum by a fixed tree: the upper half is added to the lower one repeatedly.
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
    #[inline(always)]
    fn max(self, o: Self) -> Self {
        std::array::from_fn(|i| if self[i] > o[i] { self[i] } else { o[i] })
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        self.map(|n| f32::from_bits((n as i32).wrapping_add(127).cast_unsigned() << 23))
    }
}

#[cfg(target_arch = "x86_64")]
mod native;
