//! Light that glass turns.

use serde::{Deserialize, Serialize};

/// Light that glass turns: reflected by panes, or reflected and refracted by bodies.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GlassTuning {
    /// Least probability of a camera path in a pixel that sees no glass.
    pub elsewhere: f32,
    /// Factor from the share of glass, weighted by reflectance, in the area of all surfaces to that
    /// probability. A small area of glass contributes little.
    pub by_area: f32,
    /// Weight of panes in which spots have images as targets of light paths, as a share of the
    /// weight of other panes. Such panes are targets only for light with further turns.
    pub imaged: f32,
    /// Largest sum of the squared diagonals of two boxes that is worth a cut, relative to that of
    /// the box that they divide.
    pub cut_pays: f32,
    /// Share of a camera path's directions that are drawn within cones around glass.
    pub aimed: f32,
    /// Least probability of choosing a pane's reflection before the first turn.
    pub seek: f32,
    /// Largest number of images of spots that the first point of a camera path is connected to.
    pub first_images: u32,
    /// The same for any other point.
    pub images: u32,
    /// Largest number of images of lit points that the first point is connected to.
    pub first_lit: u32,
    /// The same for any other point.
    pub lit: u32,
    /// Largest number of spots that a point after the first is connected to.
    pub spots: u32,
    /// Largest number of light vertices that any point is connected to.
    pub light_vertices: u32,
    /// Largest number of planes, by area, that points are connected by. Light reflected by other
    /// planes is left to light paths.
    pub most_planes: usize,
    /// Least share of the whole area for such a plane.
    pub least_share: f32,
    /// Largest number of planes that panes are compared with, because curved glass has one for each
    /// facet.
    pub most_known: usize,
    /// Lit points that are considered for one connection, in all planes together.
    pub looked_at: usize,
    /// Least number of those for one plane.
    pub least_looked_at: usize,
    /// Greatest number of those for one plane.
    pub most_looked_at: usize,
    /// Vertices of a light path before Russian roulette starts.
    pub sure: u32,
    /// Largest number of lit points.
    pub lit_points: u32,
    /// Light vertices that the walks of lit points are connected to.
    pub lit_light_vertices: u32,
    /// Largest distance of a photon from the plane of a camera path's end, as a share of the
    /// radius. Farther ones are on another surface.
    pub photon_flat: f32,
    /// Least cosine between the normals of both.
    pub photon_alike: f32,
    /// Least probability of choosing a body's reflection, if it reflects at all.
    pub reflect: f32,
    /// Turns of one leg before Russian roulette starts for rays that lost light. Roulette must
    /// not end rays under repeated total reflection, because the few survivors would have a large
    /// weight.
    pub sure_turns: u32,
    /// Largest number of turns of one leg.
    pub most_turns: u32,
    /// Factor from a path's weight to the probability that a camera path continues.
    pub survival: f32,
    /// The largest such probability.
    pub most_survival: f32,
    /// Light paths per pass and pixel.
    pub paths: f64,
    /// Light paths that the camera paths of a stream are connected to.
    pub stream_paths: u32,
}

impl Default for GlassTuning {
    fn default() -> Self {
        Self {
            elsewhere: 0.125,
            by_area: 100.0,
            imaged: 0.1,
            cut_pays: 0.7,
            aimed: 0.5,
            seek: 0.5,
            first_images: 4,
            images: 1,
            first_lit: 2,
            lit: 1,
            spots: 6,
            light_vertices: 1,
            most_planes: 8,
            least_share: 0.02,
            most_known: 4096,
            looked_at: 64,
            least_looked_at: 4,
            most_looked_at: 32,
            sure: 3,
            lit_points: 128,
            lit_light_vertices: 64,
            photon_flat: 0.25,
            photon_alike: 0.7,
            reflect: 0.1,
            sure_turns: 4,
            most_turns: 400,
            survival: 1.5,
            most_survival: 0.95,
            paths: 1.0,
            stream_paths: 128,
        }
    }
}
