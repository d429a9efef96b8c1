//! Segments from one point to many.

use picofarm_scene::Vec3;

use crate::{bvh::Stack, world::World};

/// Segments from one point: where they end, of what, and whether something is in the way.
#[derive(Debug, Default)]
pub(super) struct Segments {
    ends: Vec<Vec3>,
    of: Vec<usize>,
    blocked: Vec<bool>,
}

impl Segments {
    pub fn clear(&mut self) {
        self.ends.clear();
        self.of.clear();
    }

    /// Adds one that ends at `end`, of what `of` stands for.
    pub fn push(&mut self, of: usize, end: Vec3) {
        self.ends.push(end);
        self.of.push(of);
    }

    /// Looks from `from`, with one bundle of rays, whether something is in the way of each.
    pub fn trace(&mut self, world: &World, stack: &mut Stack, from: Vec3) {
        self.blocked.resize(self.ends.len(), false);
        let blocked = &mut self.blocked;
        world.bvh.occluded_bundle(stack, from, &self.ends, blocked);
    }

    /// Of what they are, and where they end.
    pub fn iter(&self) -> impl Iterator<Item = (usize, Vec3)> {
        self.of.iter().copied().zip(self.ends.iter().copied())
    }

    /// Of what each is, and whether something is in its way.
    pub fn found(&self) -> impl Iterator<Item = (usize, bool)> {
        self.of.iter().copied().zip(self.blocked.iter().copied())
    }
}
