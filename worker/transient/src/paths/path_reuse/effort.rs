//! The number of vertices, walks and aims in a pass over a tile.

use crate::paths::tracer::SPOTS;

/// Side in pixels of the tiles that share vertices. On furnished rooms at 256×256 with 25 spots,
/// wide tiles take 0.44 of the CPU time to the same error of a pixel, half of it to that of a sum
/// over 4×4 pixels, as much to that of 32×32, and 2.1 times as much to that of the whole image,
/// which is small: all pixels of a tile share the errors of the same vertices.
pub(crate) const WIDE_TILE: u32 = 32;
pub(crate) const NARROW_TILE: u32 = 8;

/// Factor of additional vertices if some cannot be shared (0, 1, 3 and 7 tried on rooms with such
/// surfaces): in narrow tiles, in wide tiles, and in wide tiles if gather points aim at
/// near-mirrors.
const EXTRA: [u32; 3] = [3, 7, 4];

/// Aims at near-mirrors per pixel. Error² × CPU time is within 5 % for 0.25 to 1 (furnished rooms
/// with mirrors, 25 spots, 256×256). With five spots or fewer, aims gain no more than they cost,
/// and there are none.
const AIMS: f32 = 0.5;

/// The maximum number of spots that the first vertex of a walk is connected to if there are many
/// spots and near-mirrors ([`Effort::spots`]).
const MANY_SPOTS: (u32, u32) = (8, 32);

/// Candidates per shared vertex. Error² × CPU time of a pixel with 4 candidates and walks by
/// weight, relative to one candidate and one walk: 0.7 to 0.85 in furnished rooms with 4 spots,
/// 0.73 to 1.03 in rooms with near-mirrors (24×24). 2 and 8 are no better, and with 25 spots at
/// 256×256 the ratio is 0.9 to 1.1.
const CANDIDATES: u32 = 4;

/// The amount of work in a pass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Effort {
    /// Side of a tile in pixels.
    pub side: u32,
    /// Candidates per shared vertex.
    pub candidates: u32,
    /// Shared vertices drawn from gather points, per pixel.
    pub camera: f32,
    /// Additional vertices drawn from gather points, per shared one, for surfaces that cannot be
    /// shared.
    pub extra: u32,
    /// Shared vertices drawn from spots, per pixel.
    pub light: f32,
    /// Shared vertices drawn in a narrow gate's shells, per pixel.
    pub shell: f32,
    /// Average number of walks from a shared vertex that sends its light equally to all gather
    /// points.
    pub walks: f32,
    /// Light vertices that the walks of one pass connect to.
    pub light_vertices: u32,
    /// Light paths via near-mirrors, per pixel, if there are any near-mirrors.
    pub beyond: f32,
    /// Aims of gather points at near-mirrors, per pixel, if there are any near-mirrors.
    pub aims: f32,
    /// The maximum number of spots that the first vertex of a walk is connected to: of a walk from
    /// a shared vertex, and of one from a vertex that one pixel sees.
    pub spots: (u32, u32),
}

impl Effort {
    /// Returns the effort for tiles of `side` pixels.
    ///
    /// A vertex costs the same in a wide tile as in a narrow one, but serves more pixels. So wide
    /// tiles draw fewer vertices per pixel, and every pixel still uses more of them. The numbers
    /// minimise error² × CPU time on furnished rooms with 4 and 25 spots, where the optimum is
    /// flat: twice as many vertices or walks cost within 10 %. `narrow` is true for a narrow gate,
    /// `narrow_lobes` if the scene has surfaces with vertices that are not shared, and `aims` if
    /// gather points aim at near-mirrors.
    pub fn new(side: u32, narrow: bool, narrow_lobes: bool, aims: bool) -> Self {
        let wide = side > NARROW_TILE;
        Self {
            side,
            // A narrow gate selects its vertices by its window instead.
            candidates: if narrow { 1 } else { CANDIDATES },
            camera: if wide { 0.5 } else { 1.0 },
            extra: match (narrow_lobes, wide, aims) {
                (false, ..) => 0,
                (true, false, _) => EXTRA[0],
                (true, true, false) => EXTRA[1],
                (true, true, true) => EXTRA[2],
            },
            light: if wide { 0.25 } else { 0.5 },
            shell: if narrow { 1.0 } else { 0.0 },
            walks: 0.8,
            light_vertices: if wide { 64 } else { 16 },
            beyond: 1.0,
            aims: if aims { AIMS } else { 0.0 },
            spots: if aims { MANY_SPOTS } else { (SPOTS, SPOTS) },
        }
    }
}
