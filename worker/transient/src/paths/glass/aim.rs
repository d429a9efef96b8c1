//! Directions from a point to the glass. A camera path that scatters hits glass only by chance, and
//! only light that glass turns counts. So half of its directions are drawn within cones around
//! bounding spheres of the glass, combined with the surface's own scattering by the balance
//! heuristic.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    numeric::{frame::frame, rng::Rng},
    scene::hit::Hit,
};

/// The largest number of spheres; the largest sum of the squared diagonals of two boxes, relative
/// to that of the box that they divide; and the number of slices of a box that the cuts are chosen
/// from.
const MOST: usize = 16;
const PAYS: f32 = 0.7;
const SLICES: usize = 16;

/// Share of directions drawn within cones.
const SHARE: f32 = 0.5;

/// Least square of a cone's sine, so that directions on its edge are distinguishable.
const NARROW: f32 = 1e-4;

/// Bounding spheres of all glass except panes in which spots and lit points have images.
#[derive(Debug, Default)]
pub(crate) struct Aim(Vec<Sphere>);

#[derive(Debug, Clone, Copy)]
struct Sphere {
    centre: Vec3,
    radius: f32,
}

/// The directions to a sphere.
#[derive(Debug, Clone, Copy, Default)]
struct Cone {
    axis: Vec3,
    /// 1 − cos of the half angle: the solid angle over 2π.
    size: f32,
}

/// The spheres as seen from a point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cones {
    list: [Cone; MOST],
    count: usize,
    /// Sum of the cones' sizes.
    total: f32,
}

/// A box, empty at first.
#[derive(Debug, Clone, Copy)]
struct Bounds([Vec3; 2]);

impl Bounds {
    const EMPTY: Self = {
        let far = f32::INFINITY;
        Self([Vec3::new(far, far, far), Vec3::new(-far, -far, -far)])
    };

    fn of<'a>(all: impl IntoIterator<Item = &'a Vec3>) -> Self {
        let each = all.into_iter().map(|&p| Self([p, p]));
        each.fold(Self::EMPTY, Self::and)
    }

    fn and(self, other: Self) -> Self {
        let ([a, b], [c, d]) = (self.0, other.0);
        Self([
            Vec3::new(a.x.min(c.x), a.y.min(c.y), a.z.min(c.z)),
            Vec3::new(b.x.max(d.x), b.y.max(d.y), b.z.max(d.z)),
        ])
    }

    /// Returns the square of the diagonal; infinite for an empty box, so that no division uses it.
    fn square(self) -> f32 {
        let d = self.0[1] - self.0[0];
        d.dot(d)
    }
}

/// Returns the bounding sphere of some triangles around the middle of their box.
fn around(all: &[[Vec3; 3]]) -> Sphere {
    let [low, high] = Bounds::of(all.iter().flatten()).0;
    let centre = (low + high) * 0.5;
    let square = |p: &Vec3| (*p - centre).dot(*p - centre);
    let radius2 = all.iter().flatten().map(square).fold(0.0, f32::max);
    Sphere {
        centre,
        radius: radius2.sqrt(),
    }
}

