//! The laser: its position, the directions of its beams, and their spots.

use picofarm_settings::Spots;
use serde::{Deserialize, Serialize};

use crate::{Camera, Vec3, rng::Rng, trace::World};

/// One collimated (delta) beam of unit pulse energy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Beam {
    /// The unit direction at the laser, in world space.
    pub direction: Vec3,
    /// The beam's spot, if the scene's source gives it; otherwise the renderer traces the beam.
    pub spot: Option<Spot>,
}

/// An illumination spot L_i: the point at which a beam hits the first diffuse surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spot {
    /// The world position, metres.
    pub point: Vec3,
    /// The unit geometric normal of the facet, on the side from which the beam arrives.
    pub normal: Vec3,
    /// The unit direction in which the beam arrives (towards the surface).
    pub arriving: Vec3,
    /// The optical path from the laser to the spot, metres (folded through mirrors).
    pub path_m: f32,
    /// The index of the object.
    pub object: u32,
    /// The index of the material in that object's mesh.
    pub material: u32,
}

/// The laser of a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Laser {
    /// The position x_l in world space, metres (usually the camera's).
    pub origin: Vec3,
    /// The beams, one a spot.
    pub beams: Vec<Beam>,
}

/// The points of the camera's view at which the beams of a laser are aimed.
#[derive(Debug, Clone, PartialEq)]
pub struct Aim(Vec<[f32; 2]>);

/// The stream of the random numbers that determine the positions of spots. No attempt at a room
/// uses this number.
const PLACES: u64 = u64::MAX;

impl Aim {
    /// Returns the grid of `spots` spots, or `None` if there is no grid of that size.
    ///
    /// # Examples
    /// ```
    /// use picofarm_scene::{Aim, Camera, Intrinsics, Vec3};
    ///
    /// let intrinsics = Intrinsics::from_fov(90.0, 8, 8);
    /// let camera = Camera::look_at(Vec3::ZERO, Vec3::new(0.0, 0.0, 1.0), intrinsics);
    /// let laser = Aim::grid(4).expect("a grid of 2×2").laser(&camera);
    /// assert_eq!(laser.beams.len(), 4);
    /// ```
    pub fn grid(spots: u32) -> Option<Self> {
        Self::of(&Spots::Grid(spots), 0).ok()
    }

    /// Returns the spots of the scene of `seed`. Random positions depend only on seed and index, so
    /// a smaller number of spots gives the first of a larger number.
    ///
    /// # Errors
    /// The fault in the spots.
    pub fn of(spots: &Spots, seed: u64) -> Result<Self, String> {
        spots.check()?;
        Ok(Self(match spots {
            Spots::Grid(n) => grid(*n),
            Spots::Random(n) => {
                let mut rng = Rng::new(seed, PLACES);
                (0..*n).map(|_| [rng.unit(), rng.unit()]).collect()
            }
            Spots::At(places) => places.iter().map(|p| p.map(|x| x as f32)).collect(),
        }))
    }

    /// Returns the film positions in `[0, 1]²` (x right, y down).
    pub fn film(&self) -> &[[f32; 2]] {
        &self.0
    }

    /// Returns a laser with beams from the camera's centre.
    pub fn laser(&self, camera: &Camera) -> Laser {
        let beam = |direction: Vec3| Beam {
            direction: direction.normalized(),
            spot: None,
        };
        Laser {
            origin: camera.origin,
            beams: self.rays(camera).map(beam).collect(),
        }
    }

    /// Returns a laser at `place` in the camera's frame (x right, y down, z forward; metres). Its
    /// beams are aimed at the points that the camera sees at the film positions, as a laboratory
    /// steers its mirrors. Returns `None` if a ray of the camera hits nothing, or if the laser is
    /// outside the room.
    pub(crate) fn laser_at(&self, camera: &Camera, place: Vec3, world: &World) -> Option<Laser> {
        if place == Vec3::default() {
            return Some(self.laser(camera));
        }
        let away = camera.right * place.x + camera.down * place.y + camera.forward * place.z;
        let distance = away.length();
        // A wall or an object in between would be lit from behind.
        if world
            .closest(camera.origin, away * (1.0 / distance))
            .is_none_or(|hit| hit.t <= distance)
        {
            return None;
        }
        let origin = camera.origin + away;
        let beam = |ray: Vec3| {
            let seen = camera.origin + ray * world.closest(camera.origin, ray)?.t;
            Some(Beam {
                direction: (seen - origin).normalized(),
                spot: None,
            })
        };
        let beams = self.rays(camera).map(beam).collect::<Option<_>>()?;
        Some(Laser { origin, beams })
    }

