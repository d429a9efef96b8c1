//! The tree, and the scratch memory of its traversals.

use picofarm_scene::Vec3;

use crate::scene::bvh::{
    lanes,
    nodes::{Kernel, LEAF, Node, Pack, packs},
    rays,
};

/// The hierarchy. Triangles are identified by their index in the slice that it was built from.
#[derive(Debug)]
pub struct Bvh {
    pub(crate) nodes: Vec<Node>,
    pub(crate) packs: Vec<Pack>,
    pub(crate) depth: usize,
    pub(crate) kernel: Kernel,
}

/// Scratch memory of one thread's traversals. It also counts the rays.
#[derive(Debug)]
pub struct Stack {
    pub(crate) entries: Vec<(u32, f32)>,
    /// For bundles: the mask of the rays of each entry.
    pub(crate) masks: Vec<u64>,
    pub(crate) bundle: Box<rays::Scratch>,
    /// The hits of a segment with glass.
    pub(crate) met: Vec<(f32, u32)>,
    /// By segment of a bundle: whether glass crosses it.
    pub(crate) crossed: Vec<bool>,
    /// Rays traced with this stack.
    pub rays: u64,
}

impl Bvh {
    /// Returns the required stack size: a bundle's entries, and above them those of a single ray
    /// that the bundle continues with.
    pub(crate) fn deepest(&self) -> usize {
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
            bundle: Box::new(rays::Scratch::new()),
            rays: 0,
        }
    }

    /// Prefetches a child's node or first pack.
    #[inline(always)]
    pub(crate) fn prefetch<L: lanes::Lanes>(&self, child: u32) {
        if child & LEAF == 0 {
            L::prefetch(&self.nodes[child as usize]);
        } else {
            L::prefetch(&self.packs[packs(child).start]);
        }
    }
}

/// Returns whether a ray is usable. NaN and infinite rays would select every lane, including empty
/// ones, so they are rejected up front.
#[inline(always)]
pub(crate) fn usable(o: Vec3, d: Vec3, limit: f32) -> bool {
    (o.x + o.y + o.z + d.x + d.y + d.z).is_finite() && limit > 0.0 && d.dot(d) > 0.0
}
