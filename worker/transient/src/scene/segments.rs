//! Segments from one point to many.

use picofarm_scene::Vec3;

use crate::scene::{bvh::tree::Stack, world::World};

/// Segments from one point: their ends, their indices, and the light that passes along each.
#[derive(Debug, Default)]
pub(crate) struct Segments {
    ends: Vec<Vec3>,
    of: Vec<usize>,
    blocked: Vec<bool>,
    through: Vec<Option<f32>>,
    /// The segments that no surface occludes and their ends, if there is glass.
    free: (Vec<usize>, Vec<Vec3>),
}

impl Segments {
    pub fn clear(&mut self) {
        self.ends.clear();
        self.of.clear();
    }

    /// Adds a segment that ends at `end`. `of` is the caller's index for it.
    pub fn push(&mut self, of: usize, end: Vec3) {
        self.ends.push(end);
        self.of.push(of);
    }

    /// Tests with one bundle of rays from `from` whether a surface occludes each segment, and with
    /// another bundle whether glass crosses the free ones.
    pub fn trace(&mut self, world: &World, stack: &mut Stack, from: Vec3) {
        self.blocked.resize(self.ends.len(), false);
        let blocked = &mut self.blocked;
        world.bvh.occluded_bundle(stack, from, &self.ends, blocked);
        self.through.clear();
        let through = blocked.iter().map(|blocked| (!blocked).then_some(1.0));
        self.through.extend(through);
        if world.has_glass() {
            let (free, ends) = &mut self.free;
            free.clear();
            ends.clear();
            for (k, end) in self.ends.iter().enumerate() {
                if self.through[k].is_some() {
                    free.push(k);
                    ends.push(*end);
                }
            }
            let through = &mut self.through;
            world.glass_bundle(stack, from, ends, |k, share| {
                through[free[k]] = Some(share);
            });
        }
    }

    /// Returns the caller's index of each segment and the fraction of light that passes, or `None`
    /// if a surface occludes it.
    pub fn found(&self) -> impl Iterator<Item = (usize, Option<f32>)> {
        self.of.iter().copied().zip(self.through.iter().copied())
    }
}
