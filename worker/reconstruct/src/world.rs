//! The true scene, as a reference for scores: rays, points on its surfaces, and the inside of its
//! solids.

use picofarm_scene::{Scene, Vec3};
use picofarm_transient::{Bvh, Stack};

use crate::rng::{Rng, Stream};

/// The triangles of a scene in world axes.
#[derive(Debug)]
pub struct World {
    bvh: Bvh,
    triangles: Vec<[Vec3; 3]>,
    specular: Vec<bool>,
    room: Vec<bool>,
}

/// The intersection of a ray with the scene.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// The distance along the unit direction, metres.
    pub range: f32,
    /// The index of the triangle.
    pub triangle: usize,
}

/// The distance of the ends of rays from surfaces, metres.
const LIFT_M: f32 = 2e-3;

impl World {
    /// Prepares a scene for rays.
    pub fn new(scene: &Scene) -> Self {
        let (mut triangles, mut specular, mut room) = (Vec::new(), Vec::new(), Vec::new());
        for object in &scene.objects {
            let label = scene
                .labels
                .get(usize::from(object.label))
                .map_or("", |l| l.as_str());
            let wall = matches!(label, "floor" | "ceiling" | "wall");
            for (t, &m) in object
                .mesh
                .triangles
                .iter()
                .zip(&object.mesh.triangle_material)
            {
                triangles.push(t.map(|v| object.to_world.point(object.mesh.positions[v as usize])));
                specular.push(object.mesh.materials[m as usize].is_specular());
                room.push(wall);
            }
        }
        Self {
            bvh: Bvh::build(&triangles),
            triangles,
            specular,
            room,
        }
    }

    /// Returns the scratch memory of one thread.
    pub fn stack(&self) -> Stack {
        self.bvh.stack()
    }

    /// Returns the first surface along a unit direction.
    pub fn closest(&self, stack: &mut Stack, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let (range, id) = self.bvh.closest(stack, origin, direction, f32::INFINITY)?;
        Some(Hit {
            range,
            triangle: id as usize,
        })
    }

    /// Returns whether a surface point is visible from a position. The last 2 mm in front of the
    /// point are ignored.
    pub fn sees(&self, stack: &mut Stack, from: Vec3, point: Vec3) -> bool {
        let way = point - from;
        let share = 1.0 - LIFT_M / way.length().max(LIFT_M);
        !self.bvh.occluded(stack, from, way, share)
    }

    /// Returns whether a hit is on a mirror.
    pub fn is_specular(&self, hit: Hit) -> bool {
        self.specular[hit.triangle]
    }

    /// Returns whether a hit is on floor, ceiling or wall, if the scene has labels.
    pub fn is_room(&self, hit: Hit) -> bool {
        self.room[hit.triangle]
    }

    /// Returns the bounding box of all surfaces.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let none = (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY));
        let corners = self.triangles.iter().flatten();
        corners.fold(none, |(lo, hi), p| (lo.min(*p), hi.max(*p)))
    }

    /// Returns whether a position is inside a solid or behind a wall: of the rays along the six
    /// axes that hit a facet, at least half hit its back, or no ray hits any. Facets must face
    /// outwards of solids and into rooms.
    pub fn buried(&self, stack: &mut Stack, x: Vec3) -> bool {
        let axes = [
            [1., 0., 0.],
            [-1., 0., 0.],
            [0., 1., 0.],
            [0., -1., 0.],
            [0., 0., 1.],
            [0., 0., -1.0f32],
        ];
        let mut sides = [0usize; 2];
        for axis in axes {
            // The directions are slightly off the axes, so that rays do not run along facets.
            let d = (Vec3::from(axis) + Vec3::new(0.0137, 0.0071, 0.0113)).normalized();
            if let Some(hit) = self.closest(stack, x, d) {
                let [a, b, c] = self.triangles[hit.triangle];
                sides[usize::from((b - a).cross(c - a).dot(d) > 0.0)] += 1;
            }
        }
        sides[1] >= sides[0]
    }

    /// Returns `count` points on the surfaces inside the box from `lo` to `hi`, uniform by area.
    /// Inner faces of touching solids count like outer ones.
    pub fn surface_points(&self, count: usize, seed: u64, lo: Vec3, hi: Vec3) -> Vec<Vec3> {
        let inside = |x: Vec3| (0..3).all(|k| x[k] >= lo[k] && x[k] <= hi[k]);
        sample(&self.triangles, count, seed)
            .into_iter()
            .filter(|x| inside(*x))
            .collect()
    }
}

/// Returns `count` points on triangles, uniform by area.
pub(crate) fn sample(triangles: &[[Vec3; 3]], count: usize, seed: u64) -> Vec<Vec3> {
    let mut sums = Vec::with_capacity(triangles.len());
    let mut total = 0.0f64;
    for [a, b, c] in triangles {
        total += f64::from((*b - *a).cross(*c - *a).length());
        sums.push(total);
    }
    if total <= 0.0 {
        return Vec::new();
    }
    let of = |k: usize| {
        let mut rng = Rng::new(seed, Stream::Surface, k as u64);
        // The points are stratified by area.
        let at = (k as f64 + f64::from(rng.unit())) / count as f64 * total;
        let [a, b, c] = triangles[sums.partition_point(|s| *s <= at).min(triangles.len() - 1)];
        let (root, v) = (rng.unit().sqrt(), rng.unit());
        a * (1.0 - root) + b * (root * (1.0 - v)) + c * (root * v)
    };
    (0..count).map(of).collect()
}
