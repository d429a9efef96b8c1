//! Near-mirrors as targets of gather points.
//!
//! Light that a surface receives via a near-mirror is found by chance, when a direction drawn by
//! the surface's scattering hits the near-mirror, and counts for one pixel alone. With many spots,
//! the other light is found reliably, and such rare paths are most of a pixel's error in furnished
//! rooms with mirrors: 0.7 to 2.4 % of the light of three bounces and more, and a third of the
//! variance (25 spots, 256×256).
//!
//! So gather points also aim at near-mirrors: at triangles in proportion to their area as seen from
//! some of the tile's gather points, and evenly over each triangle. Both techniques are combined by
//! the balance heuristic, so triangles that are hidden or missing from the table cost nothing but
//! rays.

use picofarm_scene::Vec3;

use crate::{
    numeric::rng::Rng,
    scene::{hit::Hit, world::World},
    tuning::ReflectorTuning,
};

/// Upper bound of a density. Shares of densities must not be quotients of infinities.
const MOST_DENSE: f32 = 1e30;
const NONE: u32 = u32::MAX;

/// A near-mirror's triangle.
#[derive(Debug)]
struct Reflector {
    /// Triangle index in the scene.
    triangle: u32,
    corners: [Vec3; 3],
    middle: Vec3,
    normal: Vec3,
    /// Area in square render units.
    area: f32,
    two_sided: bool,
}

/// The near-mirrors of a scene.
#[derive(Debug)]
pub(crate) struct Reflectors {
    list: Vec<Reflector>,
    /// Index into `list` by triangle, or [`NONE`].
    place: Vec<u32>,
    pub tuning: ReflectorTuning,
}

impl Reflectors {
    /// Returns the near-mirrors of a scene, or `None` if there are none or too many.
    pub fn find(world: &World, tuning: ReflectorTuning) -> Option<Self> {
        let mut place = vec![NONE; world.triangles.len()];
        let mut list = vec![];
        for (t, &corners) in world.triangles.iter().enumerate() {
            let surface = &world.surfaces[world.surface[t] as usize];
            if !surface.has_mirror() || world.normals[t] == Vec3::ZERO || !world.counts(t) {
                continue;
            }
            if list.len() == tuning.most {
                return None;
            }
            let found = Reflector::new(t as u32, corners, world.normals[t], surface.two_sided());
            // The triangle is so small that squares underflow, so its density would be undefined.
            if !found.area.is_normal() {
                continue;
            }
            place[t] = list.len() as u32;
            list.push(found);
        }
        (!list.is_empty()).then_some(Self {
            list,
            place,
            tuning,
        })
    }
}

impl Reflector {
    fn new(triangle: u32, corners: [Vec3; 3], normal: Vec3, two_sided: bool) -> Self {
        let [a, b, c] = corners;
        Self {
            triangle,
            corners,
            middle: (a + b + c) / 3.0,
            normal,
            area: 0.5 * (b - a).cross(c - a).length(),
            two_sided,
        }
    }

    /// Returns the approximate cosine-weighted solid angle at a point with normal `n`.
    fn size(&self, p: Vec3, n: Vec3) -> f32 {
        let to = self.middle - p;
        let cos = -self.normal.dot(to);
        let cos = if self.two_sided {
            cos.abs()
        } else {
            cos.max(0.0)
        };
        // A tenth of the triangle may be above a horizon that hides its middle.
        let up = n.dot(to).max(0.0) + 0.1 * self.area.sqrt();
        let d2 = to.dot(to) + self.area;
        cos * up * self.area / (d2 * d2)
    }
}

/// How the gather points of a tile aim at near-mirrors.
#[derive(Debug, Default)]
pub(crate) struct Aiming {
    /// Running sums of the triangles' weights.
    sums: Vec<f32>,
    /// Aims per unit of area of each triangle, for one direction drawn by scattering.
    density: Vec<f32>,
}

impl Aiming {
    /// Removes all targets.
    pub fn clear(&mut self) {
        self.sums.clear();
        self.density.clear();
    }

    /// Weighs the near-mirrors for a tile with gather points at `points`, given with normals. A
    /// gather point aims `often` times for each direction that it draws by scattering. Returns
    /// whether there is anything to aim at.
    pub fn weigh(
        &mut self,
        all: &Reflectors,
        often: f32,
        points: impl ExactSizeIterator<Item = (Vec3, Vec3)>,
    ) -> bool {
        self.clear();
        let step = (points.len() / all.tuning.seen_from).max(1);
        let from: Vec<(Vec3, Vec3)> = points
            .skip(step / 2)
            .step_by(step)
            .take(all.tuning.seen_from)
            .collect();
        let mut sum = 0.0;
        for r in &all.list {
            let weight: f32 = from.iter().map(|&(p, n)| r.size(p, n)).sum();
            sum += weight;
            self.sums.push(sum);
            self.density.push(often * weight / r.area);
        }
        // Below the smallest normal number, quotients could be anything.
        if !(sum > 1e-30 && sum.is_finite()) {
            self.clear();
            return false;
        }
        self.density.iter_mut().for_each(|d| *d /= sum);
        true
    }

    /// Draws a triangle of the scene and a point on it.
    pub fn draw(&self, all: &Reflectors, rng: &mut Rng) -> Option<(u32, Vec3)> {
        let position = rng.uniform() * self.sums.last()?;
        let k = self.sums.partition_point(|&s| s <= position);
        let r = all.list.get(k)?;
        let [a, b, c] = r.corners;
        let (s, v) = (rng.uniform().sqrt(), rng.uniform());
        Some((
            r.triangle,
            a * (1.0 - s) + b * (s * (1.0 - v)) + c * (s * v),
        ))
    }

