//! Segments from one point to many.

use picofarm_scene::Vec3;

use crate::{bvh::Stack, world::World};

/// Segments from one point: where they end, of what they are, and what light takes each.
#[derive(Debug, Default)]
pub(crate) struct Segments {
    ends: Vec<Vec3>,
    of: Vec<usize>,
    blocked: Vec<bool>,
    through: Vec<Option<f32>>,
    /// Which are free of surfaces, where there is glass, and their ends.
    free: (Vec<usize>, Vec<Vec3>),
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

    /// Looks from `from`, with one bundle of rays, whether a surface is in the way of each, and with another one whether glass
    /// is in the way of those that are free.
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

    /// Of what each is, and the share of light that goes through: `None` where a surface is in the way.
    pub fn found(&self) -> impl Iterator<Item = (usize, Option<f32>)> {
        self.of.iter().copied().zip(self.through.iter().copied())
    }
}
