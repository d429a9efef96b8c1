//! Buffers of one thread.

use crate::{
    light::{emitters::Emitters, light_vertices::LightVertices, mirror_images::Mirrors},
    scene::{bvh::tree::Stack, world::World},
};

/// Buffers of one thread's walks.
#[derive(Debug)]
pub(crate) struct Scratch {
    pub stack: Stack,
    /// Weights of spots.
    pub weights: Vec<f32>,
    /// Weights of the spots' images in mirrors.
    pub images: Vec<f32>,
    /// Weights of light vertices.
    pub lights: Vec<f32>,
    /// Densities for `lights` or for weights of spots.
    pub plain: Vec<f32>,
    /// Light vertices that walks connect to.
    pub vertices: LightVertices,
    /// Light vertices beyond near-mirrors.
    pub caustics: LightVertices,
    /// Light vertices in the zones of spots close to other surfaces.
    pub contacts: LightVertices,
}

impl Scratch {
    pub fn new(world: &World, emitters: &Emitters, mirrors: &Mirrors) -> Self {
        Self {
            stack: world.bvh.stack(),
            weights: vec![0.0; emitters.list.len()],
            images: vec![0.0; mirrors.choices()],
            lights: vec![],
            plain: vec![],
            vertices: LightVertices::default(),
            caustics: LightVertices::default(),
            contacts: LightVertices::default(),
        }
    }
}
