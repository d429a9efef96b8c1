//! A vertex of a path from the camera.

use picofarm_scene::Vec3;

use crate::{caustic, world::Hit};

/// A vertex of a path from the camera.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Vertex {
    pub hit: Hit,
    /// Unit direction back along the path.
    pub wo: Vec3,
    /// Product of scattering and sampling weights up to here.
    pub beta: f32,
    /// Optical path from where the walk is counted, metres.
    pub length_m: f64,
    /// Bounces up to and with this vertex.
    pub bounce: u32,
    /// How the camera sees it.
    pub sight: Sight,
}

/// How the camera sees a vertex of its path, as far as light paths ([`crate::caustic`]) are concerned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sight {
    /// Roughness of the near-mirror before it; infinite where none is.
    before: f32,
    /// Only near-mirrors lie between the camera and it.
    by_mirrors: bool,
    /// [`Vertex::open`] of the vertex before it.
    open_before: f32,
}

impl Sight {
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
        let Sight {
            before,
            by_mirrors,
            open_before,
        } = self.sight;
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

    /// How it sees what follows.
    #[inline]
    pub fn next(&self) -> Sight {
        let specular = self.hit.surface.specular();
        Sight {
            before: match specular {
                true => self.hit.surface.alpha(),
                false => f32::INFINITY,
            },
            by_mirrors: self.sight.by_mirrors && specular,
            open_before: self.open(),
        }
    }
}
