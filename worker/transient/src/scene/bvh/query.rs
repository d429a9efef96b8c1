//! Rays and bundles of rays against the tree.

use picofarm_scene::Vec3;

use crate::scene::bvh::{
    bundle,
    nodes::{EMPTY, Kernel},
    simd,
    tree::{Bvh, Stack, usable},
};

impl Bvh {
    /// Returns the same tree with another kernel; `None` if this machine lacks it.
    pub fn with_kernel(mut self, kernel: Kernel) -> Option<Self> {
        if !simd::available(kernel) {
            return None;
        }
        self.kernel = kernel;
        Some(self)
    }

    /// Returns the nearest triangle that `origin + t · direction` hits with 0 < t ≤ `limit`, as (t,
    /// index); among triangles at equal t the lowest index. Returns `None` for rays that are not
    /// finite.
    #[inline]
    pub fn closest(
        &self,
        stack: &mut Stack,
        origin: Vec3,
        direction: Vec3,
        limit: f32,
    ) -> Option<(f32, u32)> {
        stack.rays += 1;
        if !usable(origin, direction, limit) || self.nodes.is_empty() {
            return None;
        }
        let (t, id) = match self.kernel {
            Kernel::Avx512 => simd::closest_avx512(self, stack, origin, direction, limit),
            Kernel::Avx2 => simd::closest_avx2(self, stack, origin, direction, limit),
            Kernel::Portable => simd::closest_portable(self, stack, origin, direction, limit),
        };
        (id != EMPTY).then_some((t, id))
    }

    /// Returns whether a triangle is hit with 0 < t ≤ `limit`. Rays that are not finite count as
    /// blocked.
    #[inline]
    pub fn occluded(&self, stack: &mut Stack, origin: Vec3, direction: Vec3, limit: f32) -> bool {
        stack.rays += 1;
        if !usable(origin, direction, limit) {
            return true;
        }
        if self.nodes.is_empty() {
            return false;
        }
        self.any(stack, origin, direction, limit)
    }

    /// Tests the segments from one point to many: `blocked[i]` becomes
    /// `occluded(stack, from, to[i] - from, 1.0)`, bit for bit, independently of the rest of the
    /// bundle. The origin of every ray is `from`; the same segments traced from their other ends
    /// may differ in grazing cases. Bundles are fast if the targets are close together as seen from
    /// there, best on one surface: up to five times as fast as single rays for 64 targets (the
    /// natural number; any is allowed), twice for 8, no gain below 6.
    ///
    /// # Panics
    /// If the lengths of `to` and `blocked` differ.
    pub fn occluded_bundle(
        &self,
        stack: &mut Stack,
        from: Vec3,
        to: &[Vec3],
        blocked: &mut [bool],
    ) {
        assert_eq!(to.len(), blocked.len(), "one answer for each target");
        if to.len() < bundle::FEWEST || self.nodes.is_empty() {
            for (b, &p) in blocked.iter_mut().zip(to) {
                *b = self.occluded(stack, from, p - from, 1.0);
            }
            return;
        }
        stack.rays += to.len() as u64;
        match self.kernel {
            // Two registers of eight are faster than one of sixteen (measured).
            Kernel::Avx512 if to.len() <= 16 => simd::bundle_avx2(self, stack, from, to, blocked),
            Kernel::Avx512 => simd::bundle_avx512(self, stack, from, to, blocked),
            Kernel::Avx2 => simd::bundle_avx2(self, stack, from, to, blocked),
            Kernel::Portable => simd::bundle_portable(self, stack, from, to, blocked),
        }
    }

    /// Returns whether there is any hit in (0, `limit`] for a usable ray in a tree with nodes.
    #[inline(always)]
    pub(crate) fn any(&self, stack: &mut Stack, origin: Vec3, direction: Vec3, limit: f32) -> bool {
        match self.kernel {
            Kernel::Avx512 => simd::any_avx512(self, stack, origin, direction, limit),
            Kernel::Avx2 => simd::any_avx2(self, stack, origin, direction, limit),
            Kernel::Portable => simd::any_portable(self, stack, origin, direction, limit),
        }
    }
}
