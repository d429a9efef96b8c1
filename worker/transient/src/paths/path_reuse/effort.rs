//! The number of vertices, walks and aims in a pass over a tile.

use crate::{film::slots::Film, paths::tracer::Tracer, tuning::Tuning};

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

/// The tracer, film and effort of a pass over a tile.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PassContext<'a> {
    pub tracer: &'a Tracer<'a>,
    pub film: &'a Film,
    pub effort: &'a Effort,
}

impl Effort {
    /// Returns the effort for tiles of `side` pixels. `narrow_gate` is true for a narrow gate,
    /// `narrow_lobes` if the scene has surfaces with vertices that are not shared, and `aims` if
    /// gather points aim at near-mirrors.
    pub fn new(
        tuning: &Tuning,
        side: u32,
        narrow_gate: bool,
        narrow_lobes: bool,
        aims: bool,
    ) -> Self {
        let (all, spots) = (&tuning.path_reuse, tuning.walk.spots);
        let wide = side > all.narrow_tile;
        let tile = if wide { &all.wide } else { &all.narrow };
        Self {
            side,
            // A narrow gate selects its vertices by its window instead.
            candidates: if narrow_gate { 1 } else { all.candidates },
            camera: tile.camera,
            extra: match (narrow_lobes, wide && aims) {
                (false, _) => 0,
                (true, true) => all.extra_with_aims,
                (true, false) => tile.extra,
            },
            light: tile.light,
            shell: if narrow_gate { all.shell } else { 0.0 },
            walks: all.walks,
            light_vertices: tile.light_vertices,
            beyond: all.beyond_paths,
            aims: if aims { tuning.reflectors.aims } else { 0.0 },
            spots: match aims {
                true => (all.shared_spots, all.alone_spots),
                false => (spots, spots),
            },
        }
    }
}
