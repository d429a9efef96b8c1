//! Photons: the light of spots at points that it reaches via glass and that the camera sees via
//! glass alone, so that no two points of such a path can be connected. Light paths leave *photons*
//! at their vertices, and a camera path gathers those within a disc around its own end to estimate
//! the density of their flux there (Jensen 1996). A disc is about as wide as the pixel at that
//! distance, and so is the blur.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    film::technique::Technique,
    light::{
        emitters::Emitters,
        light_vertices::{ALONE, LightVertex},
    },
    paths::{
        glass::{contribution::Contribution, point::Point},
        tracer::Tracer,
    },
    scene::{hit::Hit, world::World},
    tuning::GlassTuning,
};

/// Least cosine of the viewing direction on a surface.
const GRAZING: f32 = 1e-3;

/// The photons of a pass, sorted by cells of space.
#[derive(Debug)]
pub(crate) struct Photons {
    /// The photons by cell; within a cell, in the order of their paths.
    all: Vec<([i32; 3], LightVertex)>,
    /// Width of a cell and largest radius, render units.
    cell: f32,
    /// Radius for a camera path of length 1.
    spread: f32,
    tuning: GlassTuning,
}

impl Photons {
    /// Creates the photons of the spots, and those in `found` from light paths.
    pub fn new(
        world: &World,
        emitters: &Emitters,
        found: Vec<LightVertex>,
        tuning: GlassTuning,
    ) -> Self {
        let i = &world.camera.intrinsics;
        // The disc has the area of a pixel at unit distance.
        let spread = (world.sensitive * world.sensitive / (PI * i.fx * i.fy)).sqrt();
        let cell = spread * world.diagonal;
        let each = emitters.list.iter().enumerate();
        let spots = each.map(|(spot, e)| LightVertex {
            hit: Hit {
                p: e.p,
                n: e.n,
                triangle: 0,
                surface: e.surface,
                through: 1.0,
            },
            back: e.back,
            flux: 1.0,
            alpha: 0.0,
            density: ALONE,
            path_m: e.path_m,
            spot,
            bounces: 1,
        });
        let mut photons = Self {
            all: vec![],
            cell,
            spread,
            tuning,
        };
        let all = spots.chain(found).map(|z| (photons.cell_of(z.hit.p), z));
        photons.all = all.collect();
        // The sort is stable, so that sums are computed in the order of the paths.
        photons.all.sort_by_key(|(cell, _)| *cell);
        photons
    }

    fn cell_of(&self, p: Vec3) -> [i32; 3] {
        // The cast saturates.
        [p.x, p.y, p.z].map(|x| (x / self.cell).floor() as i32)
    }

    /// Calls `each` with the contribution of every photon near a camera path's point. Without
    /// `spots`, photons of the first bounce are left out.
    pub(crate) fn around(
        &self,
        tracer: &Tracer,
        spots: bool,
        point: &Point,
        mut each: impl FnMut(Contribution),
    ) {
        let (world, max_bounces) = (tracer.world, tracer.max_bounces);
        let (h, path) = (&point.hit, &point.path);
        let length = path.length_m as f32 * world.scale;
        let radius = (self.spread * length).min(self.cell);
        let reach = Vec3::new(radius, radius, radius);
        let (low, high) = (self.cell_of(h.p - reach), self.cell_of(h.p + reach));
        let cos = h.n.dot(point.back);
        if !(radius > 0.0 && cos > GRAZING) {
            return;
        }
        for x in low[0]..=high[0] {
            for y in low[1]..=high[1] {
                // Cells of a column are contiguous.
                let first = self.all.partition_point(|(c, _)| *c < [x, y, low[2]]);
                let near = self.all[first..].iter();
                for (_, z) in near.take_while(|(c, _)| *c <= [x, y, high[2]]) {
                    let to = z.hit.p - h.p;
                    let bounces = path.bounces - 1 + z.bounces;
                    if to.dot(to) >= radius * radius
                        || h.n.dot(to).abs() > self.tuning.photon_flat * radius
                        || h.n.dot(z.hit.n) < self.tuning.photon_alike
                        || !(2..=max_bounces).contains(&bounces)
                        || (z.bounces == 1 && !spots)
                    {
                        continue;
                    }
                    let f = z.hit.surface.scatter(h.n, z.back, point.back) / cos;
                    let found = Contribution {
                        value: path.weight * z.flux * f / (PI * radius * radius),
                        path_m: path.length_m + z.path_m,
                        spot: z.spot,
                        bounces,
                        technique: Technique::Photon,
                    };
                    if found.value > 0.0 {
                        each(found);
                    }
                }
            }
        }
    }
}
