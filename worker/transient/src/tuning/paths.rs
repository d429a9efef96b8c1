//! Two bounces, walks, shared vertices and narrow gates.

use serde::{Deserialize, Serialize};

/// Exactly two bounces.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TwoBounceTuning {
    /// Exponent of the strata per side in the pixel width, for narrow pixels. 6×6 strata, versus
    /// 4×4, at 256×256 (8 to 24 passes): error² × CPU time 0.70 to 0.92 in furnished rooms of 1 to
    /// 25 spots, 1.05 with 100.
    pub narrow_pixels: f32,
    /// Exponent of the strata per side in the passes, so that neither part of the histogram is much
    /// noisier than the other.
    pub growth: f32,
    /// Passes below which the strata are those of this many, because they cost little in
    /// comparison.
    pub least_passes: u32,
    /// Passes that the strata of a render of two bounces alone go with.
    pub alone_passes: u32,
}

impl Default for TwoBounceTuning {
    fn default() -> Self {
        Self {
            narrow_pixels: 0.1,
            growth: 0.4,
            least_passes: 8,
            alone_passes: 64,
        }
    }
}

/// Walks onward from a vertex. The numbers were chosen by error² × CPU time on the reference rooms,
/// where the optimum is flat.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WalkTuning {
    /// Largest number of spots that a vertex is connected to (2, 4 and 12 spots: 7.2, 5.7 and 6.0
    /// on room-diffuse). More connections from one vertex also correlate neighbouring bins of a
    /// pixel, so that errors of sums over bins exceed the estimate from the bins' own errors.
    pub spots: u32,
    /// Largest number of light vertices that a vertex is connected to.
    pub light_vertices: u32,
    /// Average number of aims at images of spots, from each vertex of a walk. Such a vertex matters
    /// less than a gather point and costs as much.
    pub aims: f32,
    /// Russian roulette continues a path with a probability of this multiple of its throughput.
    pub survival: f32,
    /// Light vertices count as this many samples against one sample of the BSDF in the balance
    /// heuristic.
    pub light_weight: f32,
}

impl Default for WalkTuning {
    fn default() -> Self {
        Self {
            spots: 4,
            light_vertices: 2,
            aims: 0.25,
            survival: 1.5,
            light_weight: 8.0,
        }
    }
}

/// Vertices that the pixels of a tile share. Error² × CPU time was measured on furnished rooms with
/// 4 and 25 spots, where the optimum is flat: twice as many vertices or walks cost within 10 %.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PathReuseTuning {
    /// Side of a tile, pixels. At 256×256 with 25 spots, wide tiles take 0.44 of the CPU time to
    /// the same error of a pixel, half of it to that of a sum over 4×4 pixels, as much to that of
    /// 32×32, and 2.1 times as much to that of the whole image, which is small: all pixels of a
    /// tile share the errors of the same vertices.
    pub wide_tile: u32,
    /// Side of a tile with a narrow gate, pixels. Tiles up to this side count as narrow.
    pub narrow_tile: u32,
    /// Effort in narrow tiles.
    pub narrow: TileEffort,
    /// Effort in wide tiles. A vertex costs the same as in a narrow tile, but serves more pixels.
    pub wide: TileEffort,
    /// Additional vertices drawn from gather points in wide tiles, per shared one, if gather points
    /// aim at near-mirrors.
    pub extra_with_aims: u32,
    /// Shared vertices in the shells of a narrow gate, per pixel.
    pub shell: f32,
    /// Candidates per shared vertex. Error² × CPU time of a pixel with 4 candidates and walks by
    /// weight, relative to one candidate and one walk: 0.7 to 0.85 in furnished rooms with 4 spots,
    /// 0.73 to 1.03 in rooms with near-mirrors (24×24). 2 and 8 are no better, and with 25 spots at
    /// 256×256 the ratio is 0.9 to 1.1.
    pub candidates: u32,
    /// Gather points that estimates of a candidate use. An estimate over all of them would predict
    /// the direct light of vertices close to one of them better: the variance of direct light from
    /// vertices, summed over all pixels, would be 0.4 of that without candidates, instead of 0.7.
    /// Medians and times are the same.
    pub candidate_points: usize,
    /// Gather points that light at a rough candidate is estimated for.
    pub candidate_looks: u32,
    /// Constant added to the direct light of a candidate, in means of that light over all
    /// candidates, because the light of walks is not predicted. 0.3 and 2 give the same medians.
    pub candidate_rest: f32,
    /// Average number of walks from a shared vertex that sends its light equally to all gather
    /// points.
    pub walks: f32,
    /// Least average number of walks from a shared vertex.
    pub least_walks: f32,
    /// Greatest average number of walks from a shared vertex.
    pub most_walks: f32,
    /// Largest number of spots that the first vertex of a walk from a shared vertex is connected
    /// to, if gather points aim at near-mirrors.
    pub shared_spots: u32,
    /// The same for a walk from a vertex that one pixel sees.
    pub alone_spots: u32,
    /// Largest number of spots for which the light at a rough vertex is carried to the pixels. They
    /// are drawn by contribution, because a rough vertex weighs each arrival for each pixel.
    pub rough_spots: usize,
    /// Largest number of light vertices on unshared conductors that a gather point is connected to.
    pub glossy: u32,
    /// Light paths by near-mirrors, per pixel of a tile.
    pub beyond_paths: f32,
    /// Largest number of light vertices beyond near-mirrors that a gather point is connected to.
    pub beyond: u32,
    /// The same for a near-mirror that the camera sees.
    pub shown: u32,
    /// One in this many of a pixel's camera paths is connected to light vertices beyond
    /// near-mirrors.
    pub showing: u32,
    /// Camera paths per pass through near-mirrors alone, for pixels that see one. Few of them hit a
    /// narrow lobe that a spot lights, and with a single path per pass that light was a rare event
    /// of many times the image's error.
    pub mirror_paths: u32,
}