    /// Returns the aims per steradian from the point `x` towards `m`, for one direction drawn by
    /// scattering; 0 if `m` is not on a target.
    pub fn density(&self, all: &Reflectors, x: Vec3, m: &Hit) -> f32 {
        let place = all.place[m.triangle as usize] as usize;
        let Some(&density) = self.density.get(place) else {
            return 0.0;
        };
        let to = m.p - x;
        let d2 = to.dot(to);
        let turn = m.n.dot(to).abs() / (d2 * d2.sqrt());
        if turn > 0.0 {
            (density / turn).min(MOST_DENSE)
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::PI;

    use picofarm_scene::Material;
    use proptest::prelude::*;

    use super::*;
    use crate::numeric::rng::Rng;
    use crate::numeric::rng::Stream;
    use crate::scene::surface::Surface;

    fn point() -> impl Strategy<Value = Vec3> {
        let axis = || -2.0f32..2.0;
        (axis(), axis(), axis()).prop_map(|(x, y, z)| Vec3::new(x, y, z))
    }

    fn reflectors(corners: &[[Vec3; 3]]) -> Reflectors {
        let list = corners.iter().enumerate().map(|(t, &c)| {
            let n = (c[1] - c[0]).cross(c[2] - c[0]).normalized();
            Reflector::new(t as u32, c, n, true)
        });
        Reflectors {
            list: list.collect(),
            place: (0..corners.len() as u32).chain([NONE]).collect(),
            tuning: ReflectorTuning::default(),
        }
    }

    fn hit(triangle: u32, p: Vec3, n: Vec3) -> Hit {
        let surface = Surface::new(&Material::mirror("pane", 0.01));
        Hit {
            p,
            n,
            triangle,
            surface,
            through: 1.0,
        }
    }

    proptest! {
        #[test]
        fn aims_are_as_dense_as_is_said(
            corners in prop::collection::vec([point(), point(), point()], 1..6),
            from in prop::collection::vec((point(), point()), 1..9), seed in any::<u64>(),
        ) {
            prop_assume!(from.iter().all(|(_, n)| n.length() > 0.1));
            prop_assume!(corners.iter().all(|c| (c[1] - c[0]).cross(c[2] - c[0]).length() > 0.05));
            let (all, often) = (reflectors(&corners), 0.25);
            let points: Vec<_> = from.iter().map(|&(p, n)| (p, n.normalized())).collect();
            let mut aiming = Aiming::default();
            prop_assume!(aiming.weigh(&all, often, points.into_iter()));
            let mut rng = Rng::new(seed, Stream::Paths, 0, 0);
            // From a point above each triangle's middle, the density per steradian agrees with the
            // density per area.
            let mut said = vec![];
            for r in &all.list {
                let m = hit(r.triangle, r.middle, r.normal);
                let x = r.middle + r.normal * 2.0;
                said.push(aiming.density(&all, x, &m) / 4.0 * r.area);
            }
            prop_assert!((said.iter().sum::<f32>() - often).abs() < 1e-4 * often);
            const DRAWS: usize = 4000;
            let mut found = vec![0u16; corners.len()];
            for _ in 0..DRAWS {
                let (t, p) = aiming.draw(&all, &mut rng).expect("there is something to aim at");
                let r = &all.list[t as usize];
                prop_assert!((p - r.middle).dot(r.normal).abs() < 1e-4);
                found[t as usize] += 1;
            }
            for (&found, said) in found.iter().zip(&said) {
                let found = often * f32::from(found) / DRAWS as f32;
                let chance = said / often;
                let spread = chance * (1.0 - chance).max(0.0);
                let error = often * (spread / DRAWS as f32).sqrt();
                prop_assert!((found - said).abs() < 5.0 * error + 1e-3 * often, "{found} {said}");
            }
        }
    }

    #[test]
    fn what_is_no_near_mirror_is_not_aimed_at_and_nothing_is_where_none_is_in_sight() {
        let corners = [
            Vec3::ZERO,
            Vec3::new(1.0, 0.0, 0.0),
            Vec3::new(0.0, 1.0, 0.0),
        ];
        let (all, up) = (reflectors(&[corners]), Vec3::new(0.0, 0.0, 1.0));
        let mut aiming = Aiming::default();
        let above = [(up * 2.0, -up)];
        assert!(aiming.weigh(&all, 1.0, above.into_iter()));
        let (there, elsewhere) = (hit(0, Vec3::ZERO, up), hit(1, Vec3::ZERO, up));
        assert!(aiming.density(&all, up, &there) > 0.0);
        assert_eq!(aiming.density(&all, up, &elsewhere), 0.0);
        // In the plane of the triangle, the solid angle vanishes.
        assert_eq!(aiming.density(&all, Vec3::new(3.0, 0.0, 0.0), &there), 0.0);
        // Nothing of the triangle is visible from its plane.
        let neighbours = [(Vec3::new(PI, 0.0, 0.0), up)];
        assert!(!aiming.weigh(&all, 1.0, neighbours.into_iter()));
        assert_eq!(aiming.density(&all, up, &there), 0.0);
        assert!(
            aiming
                .draw(&all, &mut Rng::new(0, Stream::Paths, 0, 0))
                .is_none()
        );
    }
}