    fn rays(&self, camera: &Camera) -> impl Iterator<Item = Vec3> {
        let i = camera.intrinsics;
        let (w, h) = (i.width as f32, i.height as f32);
        self.0.iter().map(move |[x, y]| camera.ray(x * w, y * h))
    }
}

/// Returns the film positions of a grid, row by row. 4 and 25 are subsets of the 10×10 grid of cell
/// centres: 25 = rows 0,2,4,6,8 × columns 1,3,5,7,9; 4 = indices 22, 27, 72, 77. 16 is a separate
/// 4×4 grid; 1 is the centre.
fn grid(spots: u32) -> Vec<[f32; 2]> {
    let cell = |i: u32, n: u32| (i as f32 + 0.5) / n as f32;
    let of_hundred = |i: u32| [cell(i % 10, 10), cell(i / 10, 10)];
    match spots {
        1 => vec![[0.5, 0.5]],
        4 => [22, 27, 72, 77].map(of_hundred).to_vec(),
        16 => (0..16).map(|i| [cell(i % 4, 4), cell(i / 4, 4)]).collect(),
        25 => (0..25)
            .map(|i| of_hundred((i / 5) * 2 * 10 + (i % 5) * 2 + 1))
            .collect(),
        _ => (0..100).map(of_hundred).collect(),
    }
}

#[cfg(test)]
mod tests {
    use picofarm_settings::Spots;

    use super::Aim;

    fn film(spots: u32) -> Vec<[f32; 2]> {
        Aim::grid(spots).expect("a standard grid").film().to_vec()
    }

    #[test]
    fn the_grids_of_4_and_25_are_cut_out_of_the_100() {
        let hundred = film(100);
        let index = |p: &[f32; 2]| hundred.iter().position(|q| q == p);
        let four: Vec<_> = film(4).iter().map(index).collect();
        assert_eq!(four, [22, 27, 72, 77].map(Some));
        let of_25: Vec<_> = film(25).iter().map(index).collect();
        let expected: Vec<_> = [0, 2, 4, 6, 8]
            .iter()
            .flat_map(|r| [1, 3, 5, 7, 9].map(|c| Some(r * 10 + c)))
            .collect();
        assert_eq!(of_25, expected);
    }

    #[test]
    fn every_grid_lies_on_the_film_and_has_its_number_of_spots() {
        for n in Spots::GRIDS {
            let points = film(n);
            assert_eq!(points.len(), n as usize);
            assert!(points.iter().flatten().all(|x| (0.0..1.0).contains(x)));
        }
        assert_eq!(Aim::grid(9), None);
    }

    #[test]
    fn random_places_fill_the_film_evenly_and_follow_from_the_seed_alone() {
        let at = |n: u32, seed: u64| Aim::of(&Spots::Random(n), seed).unwrap();
        assert_eq!(at(16, 7), at(16, 7));
        assert_ne!(at(16, 7), at(16, 8));
        assert_eq!(at(16, 7).film(), &at(100, 7).film()[..16]);
        let mut quarters = [0; 4];
        for seed in 0..200 {
            for &[x, y] in at(20, seed).film() {
                assert!((0.0..1.0).contains(&x) && (0.0..1.0).contains(&y));
                quarters[usize::from(x >= 0.5) + 2 * usize::from(y >= 0.5)] += 1;
            }
        }
        // 4,000 positions: 1,000 ± 27.4 in each quarter.
        assert!(
            quarters.iter().all(|n| (863..1137).contains(n)),
            "{quarters:?}"
        );
    }

    #[test]
    fn given_places_are_taken_as_they_are() {
        let spots = Spots::At(vec![[0.25, 0.5], [0.75, 0.125]]);
        let aim = Aim::of(&spots, 3).unwrap();
        assert_eq!(aim.film(), [[0.25, 0.5], [0.75, 0.125]]);
        assert!(Aim::of(&Spots::At(vec![[0.5, 1.5]]), 3).is_err());
    }
}
