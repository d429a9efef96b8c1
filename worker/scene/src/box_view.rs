//! The depths that a camera sees in a room that is a box, without a ray for each pixel.
//!
//! The acceptance of a generated room needs the smallest and the largest z-depth over the centres
//! of 65,536 pixels. Rectangles of pixels are halved, and one is left out when bounds show that it
//! has neither. A ray decides each remaining pixel, so the result has the same bits as
//! [`full_view`](crate::view::full_view).
//!
//! Along a ray, the inverse distance to a wall's plane is linear in the position on the film, so
//! its extremes over a rectangle are at the corners. A ray leaves the box at the nearest of the
//! planes ahead. An object is at least as far as the planes of its bounding box that face the
//! camera, and as the nearest corner of that box.

use crate::{Camera, Vec3, trace::World};

/// The relative margin of bounds, which covers the rounding of rays.
const MARGIN: f64 = 1e-4;
/// The smallest distance in front of the camera at which a point is projected, metres.
const IN_FRONT_M: f64 = 0.01;

/// A rectangle of pixels: columns and rows from the first value up to the second, exclusive.
#[derive(Debug, Clone, Copy)]
struct Pixels {
    columns: [u32; 2],
    rows: [u32; 2],
}

impl Pixels {
    /// Returns whether bounds of halves would take longer than the rays.
    fn are_few(self) -> bool {
        (self.columns[1] - self.columns[0]) * (self.rows[1] - self.rows[0]) <= 4
    }

    /// Returns both halves along the longer side.
    fn halves(self) -> [Self; 2] {
        let Self {
            columns: [left, right],
            rows: [top, bottom],
        } = self;
        match right - left >= bottom - top {
            true => {
                let middle = left + (right - left) / 2;
                [[left, middle], [middle, right]].map(|columns| Self { columns, ..self })
            }
            false => {
                let middle = top + (bottom - top) / 2;
                [[top, middle], [middle, bottom]].map(|rows| Self { rows, ..self })
            }
        }
    }

    /// Returns the film positions of the outermost pixel centres.
    fn corners(self) -> [[f64; 2]; 4] {
        let [left, right] = [self.columns[0], self.columns[1] - 1].map(|x| f64::from(x) + 0.5);
        let [top, bottom] = [self.rows[0], self.rows[1] - 1].map(|y| f64::from(y) + 0.5);
        [[left, top], [right, top], [left, bottom], [right, bottom]]
    }
}

/// The part of the film that an object's bounding box covers, and what bounds its depth.
#[derive(Debug)]
struct Cover {
    lo: [f64; 2],
    hi: [f64; 2],
    /// The smallest z-depth of its corners.
    depth: f64,
    /// By axis: the side of the camera on which the box is (±1), or 0 for both, and its distance.
    ahead: [(f64, f64); 3],
}

/// A camera in a box.
struct BoxView<'a> {
    world: &'a World,
    camera: &'a Camera,
    /// The ray through a film position (x, y) is `ray[0]` + x `ray[1]` + y `ray[2]`. Its component
    /// along the camera's axis is 1.
    ray: [[f64; 3]; 3],
    /// Inverse distances from the camera to the walls towards −x, −y, −z and +x, +y, +z, 1/m.
    walls: [[f64; 3]; 2],
    covers: Vec<Cover>,
    /// The depths found so far.
    near: f32,
    far: f32,
}

/// Which of the two depths is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Search {
    Near,
    Far,
}

/// Returns the smallest and largest z-depth over every pixel centre, or `None` if one is outside
/// `bounds`. The camera is within a box with opaque walls from `room[0]` to `room[1]`, which are
/// the first `walls` models of `world`.
pub(crate) fn depths_in_box(
    (world, walls): (&World, usize),
    room: [Vec3; 2],
    camera: &Camera,
    [least, most]: [f32; 2],
) -> Option<[f32; 2]> {
    let to = |k: usize, side: usize| 1.0 / f64::from((room[side][k] - camera.origin[k]).abs());
    let i = &camera.intrinsics;
    let [cx, cy, fx, fy] = [i.cx, i.cy, i.fx, i.fy].map(f64::from);
    let axes = [camera.right, camera.down, camera.forward];
    let along = |k: usize| axes.map(|axis| f64::from(axis[k]));
    let columns = [0, 1, 2].map(|k| {
        let [right, down, forward] = along(k);
        let middle = forward - right * cx / fx - down * cy / fy;
        [middle, right / fx, down / fy]
    });
    let ray = [0, 1, 2].map(|part| columns.map(|column| column[part]));
    let mut view = BoxView {
        world,
        camera,
        ray,
        walls: [0, 1].map(|side| [0, 1, 2].map(|k| to(k, side))),
        covers: world.boxes(walls).map(|b| cover(camera, b)).collect(),
        near: f32::INFINITY,
        far: 0.0,
    };
    let all = Pixels {
        columns: [0, i.width],
        rows: [0, i.height],
    };
    for search in [Search::Far, Search::Near] {
        view.search(all, search)?;
        if view.near < least || view.far > most {
            return None;
        }
    }
    Some([view.near, view.far])
}

