//! Nodes, leaves and kernels of the hierarchy.

/// Bounds of eight children (min xyz, max xyz), and their codes.
#[repr(C, align(64))]
#[derive(Debug, Clone, Copy)]
pub(crate) struct Node {
    pub bounds: [[f32; 8]; 6],
    pub child: [u32; 8],
}

/// Eight triangles: vertex components a.xyz, b.xyz, c.xyz. Unused lanes are NaN, so they are never
/// hit. The highest bit of an index marks a needle ([`needle`]).
#[repr(C, align(64))]
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pack {
    pub vertex: [[f32; 8]; 9],
    pub id: [u32; 8],
}

/// Marks a child as a leaf: bits 27..31 are the number of packs, bits 24..27 the number of
/// triangles in the last pack less one, and the lower bits the first pack.
pub(crate) const LEAF: u32 = 0x8000_0000;

/// Marks a child that does not exist; its bounds are never hit.
pub(crate) const EMPTY: u32 = u32::MAX;

/// Returns the packs of a leaf.
#[inline(always)]
pub(crate) fn packs(leaf: u32) -> std::ops::Range<usize> {
    let first = (leaf & 0x00ff_ffff) as usize;
    first..first + ((leaf >> 27) & 15) as usize
}

/// Returns the number of triangles in the last pack of a leaf.
#[inline(always)]
pub(crate) fn last_fill(leaf: u32) -> usize {
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
