//! How a vertex was reached.

use picofarm_scene::Vec3;

/// How a vertex was reached, for MIS.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Step {
    pub p: Vec3,
    pub n: Vec3,
    /// Density per steradian of the direction taken, summed over all techniques that can draw it.
    pub pdf: f32,
    /// Expected number of aims at `p`.
    pub aims: f32,
}