impl BoxView<'_> {
    /// Searches a rectangle of pixels for an extreme depth. Returns `None` if a ray hits nothing.
    fn search(&mut self, pixels: Pixels, search: Search) -> Option<()> {
        if pixels.are_few() {
            for row in pixels.rows[0]..pixels.rows[1] {
                for column in pixels.columns[0]..pixels.columns[1] {
                    let ray = self.camera.ray(column as f32 + 0.5, row as f32 + 0.5);
                    // Camera rays have z-component 1, so the ray parameter is the z-depth.
                    let hit = self.world.closest(self.camera.origin, ray)?;
                    (self.near, self.far) = (self.near.min(hit.t), self.far.max(hit.t));
                }
            }
            return Some(());
        }
        let mut halves = pixels.halves().map(|half| (self.bound(half, search), half));
        // The more promising half goes first, so that the other is more often left out.
        if (halves[0].0 > halves[1].0) == (search == Search::Near) {
            halves.swap(0, 1);
        }
        for (bound, half) in halves {
            let hopeless = match search {
                Search::Near => bound * (1.0 - MARGIN) >= f64::from(self.near),
                Search::Far => bound * (1.0 + MARGIN) <= f64::from(self.far),
            };
            if !hopeless {
                self.search(half, search)?;
            }
        }
        Some(())
    }

    /// Returns a lower bound of the smallest depth in a rectangle, or an upper bound of the
    /// largest.
    fn bound(&self, pixels: Pixels, search: Search) -> f64 {
        let corners = pixels.corners();
        // The smallest and largest components of the rays, which are linear on the film.
        let (mut least, mut most) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for [x, y] in corners {
            for k in 0..3 {
                let component = self.ray[0][k] + x * self.ray[1][k] + y * self.ray[2][k];
                least[k] = least[k].min(component);
                most[k] = most[k].max(component);
            }
        }
        let mut inverse = 0.0f64;
        for k in 0..3 {
            let [below, above] = [self.walls[0][k], self.walls[1][k]];
            // Of a wall that not all rays meet, nothing is known about the farthest.
            let here = match search {
                Search::Near => (-least[k] * below).max(most[k] * above),
                Search::Far => (-most[k] * below).max(least[k] * above),
            };
            inverse = inverse.max(here);
        }
        let wall = 1.0 / inverse;
        if search == Search::Far {
            return wall;
        }
        let [lo, hi] = [corners[0], corners[3]];
        let mut nearest = wall;
        for cover in &self.covers {
            let apart = |k: usize| cover.lo[k] > hi[k] + 1.0 || lo[k] - 1.0 > cover.hi[k];
            if apart(0) || apart(1) {
                continue;
            }
            let mut depth = cover.depth;
            for k in 0..3 {
                let (side, distance) = cover.ahead[k];
                let fastest = if side < 0.0 { -least[k] } else { most[k] };
                // Rays that go away from the box leave it out, which needs no bound.
                if side != 0.0 && fastest > 0.0 {
                    depth = depth.max(distance / fastest);
                }
            }
            nearest = nearest.min(depth);
        }
        nearest
    }
}

