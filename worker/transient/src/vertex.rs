//! A vertex of a path from the camera.

use picofarm_scene::Vec3;

use crate::{caustic, spectra::Ratios, world::Hit};

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
    /// Where it lies on the path.
    pub place: Place,
}

/// Where a vertex lies on a path from the camera, as far as light paths ([`crate::caustic`]) are concerned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Place {
    /// Roughness of the near-mirror before it; infinite where none is.
    before: f32,
    /// Only near-mirrors lie between the camera and it.
    by_mirrors: bool,
    /// [`Vertex::open`] of the vertex before it.
    open_before: f32,
}

impl Place {
    /// What the camera sees.
    pub const FIRST: Self = Self {
        by_mirrors: true,
        ..Self::ELSEWHERE
    };
    /// Where a walk begins that the camera does not see.
    pub const ELSEWHERE: Self = Self {
        before: f32::INFINITY,
        by_mirrors: false,
        open_before: 0.0,
    };
}

impl Vertex {
    /// Light paths whose first near-mirror is smoother than this end on a vertex up to here: all of them on one that the camera sees
    /// directly or before which another one comes that is no near-mirror's, and on one that the camera sees in near-mirrors those
    /// that pay there.
    #[inline]
    pub fn open(&self) -> f32 {
        let Place {
            before,
            by_mirrors,
            open_before,
        } = self.place;
        if self.hit.surface.specular() {
            open_before
        } else if before == f32::INFINITY {
            before
        } else if by_mirrors {
            caustic::pays_below(before)
        } else {
            open_before
        }
    }

    /// The place of what follows it.
    #[inline]
    pub fn next(&self) -> Place {
        let specular = self.hit.surface.specular();
        Place {
            before: match specular {
                true => self.hit.surface.alpha(),
                false => f32::INFINITY,
            },
            by_mirrors: self.place.by_mirrors && specular,
            open_before: self.open(),
        }
    }
}
