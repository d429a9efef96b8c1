//! A vertex of a path from the camera.

use picofarm_scene::Vec3;

use crate::{spectra::Ratios, world::Hit};

/// A vertex of a path from the camera.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Vertex {
    pub hit: Hit,
    /// Unit direction back along the path.
    pub wo: Vec3,
    /// Product of scattering and sampling weights up to here.
    pub beta: f32,
    /// Ratios of that product.
    pub ratios: Ratios,
    /// Optical path from where the walk is counted, metres.
    pub length_m: f64,
    /// Bounces up to and with this vertex.
    pub bounce: u32,
    /// The vertex before it is a near-mirror's.
    pub after_mirror: bool,
    /// [`Vertex::open`] of the vertex before it.
    pub open_before: bool,
}

impl Vertex {
    /// True where light paths ([`crate::caustic`]) end on a vertex up to here that is not a near-mirror's: one that the
    /// camera sees directly, or before which another such vertex comes.
    #[inline]
    pub fn open(&self) -> bool {
        let directly = !self.hit.surface.specular() && !self.after_mirror;
        directly || self.open_before
    }
}
