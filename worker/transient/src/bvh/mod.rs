//! An 8-wide bounding volume hierarchy over triangles with a watertight triangle test.
//!
//! `obvhs` builds a binary tree (PLOC with reinsertion), which is collapsed to eight children a node.
//! Rays meet triangles by the test of Woop, Benthin and Wald (JCGT 2013), edges included and without
//! fused multiply-add, so that no ray slips between two triangles that share an edge or a vertex.
//! The AVX2 kernel and the portable one run the same operations in the same order: same bits.

mod avx2;
mod build;
mod lanes;
mod traverse;

use picofarm_scene::Vec3;

pub(crate) use build::normal;

/// Bounds of eight children (min xyz, max xyz), and what they are.
#[repr(C, align(64))]
#[derive(Debug, Clone, Copy)]
struct Node {
    bounds: [[f32; 8]; 6],
    child: [u32; 8],
}

/// Eight triangles: vertex components a.xyz, b.xyz, c.xyz; NaN in unused lanes, which never hit.
#[repr(C, align(32))]
#[derive(Debug, Clone, Copy)]
struct Pack {
    vertex: [[f32; 8]; 9],
    id: [u32; 8],
}

/// A child that is a leaf: count of packs in bits 27..31, first pack below.
const LEAF: u32 = 0x8000_0000;
/// A child that does not exist; its bounds are never met.
const EMPTY: u32 = u32::MAX;

/// Which code traverses the tree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kernel {
    /// Eight lanes in AVX2 registers.
    Avx2,
    /// Plain scalar code, the same operations in the same order.
    Portable,
}

/// The hierarchy. Triangles are known by their index in the slice it was built from.
#[derive(Debug)]
pub struct Bvh {
    nodes: Vec<Node>,
    packs: Vec<Pack>,
    depth: usize,
    kernel: Kernel,
}

/// Scratch memory of one thread's traversals; counts the rays.
#[derive(Debug)]
pub struct Stack {
    entries: Vec<(u32, f32)>,
    /// Rays traced with this stack.
    pub rays: u64,
}

impl Bvh {
    /// Builds the hierarchy; triangles without area or with vertices that are not finite are left out.
    pub fn build(triangles: &[[Vec3; 3]]) -> Self {
        build::build(triangles)
    }

    /// The same tree traversed by another kernel; `None` where this machine lacks it.
    pub fn with_kernel(mut self, kernel: Kernel) -> Option<Self> {
        if kernel == Kernel::Avx2 && !avx2::available() {
            return None;
        }
        self.kernel = kernel;
        Some(self)
    }

    /// A stack deep enough for this tree.
    pub fn stack(&self) -> Stack {
        Stack {
            entries: vec![(0, 0.0); 8 * (self.depth + 2)],
            rays: 0,
        }
    }

    /// The nearest triangle that `origin + t · direction` meets with 0 < t ≤ `limit`, as (t, index);
    /// among triangles at equal t the lowest index. `None` for rays that are not finite.
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
            Kernel::Avx2 => avx2::closest(self, stack, origin, direction, limit),
            Kernel::Portable => traverse::traverse::<[f32; 8], false>(
                self,
                &mut stack.entries,
                origin,
                direction,
                limit,
            ),
        };
        (id != EMPTY).then_some((t, id))
    }

    /// True where a triangle is met with 0 < t ≤ `limit`. Rays that are not finite count as blocked.
    #[inline]
    pub fn occluded(&self, stack: &mut Stack, origin: Vec3, direction: Vec3, limit: f32) -> bool {
        stack.rays += 1;
        if !usable(origin, direction, limit) {
            return true;
        }
        if self.nodes.is_empty() {
            return false;
        }
        let (_, id) = match self.kernel {
            Kernel::Avx2 => avx2::any(self, stack, origin, direction, limit),
            Kernel::Portable => traverse::traverse::<[f32; 8], true>(
                self,
                &mut stack.entries,
                origin,
                direction,
                limit,
            ),
        };
        id != EMPTY
    }

    /// Which of the segments from ONE point to many are blocked: `blocked[i]` becomes
    /// `occluded(stack, from, to[i] - from, 1.0)`, bit for bit, whatever else is in the bundle. The origin
    /// of every ray is `from`: the same segments from their other ends may differ in grazing cases. Fast
    /// where the targets lie close together, any number of them. Panics where the lengths differ.
    pub fn occluded_bundle(
        &self,
        stack: &mut Stack,
        from: Vec3,
        to: &[Vec3],
        blocked: &mut [bool],
    ) {
        assert_eq!(to.len(), blocked.len(), "one answer for each target");
        for (b, &p) in blocked.iter_mut().zip(to) {
            *b = self.occluded(stack, from, p - from, 1.0);
        }
    }
}

/// NaN and infinite rays would select every lane, empty ones included: they are refused up front.
#[inline(always)]
fn usable(o: Vec3, d: Vec3, limit: f32) -> bool {
    (o.x + o.y + o.z + d.x + d.y + d.z).is_finite() && limit > 0.0 && d.dot(d) > 0.0
}
