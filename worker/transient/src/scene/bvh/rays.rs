//! The rays of a bundle in columns.

use picofarm_scene::Vec3;

/// Working memory for bundles.
#[derive(Debug, Clone)]
pub(crate) struct Scratch {
    /// Directions of all rays of a call, in all classes.
    pub all: [Column; 3],
    pub rays: Rays,
}

impl Scratch {
    pub(crate) fn new() -> Self {
        let zeros = [[0.0; MOST]; 3];
        Self {
            all: zeros,
            rays: Rays {
                o: Vec3::ZERO,
                count: 0,
                axes: [0, 1, 2],
                negative: false,
                d: zeros,
                inverse: zeros,
                shear: zeros,
            },
        }
    }
}

/// Number of rays in a bundle: the bits of a mask.
pub(crate) const MOST: usize = 64;

/// One number per ray.
pub(crate) type Column = [f32; MOST];

/// Rays from one point with their largest component on the same axis with the same sign. Lanes
/// beyond the last ray repeat the first.
#[derive(Debug, Clone)]
pub(crate) struct Rays {
    pub o: Vec3,
    pub count: usize,
    /// x and y of the shear, and the axis of the largest component.
    pub axes: [usize; 3],
    /// Whether the largest component is negative.
    pub negative: bool,
    /// Direction: to − from.
    pub d: [Column; 3],
    pub inverse: [Column; 3],
    /// Shear: x, y, z of Woop et al.
    pub shear: [Column; 3],
}
