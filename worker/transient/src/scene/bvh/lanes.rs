//! SIMD lanes of floats: the operations that the traversal needs, and the portable version.

/// `N` f32 lanes. Comparisons return a bit mask with lane 0 in the lowest bit. `min` and `max`
/// follow the machine's rule: they return the second operand if either is NaN.
pub(crate) trait Lanes: Copy {
    /// Number of lanes: 8 or 16.
    const N: usize;
    /// Prefetches `x` into the cache; a hint.
    #[inline(always)]
    fn prefetch<T>(_x: &T) {}
    fn splat(x: f32) -> Self;
    /// Loads the first `N` numbers of `a`.
    fn load(a: &[f32]) -> Self;
    /// Stores into the first `N` numbers of `a`.
    fn store(self, a: &mut [f32]);
    fn add(self, o: Self) -> Self;
    fn sub(self, o: Self) -> Self;
    fn mul(self, o: Self) -> Self;
    fn div(self, o: Self) -> Self;
    fn min(self, o: Self) -> Self;
    fn max(self, o: Self) -> Self;
    /// Returns the least of all lanes, none of which is NaN.
    fn least(self) -> f32;
    /// Returns the greatest of all lanes, none of which is NaN.
    fn greatest(self) -> f32;
    fn le(self, o: Self) -> u32;
    fn gt(self, o: Self) -> u32;
    /// Returns a mask of the lanes that differ, neither operand being NaN.
    fn differs(self, o: Self) -> u32;
}

#[inline(always)]
fn zip(a: [f32; 8], b: [f32; 8], f: impl Fn(f32, f32) -> f32) -> [f32; 8] {
    std::array::from_fn(|i| f(a[i], b[i]))
}

#[inline(always)]
fn mask(a: [f32; 8], b: [f32; 8], f: impl Fn(f32, f32) -> bool) -> u32 {
    (0..8).fold(0, |m, i| m | (u32::from(f(a[i], b[i])) << i))
}

impl Lanes for [f32; 8] {
    const N: usize = 8;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        [x; 8]
    }

    #[inline(always)]
    fn load(a: &[f32]) -> Self {
        std::array::from_fn(|i| a[i])
    }

    #[inline(always)]
    fn store(self, a: &mut [f32]) {
        a[..8].copy_from_slice(&self);
    }

    #[inline(always)]
    fn add(self, o: Self) -> Self {
        zip(self, o, |a, b| a + b)
    }

    #[inline(always)]
    fn sub(self, o: Self) -> Self {
        zip(self, o, |a, b| a - b)
    }

    #[inline(always)]
    fn mul(self, o: Self) -> Self {
        zip(self, o, |a, b| a * b)
    }

    #[inline(always)]
    fn div(self, o: Self) -> Self {
        zip(self, o, |a, b| a / b)
    }

    #[inline(always)]
    fn min(self, o: Self) -> Self {
        zip(self, o, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, o: Self) -> Self {
        zip(self, o, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn least(self) -> f32 {
        self.into_iter().fold(f32::INFINITY, f32::min)
    }

    #[inline(always)]
    fn greatest(self) -> f32 {
        self.into_iter().fold(f32::NEG_INFINITY, f32::max)
    }

    #[inline(always)]
    fn le(self, o: Self) -> u32 {
        mask(self, o, |a, b| a <= b)
    }

    #[inline(always)]
    fn gt(self, o: Self) -> u32 {
        mask(self, o, |a, b| a > b)
    }

    #[inline(always)]
    fn differs(self, o: Self) -> u32 {
        mask(self, o, |a, b| a.partial_cmp(&b).is_some_and(|c| c.is_ne()))
    }
}
