//! The laser: where it stands, where its beams point, and the spots they make.

use serde::{Deserialize, Serialize};

use crate::{Camera, Vec3};

/// One collimated (delta) beam of unit pulse energy.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Beam {
    /// Unit direction in world space at the laser.
    pub direction: Vec3,
    /// The spot it makes, where the scene's source states it; otherwise the renderer traces the beam.
    pub spot: Option<Spot>,
}

/// An illumination spot L_i: where a beam meets the first diffuse surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spot {
    /// World position, metres.
    pub point: Vec3,
    /// Unit geometric normal of the facet, on the side from which the beam arrives.
    pub normal: Vec3,
    /// Unit direction in which the beam arrives (towards the surface).
    pub arriving: Vec3,
    /// Optical path from the laser to the spot, metres (folded through mirrors).
    pub path_m: f32,
    /// Index of the object hit.
    pub object: u32,
    /// Index of the material in that object's mesh.
    pub material: u32,
}

/// The laser of a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Laser {
    /// Position x_l in world space, metres (usually the camera's).
    pub origin: Vec3,
    /// Its beams, one a spot.
    pub beams: Vec<Beam>,
}

/// The standard grids of spots over the camera's field of view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct LaserGrid(u32);

impl LaserGrid {
    /// The grids that exist, by number of spots.
    pub const SIZES: [u32; 4] = [4, 16, 25, 100];

    /// The grid of `spots` spots; `None` unless `spots` is 1 or one of [`LaserGrid::SIZES`].
    pub fn new(spots: u32) -> Option<Self> {
        (spots == 1 || Self::SIZES.contains(&spots)).then_some(Self(spots))
    }

    /// Number of spots.
    pub fn spots(self) -> u32 {
        self.0
    }

    /// Film positions in `[0, 1]²` (x right, y down), row by row. 4 and 25 are subsets of the 10×10 grid
    /// of cell centres: 25 = rows 0,2,4,6,8 × columns 1,3,5,7,9; 4 = indices 22, 27, 72, 77. 16 is a
    /// 4×4 grid of its own; 1 is the centre.
    pub fn film(self) -> Vec<[f32; 2]> {
        let cell = |i: u32, n: u32| (i as f32 + 0.5) / n as f32;
        let of_hundred = |i: u32| [cell(i % 10, 10), cell(i / 10, 10)];
        match self.0 {
            1 => vec![[0.5, 0.5]],
            4 => [22, 27, 72, 77].map(of_hundred).to_vec(),
            16 => (0..16).map(|i| [cell(i % 4, 4), cell(i / 4, 4)]).collect(),
            25 => (0..25)
                .map(|i| of_hundred((i / 5) * 2 * 10 + (i % 5) * 2 + 1))
                .collect(),
            _ => (0..100).map(of_hundred).collect(),
        }
    }

    /// Beams from the camera's centre through the grid's film positions.
    pub fn laser(self, camera: &Camera) -> Laser {
        let i = &camera.intrinsics;
        let beams = self
            .film()
            .into_iter()
            .map(|[x, y]| Beam {
                direction: camera
                    .ray(x * i.width as f32, y * i.height as f32)
                    .normalized(),
                spot: None,
            })
            .collect();
        Laser {
            origin: camera.origin,
            beams,
        }
    }
}

/// The grid of a generator's `spots` setting, or (field, what was expected).
pub(crate) fn check_spots(spots: u32) -> Result<LaserGrid, (&'static str, String)> {
    LaserGrid::new(spots).ok_or_else(|| {
        (
            "spots",
            format!("{spots}: there are grids of 1, 4, 16, 25 and 100 spots"),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::LaserGrid;

    fn film(spots: u32) -> Vec<[f32; 2]> {
        LaserGrid::new(spots).expect("a standard grid").film()
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
        for n in [1, 4, 16, 25, 100] {
            let points = film(n);
            assert_eq!(points.len(), n as usize);
            assert!(points.iter().flatten().all(|x| (0.0..1.0).contains(x)));
        }
        assert_eq!(LaserGrid::new(9), None);
    }
}
