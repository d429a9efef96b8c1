//! How many vertices, walks and aims a pass over a tile makes.

use crate::walk::SPOTS;

/// Sides in pixels of the tiles that share vertices. On furnished rooms at 256×256 with 25 spots wide ones take 0.44 of the
/// CPU time to the same error of a pixel, half of it to that of a sum over 4×4 pixels, as much to that of 32×32 and 2.1
/// times as much to that of the whole image, which is small: all pixels of a tile err by the same vertices.
pub(crate) const WIDE_TILE: u32 = 32;
pub(crate) const NARROW_TILE: u32 = 8;

/// How many more vertices are drawn where some cannot be shared (0, 1, 3 and 7 tried on rooms with such surfaces): in narrow tiles, in wide
/// ones, and in these where gather points aim at near-mirrors.
const EXTRA: [u32; 3] = [3, 7, 4];
/// Aims at near-mirrors for each pixel. Error² × CPU time is within 5 % for 0.25 to 1 (furnished rooms with mirrors, 25 spots, 256×256); with five spots or fewer
/// they bring no more than they cost, and there are none.
const AIMS: f32 = 0.5;
/// Spots that the first vertex of a walk is connected to at most where there are many and near-mirrors ([`Effort::spots`]).
const MANY_SPOTS: (u32, u32) = (8, 32);

/// Candidates for each shared vertex. Error² × CPU time of a pixel with 4 of them, and walks by weight, over that with one of each:
/// 0.7 to 0.85 in furnished rooms with 4 spots, 0.73 to 1.03 in rooms with near-mirrors (24×24); 2 and 8 are no better, and with 25
/// spots at 256×256 it is 0.9 to 1.1.
const CANDIDATES: u32 = 4;

/// How much a pass does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Effort {
    /// Side of a tile in pixels.
    pub side: u32,
    /// Candidates for each shared vertex.
    pub candidates: u32,
    /// Shared vertices drawn from gather points, for each pixel.
    pub camera: f32,
    /// How many more vertices are drawn from gather points, for each of those, for what cannot be shared.
    pub extra: u32,
    /// Shared vertices drawn from spots, for each pixel.
    pub light: f32,
    /// Shared vertices drawn in a narrow gate's shells, for each pixel.
    pub shell: f32,
    /// Walks from a shared vertex whose light all gather points take alike, on average.
    pub walks: f32,
    /// Light vertices that walks of one pass connect to.
    pub light_vertices: u32,
    /// Light paths by way of near-mirrors, for each pixel, where there are any.
    pub beyond: f32,
    /// Aims of gather points at near-mirrors, for each pixel, where there are any.
    pub aims: f32,
    /// Spots that the first vertex of a walk from a shared vertex is connected to at most, and of one from what one pixel sees.
    pub spots: (u32, u32),
}

impl Effort {
    /// The effort for tiles of `side` pixels. A vertex costs as much to make in a wide tile as in a narrow one, and serves
    /// more pixels there: so wide tiles draw fewer of them for each pixel, and every pixel has more of them all the same.
    /// The numbers minimise error² × CPU time on furnished rooms with 4 and 25 spots, where the optimum is flat: twice as
    /// many vertices or walks cost within 10 %. `narrow` is the gate; `narrow_lobes`: the scene has surfaces whose vertices
    /// are not shared; `aims`: gather points aim at near-mirrors.
    pub fn new(side: u32, narrow: bool, narrow_lobes: bool, aims: bool) -> Self {
        let wide = side > NARROW_TILE;
        Self {
            side,
            // The window of a narrow gate is where its vertices are chosen by.
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
