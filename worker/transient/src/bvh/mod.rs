//! An 8-wide bounding volume hierarchy over triangles with a watertight triangle test.
//!
//! `obvhs` builds a binary tree (PLOC with reinsertion), which is collapsed to eight children per
//! node. Triangles are intersected by the test of Woop, Benthin and Wald (JCGT 2013), including
//! their edges and without fused multiply-add, so that no ray slips between two triangles that
//! share an edge or a vertex. The kernels (AVX-512, AVX2, portable) run the same operations in the
//! same order and give the same bits.

mod alike;
mod all;
mod build;
mod bundle;
mod bundle_leaf;
mod lanes;
mod needle;
mod plan;
mod pyramid;
mod rays;
mod simd;
mod traverse;

use picofarm_scene::Vec3;

pub(crate) use build::normal;
pub(crate) use needle::is_needle;

use crate::api::{RenderError, Stop, Unstopped};

/// Bounds of eight children (min xyz, max xyz), and their codes.
#[repr(C, align(64))]
#[derive(Debug, Clone, Copy)]
struct Node {
    bounds: [[f32; 8]; 6],
    child: [u32; 8],
}

/// Eight triangles: vertex components a.xyz, b.xyz, c.xyz. Unused lanes are NaN, so they are never
/// hit. The highest bit of an index marks a needle ([`needle`]).
#[repr(C, align(64))]
#[derive(Debug, Clone, Copy)]
struct Pack {
    vertex: [[f32; 8]; 9],
    id: [u32; 8],
}

/// Marks a child as a leaf: bits 27..31 are the number of packs, bits 24..27 the number of
/// triangles in the last pack less one, and the lower bits the first pack.
const LEAF: u32 = 0x8000_0000;
/// Marks a child that does not exist; its bounds are never hit.
const EMPTY: u32 = u32::MAX;

/// Returns the packs of a leaf.
#[inline(always)]
fn packs(leaf: u32) -> std::ops::Range<usize> {
    let first = (leaf & 0x00ff_ffff) as usize;
    first..first + ((leaf >> 27) & 15) as usize
}

/// Returns the number of triangles in the last pack of a leaf.
#[inline(always)]
fn last_fill(leaf: u32) -> usize {
    ((leaf >> 24) & 7) as usize + 1
}

/// The code that traverses the tree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kernel {
    /// Eight lanes in AVX2 registers, sixteen in AVX-512 registers for bundles.
    Avx512,
    /// Eight lanes in AVX2 registers.
    Avx2,
    /// Plain scalar code, the same operations in the same order.
    Portable,
}

/// The hierarchy. Triangles are identified by their index in the slice that it was built from.
#[derive(Debug)]
pub struct Bvh {
    nodes: Vec<Node>,
    packs: Vec<Pack>,
    depth: usize,
    kernel: Kernel,
}

/// Scratch memory of one thread's traversals. It also counts the rays.
#[derive(Debug)]
pub struct Stack {
    entries: Vec<(u32, f32)>,
    /// For bundles: the mask of the rays of each entry.
    masks: Vec<u64>,
    bundle: Box<bundle::Scratch>,
    /// The hits of a segment with glass.
    pub(crate) met: Vec<(f32, u32)>,
    /// By segment of a bundle: whether glass crosses it.
    pub(crate) crossed: Vec<bool>,
    /// Rays traced with this stack.
    pub rays: u64,
}

impl Bvh {
    /// Builds the hierarchy. Triangles without area or with vertices that are not finite are left
    /// out.
    pub fn build(triangles: &[[Vec3; 3]]) -> Self {
        build::build_unless(triangles, Stop(&Unstopped)).expect("nobody stops it")
    }

    /// Like [`Bvh::build`], but returns an error if a stop is requested.
    pub(crate) fn build_unless(triangles: &[[Vec3; 3]], stop: Stop) -> Result<Self, RenderError> {
        build::build_unless(triangles, stop)
    }

    /// Returns the same tree with another kernel; `None` if this machine lacks it.
    pub fn with_kernel(mut self, kernel: Kernel) -> Option<Self> {
        if !simd::available(kernel) {
            return None;
        }
        self.kernel = kernel;
        Some(self)
    }

    /// Returns the required stack size: a bundle's entries, and above them those of a single ray
    /// that the bundle continues with.
    fn deepest(&self) -> usize {
        2 * 8 * (self.depth + 2)
    }

    /// Makes the stack of another tree deep enough for this one.
    pub(crate) fn deepen(&self, stack: &mut Stack) {
        if stack.entries.len() < self.deepest() {
            stack.entries.resize(self.deepest(), (0, 0.0));
            stack.masks.resize(self.deepest(), 0);
        }
    }

    /// Returns a stack deep enough for this tree.
    pub fn stack(&self) -> Stack {
        let deepest = self.deepest();
        Stack {
            entries: vec![(0, 0.0); deepest],
            masks: vec![0; deepest],
            met: vec![],
            crossed: vec![],
            bundle: Box::new(bundle::Scratch::new()),
            rays: 0,
        }
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

    /// Prefetches a child's node or first pack.
    #[inline(always)]
    fn prefetch<L: lanes::Lanes>(&self, child: u32) {
        if child & LEAF == 0 {
            L::prefetch(&self.nodes[child as usize]);
        } else {
            L::prefetch(&self.packs[packs(child).start]);
        }
    }

    /// Returns whether there is any hit in (0, `limit`] for a usable ray in a tree with nodes.
    #[inline(always)]
    fn any(&self, stack: &mut Stack, origin: Vec3, direction: Vec3, limit: f32) -> bool {
        match self.kernel {
            Kernel::Avx512 => simd::any_avx512(self, stack, origin, direction, limit),
            Kernel::Avx2 => simd::any_avx2(self, stack, origin, direction, limit),
            Kernel::Portable => simd::any_portable(self, stack, origin, direction, limit),
        }
    }
}

/// Returns whether a ray is usable. NaN and infinite rays would select every lane, including empty
/// ones, so they are rejected up front.
#[inline(always)]
fn usable(o: Vec3, d: Vec3, limit: f32) -> bool {
    (o.x + o.y + o.z + d.x + d.y + d.z).is_finite() && limit > 0.0 && d.dot(d) > 0.0
}
