//! The context in which light paths are traced.

use crate::{
    api::Gate,
    light::{emitters::Emitters, mirror_images::Mirrors},
    scene::world::World,
};

/// The context in which light paths are traced.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Surroundings<'a> {
    pub world: &'a World,
    pub emitters: &'a Emitters,
    pub mirrors: &'a Mirrors,
    pub gate: &'a Gate,
    /// Longest path in bounces.
    pub max_bounces: u32,
}
