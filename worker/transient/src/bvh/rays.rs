//! The rays of a bundle in columns.

use picofarm_scene::Vec3;

/// Number of rays in a bundle: the bits of a mask.
pub(super) const MOST: usize = 64;

/// One number per ray.
pub(super) type Column = [f32; MOST];

/// Rays from one point with their largest component on the same axis with the same sign. Lanes
/// beyond the last ray repeat the first.
#[derive(Debug, Clone)]
pub(super) struct Rays {
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
