//! An 8-wide bounding volume hierarchy over triangles with a watertight triangle test.
//!
//! `obvhs` builds a binary tree (PLOC with reinsertion), which is collapsed to eight children per
//! node. Triangles are intersected by the test of Woop, Benthin and Wald (JCGT 2013), including
//! their edges and without fused multiply-add, so that no ray slips between two triangles that
//! share an edge or a vertex. The kernels (AVX-512, AVX2, portable) run the same operations in the
//! same order and give the same bits.

pub(crate) mod alike;
pub(crate) mod all;
pub(crate) mod build;
pub(crate) mod bundle;
pub(crate) mod bundle_leaf;
pub(crate) mod lanes;
pub(crate) mod needle;
pub(crate) mod nodes;
pub(crate) mod normal;
pub(crate) mod plan;
pub(crate) mod pyramid;
pub(crate) mod query;
pub(crate) mod rays;
pub(crate) mod simd;
pub(crate) mod traverse;
pub(crate) mod tree;