/// Divides triangles in two by the cut with the least sum of the squared diagonals of both boxes,
/// among a few planes across each axis. Returns the triangles undivided as an error if no cut pays.
fn divided(all: Vec<[Vec3; 3]>) -> Result<[Vec<[Vec3; 3]>; 2], Vec<[Vec3; 3]>> {
    let coordinate = |p: Vec3, axis: usize| [p.x, p.y, p.z][axis];
    let middle = |t: &[Vec3; 3]| (t[0] + t[1] + t[2]) / 3.0;
    let middles: Vec<Vec3> = all.iter().map(middle).collect();
    let [low, high] = Bounds::of(&middles).0;
    let slice = |p: Vec3, axis: usize| {
        let (from, to) = (coordinate(low, axis), coordinate(high, axis));
        let at = (coordinate(p, axis) - from) / (to - from) * SLICES as f32;
        // The cast saturates, and maps NaN to 0.
        (at as usize).min(SLICES - 1)
    };
    let mut best = (PAYS * Bounds::of(all.iter().flatten()).square(), 0, 0);
    for axis in 0..3 {
        let mut slices = [Bounds::EMPTY; SLICES];
        for (t, &p) in all.iter().zip(&middles) {
            let of = &mut slices[slice(p, axis)];
            *of = of.and(Bounds::of(t));
        }
        for cut in 1..SLICES {
            let join = |of: &[Bounds]| of.iter().fold(Bounds::EMPTY, |all, &one| all.and(one));
            let sum = join(&slices[..cut]).square() + join(&slices[cut..]).square();
            if sum < best.0 {
                best = (sum, axis, cut);
            }
        }
    }
    let (_, axis, cut) = best;
    if cut == 0 {
        return Err(all);
    }
    let mut two = [vec![], vec![]];
    for (t, p) in all.into_iter().zip(middles) {
        two[usize::from(slice(p, axis) >= cut)].push(t);
    }
    Ok(two)
}

impl Aim {
    /// Builds the spheres of some triangles.
    pub fn at(all: Vec<[Vec3; 3]>) -> Self {
        if all.is_empty() {
            return Self::default();
        }
        let mut done = vec![];
        let mut open = vec![all];
        while let Some(next) = open.pop() {
            let enough = open.len() + done.len() + 1 >= MOST;
            match if enough { Err(next) } else { divided(next) } {
                Ok(two) => open.extend(two),
                Err(one) => done.push(around(&one)),
            }
        }
        Self(done)
    }

    /// Returns the cones from a surface point; `None` if there are none, or if the surface scatters
    /// into a narrow lobe.
    pub fn from(&self, h: &Hit) -> Option<Cones> {
        let mut cones = Cones {
            list: [Cone::default(); MOST],
            count: 0,
            total: 0.0,
        };
        for s in &self.0 {
            let to = s.centre - h.p;
            let d2 = to.dot(to);
            let square = (s.radius * s.radius / d2).max(NARROW);
            // A point within a sphere has no cone to it, and no light arrives from below the
            // surface.
            if square >= 1.0 || h.n.dot(to) <= -s.radius {
                continue;
            }
            let cone = Cone {
                axis: to / d2.sqrt(),
                size: square / (1.0 + (1.0 - square).sqrt()),
            };
            cones.list[cones.count] = cone;
            cones.count += 1;
            cones.total += cone.size;
        }
        (cones.count > 0 && !h.surface.specular()).then_some(cones)
    }
}

impl Cones {
    /// Draws a direction for light that leaves a surface toward `back`. Returns the direction,
    /// f·cos over the combined density, and f·cos over the density of the surface's own scattering.
    pub fn sample(&self, h: &Hit, back: Vec3, rng: &mut Rng) -> Option<(Vec3, f32, f32)> {
        let w = match rng.uniform() < SHARE {
            true => self.within(rng),
            false => h.surface.sample(h.n, back, rng)?.0,
        };
        let own = h.surface.pdf(h.n, back, w);
        let value = h.surface.scatter(h.n, back, w);
        let density = SHARE * self.density(w) + (1.0 - SHARE) * own;
        (own > 0.0 && value > 0.0).then(|| (w, value / density, value / own))
    }

    fn within(&self, rng: &mut Rng) -> Vec3 {
        let mut left = rng.uniform() * self.total;
        let cones = &self.list[..self.count];
        let cone = cones.iter().find(|c| {
            left -= c.size;
            left < 0.0
        });
        let cone = cone.unwrap_or(&cones[self.count - 1]);
        let below = rng.uniform() * cone.size;
        let (t, b) = frame(cone.axis);
        let (x, y) = rng.circle();
        // sin² = (1 − cos)(1 + cos).
        let sin = (below * (2.0 - below)).sqrt();
        (cone.axis * (1.0 - below) + t * (sin * x) + b * (sin * y)).normalized()
    }

