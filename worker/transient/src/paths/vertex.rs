//! A vertex of a path from the camera.

use picofarm_scene::Vec3;

use crate::{light::caustics, scene::hit::Hit};

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
    /// Bounces up to and including this vertex.
    pub bounce: u32,
    /// How the camera sees it.
    pub sight: Sight,
}

/// How the camera sees a vertex of its path, as far as light paths ([`crate::light::caustics`]) are
/// concerned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sight {
    /// Roughness of the near-mirror before it; infinite if there is none.
    before: f32,
    /// Whether only near-mirrors are between the camera and the vertex.
    by_mirrors: bool,
    /// [`Vertex::open`] of the previous vertex.
    open_before: f32,
}

impl Sight {
    /// The sight of the first vertex.
    pub const FIRST: Self = Self {
        by_mirrors: true,
        ..Self::ELSEWHERE
    };

    /// The sight of the start of a walk that the camera does not see.
    pub const ELSEWHERE: Self = Self {
        before: f32::INFINITY,
        by_mirrors: false,
        open_before: 0.0,
    };
}

impl Vertex {
    /// Returns the roughness threshold for light paths to this vertex: those with a smoother first
    /// near-mirror end on a vertex up to here.
    ///
    /// All of them end on a vertex that the camera sees directly, and on one that follows another
    /// vertex outside near-mirrors. On a vertex that the camera sees only in near-mirrors, the
    /// light paths end that pay off there.
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
            caustics::pays_below(before)
        } else {
            open_before
        }
    }

    /// Returns how the camera sees the next vertex.
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
