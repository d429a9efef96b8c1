//! Buffers of one thread.

use crate::{
    light::light_vertices::LightVertices,
    paths::{glass::lit_points::LitPoints, scratch::Scratch, tracer::Tracer},
    scene::{bvh::tree::Stack, panes::Crossing},
};

/// Buffers of a thread.
#[derive(Debug)]
pub(crate) struct Buffers {
    pub scratch: Scratch,
    pub crossings: Vec<Crossing>,
    pub lights: Vec<f32>,
    pub vertices: LightVertices,
    pub lit: LitPoints,
}

impl Buffers {
    pub fn new(tracer: &Tracer) -> Self {
        Self {
            scratch: Scratch::new(tracer.world, tracer.emitters, tracer.mirrors),
            crossings: vec![],
            lights: vec![],
            vertices: LightVertices::default(),
            lit: LitPoints::default(),
        }
    }

    /// Returns the stack for traversals.
    pub fn stack(&mut self) -> &mut Stack {
        &mut self.scratch.stack
    }
}