/// The work of a pass over a tile.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TileEffort {
    /// Shared vertices drawn from gather points, per pixel.
    pub camera: f32,
    /// Shared vertices drawn from spots, per pixel.
    pub light: f32,
    /// Additional vertices drawn from gather points, per shared one, if some cannot be shared (0,
    /// 1, 3 and 7 tried on rooms with such surfaces).
    pub extra: u32,
    /// Light vertices that the walks of one pass connect to.
    pub light_vertices: u32,
}

impl Default for PathReuseTuning {
    fn default() -> Self {
        Self {
            wide_tile: 32,
            narrow_tile: 8,
            narrow: TileEffort {
                camera: 1.0,
                light: 0.5,
                extra: 3,
                light_vertices: 16,
            },
            wide: TileEffort {
                camera: 0.5,
                light: 0.25,
                extra: 7,
                light_vertices: 64,
            },
            extra_with_aims: 4,
            shell: 1.0,
            candidates: 4,
            candidate_points: 64,
            candidate_looks: 2,
            candidate_rest: 1.0,
            walks: 0.8,
            least_walks: 0.2,
            most_walks: 6.0,
            shared_spots: 8,
            alone_spots: 32,
            rough_spots: 32,
            glossy: 2,
            beyond_paths: 1.0,
            beyond: 2,
            shown: 2,
            showing: 4,
            mirror_paths: 16,
        }
    }
}

/// Ellipsoidal connections for narrow gates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EllipsoidTuning {
    /// Largest length of a gate, in scene diagonals, for ellipsoidal connections to pay, by error²
    /// × CPU time on furnished rooms with 1 and 25 spots: gains of 0.8 to 2.6 at 1/200 to 1/50, of
    /// 0.9 to 1.1 at 1/12 and losses beyond.
    pub narrow: f64,
    /// Gather points that represent a tile for its shells.
    pub stand_ins: usize,
    /// Largest difference between a path by a patch and the path by its centre, in radii of the
    /// patch. It is at most 2, and less if the patch is seen at an angle.
    pub swell: f32,
    /// Target number of patches; a scene of many small separate parts has more.
    pub patches: f32,
    /// Largest number of successive halvings of a triangle.
    pub halvings: u32,
    /// Number of pieces from which triangles stay whole, because long needles would produce
    /// millions. Larger pieces only make sampling less efficient.
    pub most_pieces: usize,
    /// Cosine above which triangles of a patch count as coplanar.
    pub flat: f32,
}

impl Default for EllipsoidTuning {
    fn default() -> Self {
        Self {
            narrow: 1.0 / 40.0,
            stand_ins: 8,
            swell: 1.2,
            patches: 3000.0,
            halvings: 24,
            most_pieces: 1 << 17,
            flat: 0.98,
        }
    }
}