/// Returns the part of the film that a box covers. A box that is not in front of the camera counts
/// as everywhere.
fn cover(camera: &Camera, corners: [Vec3; 2]) -> Cover {
    let i = &camera.intrinsics;
    let mut cover = Cover {
        lo: [f64::INFINITY; 2],
        hi: [f64::NEG_INFINITY; 2],
        depth: f64::INFINITY,
        ahead: [0, 1, 2].map(|k| {
            let [lo, hi] = corners.map(|corner| f64::from(corner[k]) - f64::from(camera.origin[k]));
            match (lo > 0.0, hi < 0.0) {
                (true, _) => (1.0, lo),
                (_, true) => (-1.0, -hi),
                _ => (0.0, 0.0),
            }
        }),
    };
    for corner in 0..8 {
        let at = |k: usize| corners[corner >> k & 1][k];
        let p = camera.to_camera(Vec3::new(at(0), at(1), at(2)));
        let [x, y, z] = [p.x, p.y, p.z].map(f64::from);
        cover.depth = cover.depth.min(z);
        if z < IN_FRONT_M {
            return Cover {
                lo: [f64::NEG_INFINITY; 2],
                hi: [f64::INFINITY; 2],
                depth: 0.0,
                ..cover
            };
        }
        let place = [
            x / z * f64::from(i.fx) + f64::from(i.cx),
            y / z * f64::from(i.fy) + f64::from(i.cy),
        ];
        for (k, at) in place.into_iter().enumerate() {
            cover.lo[k] = cover.lo[k].min(at);
            cover.hi[k] = cover.hi[k].max(at);
        }
    }
    cover
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{
        Affine, Material,
        layout::Room,
        rng::Rng,
        shape::Shape,
        trace::Model,
        view::{acceptance, full_view},
    };

    /// Returns a room with up to four boxes and cylinders, some of which reach through a wall.
    fn room(rng: &mut Rng) -> (World, Room) {
        let room = Room {
            width: rng.range(0.3, 5.0),
            depth: rng.range(0.3, 5.0),
            height: rng.range(0.3, 3.0),
        };
        let grey = || Material::diffuse("grey", [0.5; 3]);
        let mut world = World::default();
        for (_, mesh) in room.shell(grey(), grey(), grey()) {
            let model = Model::new(mesh).expect("a wall has triangles");
            world.add(Arc::new(model), Affine::IDENTITY);
        }
        for k in 0..rng.below(5) {
            let mut shape = Shape::new("object");
            let m = shape.material(grey());
            let (half, height) = (rng.range(0.01, 0.3), rng.range(0.05, 1.0));
            match k % 2 {
                0 => shape.cuboid([-half, 0.0, -half], [half, height, half], m),
                _ => shape.cylinder([0.0; 2], [0.0, height], [half, half], 48, m),
            }
            let model = Model::new(shape.finish()).expect("an object has triangles");
            let at = Vec3::new(
                rng.range(-0.5, 0.5) * room.width,
                rng.range(-0.1, 0.8) * room.height,
                rng.range(-0.5, 0.2) * room.depth,
            );
            world.add(
                Arc::new(model),
                Affine::yaw_then_move(rng.range(0.0, 6.0), at),
            );
        }
        (world, room)
    }

    #[test]
    fn the_depths_have_the_bits_of_a_search_over_all_pixels() {
        let mut seen = 0;
        for seed in 0..60 {
            let mut rng = Rng::new(seed, 0);
            let (world, room) = room(&mut rng);
            let eye = Vec3::new(
                rng.range(-0.45, 0.45) * room.width,
                rng.range(0.1, 0.9) * room.height,
                rng.range(0.3, 0.48) * room.depth,
            );
            let target = match seed % 4 {
                // Straight at the back wall, where many pixels have nearly the same depth.
                0 => Vec3::new(eye.x, eye.y, -room.depth),
                _ => Vec3::new(rng.range(-1.0, 1.0), rng.range(0.0, 1.0), -room.depth),
            };
            let film = acceptance(rng.range(20.0, 110.0), 4, 1 + seed as u32 % 5);
            let camera = Camera::look_at(eye, target, film);
            let bounds = match seed % 3 {
                0 => [rng.range(0.0, 0.5), rng.range(0.5, 5.0)],
                _ => [0.0, f32::INFINITY],
            };
            let ours = depths_in_box((&world, 6), room.corners(), &camera, bounds);
            let all = full_view(&world, &camera, bounds);
            let bits = |depths: Option<[f32; 2]>| depths.map(|d| d.map(f32::to_bits));
            assert_eq!(
                bits(ours),
                bits(all),
                "seed {seed}: {ours:?} instead of {all:?}"
            );
            seen += u32::from(all.is_some());
        }
        assert!(
            (30..60).contains(&seen),
            "{seen} of 60 views are within bounds"
        );
    }
}
