//! Buffers of one thread.

use crate::{
    light::light_vertices::LightVertices,
    paths::{glass::lit_points::Lit, scratch::Scratch, tracer::Walk},
    scene::{bvh::tree::Stack, panes::Crossing},
};

/// Buffers of a thread.
#[derive(Debug)]
pub(crate) struct Buffers {
    pub scratch: Scratch,
    pub crossings: Vec<Crossing>,
    pub lights: Vec<f32>,
    pub vertices: LightVertices,
    pub lit: Lit,
}

impl Buffers {
    pub fn new(walk: &Walk) -> Self {
        Self {
            scratch: Scratch::new(walk.world, walk.emitters, walk.mirrors),
            crossings: vec![],
            lights: vec![],
            vertices: LightVertices::default(),
            lit: Lit::default(),
        }
    }

    /// Returns the stack for traversals.
    pub fn stack(&mut self) -> &mut Stack {
        &mut self.scratch.stack
    }
}
