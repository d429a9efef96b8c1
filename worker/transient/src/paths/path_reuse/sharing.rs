//! Buffers of one thread's passes.

use crate::{
    light::{columns::Columns, reflectors::Aiming},
    paths::{
        ellipsoid::shells::Shells,
        path_reuse::{
            arrivals::Arrivals, candidates::Candidates, gloss::Gloss, lengths::Lengths,
            shared::Shared,
        },
        vertex::Vertex,
    },
    scene::{
        lobes::{Lobes, Seen},
        segments::Segments,
    },
};

/// Buffers of one thread's passes.
#[derive(Debug, Default)]
pub(crate) struct Sharing {
    pub gathers: Vec<(Vertex, usize)>,
    pub columns: Columns,
    /// Optical path length to the nearest gather point, metres. Arrivals' lengths are relative to
    /// it.
    pub nearest_m: f64,
    /// The fewest bounces up to a gather point.
    pub lowest: u32,
    /// Indices of gather points that are not Lambertian.
    pub glossy: Vec<usize>,
    pub shared: Vec<Shared>,
    pub candidates: Candidates,
    pub aiming: Aiming,
    pub arrivals: Arrivals,
    pub gloss: Gloss,
    /// Segments of one shared vertex.
    pub segments: Segments,
    pub lengths: Lengths,
    /// How the gather points of `glossy` scatter to the camera, and how much they scatter from one
    /// shared vertex.
    pub lobes: Lobes,
    pub scattered: Vec<f32>,
    pub drawn: Vec<f32>,
    /// Gather points that are not Lambertian, and their values.
    pub apart: Vec<(usize, f32)>,
    /// `[shared][gather]`: value of an arrival at the pixel, and path in bins to add.
    pub weight: Vec<f32>,
    pub offset: Vec<f32>,
    pub shells: Shells,
}

impl Sharing {
    /// Arranges the gather points in columns.
    pub fn index(&mut self) {
        self.columns.clear();
        self.glossy.clear();
        self.lobes.clear();
        self.nearest_m = f64::INFINITY;
        self.lowest = u32::MAX;
        for (i, (v, _)) in self.gathers.iter().enumerate() {
            self.nearest_m = self.nearest_m.min(v.length_m);
            self.lowest = self.lowest.min(v.bounce);
            let diffuse = v.hit.surface.diffuse();
            if !diffuse {
                self.glossy.push(i);
                let place = Seen::of(&v.hit, v.wo);
                self.lobes.push(&place, &v.hit.surface);
            }
            self.columns
                .push(v.hit.p, v.hit.n, if diffuse { 1.0 } else { 0.0 });
        }
    }
}