    /// Returns the density per steradian.
    fn density(&self, w: Vec3) -> f32 {
        let cones = self.list[..self.count].iter();
        let holds = |c: &&Cone| c.axis.dot(w) >= 1.0 - c.size;
        cones.filter(holds).count() as f32 / (2.0 * PI * self.total)
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::PI;

    use picofarm_scene::Vec3;

    use crate::numeric::rng::Rng;
    use crate::numeric::rng::Stream;
    use crate::paths::glass::aim::Aim;
    use crate::paths::glass::aim::Cones;

    /// Returns a tetrahedron of a size at a place.
    fn solid(at: Vec3, size: f32) -> Vec<[Vec3; 3]> {
        let corner = |x, y, z| at + Vec3::new(x, y, z) * size;
        let all = [
            corner(1.0, 1.0, 1.0),
            corner(1.0, -1.0, -1.0),
            corner(-1.0, 1.0, -1.0),
            corner(-1.0, -1.0, 1.0),
        ];
        let without = |k: usize| [all[(k + 1) % 4], all[(k + 2) % 4], all[(k + 3) % 4]];
        (0..4).map(without).collect()
    }

    #[test]
    fn bodies_far_apart_get_spheres_of_their_own_and_one_body_a_single_one() {
        assert_eq!(Aim::at(vec![]).0.len(), 0);
        assert_eq!(Aim::at(solid(Vec3::ZERO, 1.0)).0.len(), 1);
        let at = |k: usize| Vec3::new(5.0 * k as f32, 0.0, (k % 3) as f32);
        let several = |count: usize| (0..count).flat_map(|k| solid(at(k), 0.3)).collect();
        assert_eq!(Aim::at(several(3)).0.len(), 3);
        let many = Aim::at(several(40));
        assert!(many.0.len() <= crate::paths::glass::aim::MOST);
        for p in several(40).iter().flatten() {
            let holds = many
                .0
                .iter()
                .any(|s| (*p - s.centre).length() < s.radius * 1.0001);
            assert!(holds, "{p:?}");
        }
    }

    #[test]
    fn directions_are_drawn_with_the_density_that_is_said() {
        let aim = Aim::at(
            [Vec3::new(0.5, 0.0, 2.0), Vec3::new(-1.0, 1.0, 1.5)]
                .into_iter()
                .flat_map(|at| solid(at, 0.3))
                .collect(),
        );
        let cones = cones(&aim);
        let mut rng = Rng::new(1, Stream::ByGlass, 0, 0);
        // The mean of 1/density is the solid angle of the covered directions; this also applies to
        // each half of it.
        let (mut all, mut left) = (0.0, 0.0);
        let count = 100_000;
        for _ in 0..count {
            let w = cones.within(&mut rng);
            let share = 1.0 / f64::from(cones.density(w)) / f64::from(count);
            all += share;
            if w.x < -0.2 {
                left += share;
            }
        }
        let sizes: Vec<f32> = cones.list[..cones.count].iter().map(|c| c.size).collect();
        let expected = 2.0 * PI * sizes.iter().sum::<f32>();
        assert!(
            (all / f64::from(expected) - 1.0).abs() < 1e-3,
            "{all} {expected}"
        );
        let second = (0..2).find(|&k| cones.list[k].axis.x < 0.0).unwrap();
        let expected = 2.0 * PI * sizes[second];
        assert!(
            (left / f64::from(expected) - 1.0).abs() < 0.02,
            "{left} {expected}"
        );
    }

    fn cones(aim: &Aim) -> Cones {
        let hit = crate::scene::hit::Hit {
            p: Vec3::ZERO,
            n: Vec3::new(0.0, 0.0, 1.0),
            triangle: 0,
            surface: crate::scene::surface::Surface::new(&picofarm_scene::Material::diffuse(
                "wall", [0.5; 3],
            )),
            through: 1.0,
        };
        aim.from(&hit).unwrap()
    }
}
