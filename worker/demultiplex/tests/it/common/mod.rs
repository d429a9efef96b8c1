//! A box room whose two-bounce times and amplitudes are known in closed form.
#![allow(dead_code, reason = "each file of tests uses its part")]

use picofarm_demultiplex::{Capture, Place, Spot};
use picofarm_scene::{Camera, Intrinsics, Vec3};
use picofarm_settings::Gate;

/// Half sizes of the room: x, y, and z ahead of the camera.
const HALF: [f32; 3] = [1.6, 1.2, 3.0];
/// Parts of a pixel each way.
const PARTS: usize = 4;

/// A screen across the room's width.
#[derive(Clone, Copy)]
pub struct Plate {
    pub x: f32,
    /// Top, near end, bottom, far end.
    pub sides: [f32; 4],
}

/// The size of a room and what hangs on its far wall.
#[derive(Clone, Copy)]
pub struct Shape {
    /// Factor on all half sizes.
    pub size: f32,
    /// Left, top, right, bottom of a mirror.
    pub mirror: Option<[f32; 4]>,
}

impl Shape {
    pub const PLAIN: Self = Self {
        size: 1.0,
        mirror: None,
    };

    /// Whether a point is on the mirror.
    fn mirrors(&self, x: Vec3) -> bool {
        self.mirror.is_some_and(|[left, top, right, bottom]| {
            let far = (x.z - self.size * HALF[2]).abs() < 1e-4;
            far && x.x > left && x.x < right && x.y > top && x.y < bottom
        })
    }
}

pub struct Room {
    pub camera: Camera,
    pub gate: Gate,
    pub laser: Vec3,
    pub plate: Option<Plate>,
    /// 1 where a pixel's middle sees the mirror.
    pub mirror: Vec<u8>,
    pub spots: Vec<Place>,
    pub directions: Vec<Vec3>,
    pub histogram: Vec<f32>,
    pub depth: Vec<f32>,
    /// `[spot][row][column]`.
    pub lit: Vec<u8>,
    /// Whether both cosines of a pair exceed a tenth.
    pub faces: Vec<bool>,
}

/// What a ray meets: range along the unit direction, and the normal towards it.
fn meet(plate: Option<Plate>, size: f32, from: Vec3, d: Vec3) -> (f32, Vec3) {
    let (mut best, mut normal) = (f32::INFINITY, Vec3::ZERO);
    for axis in 0..3 {
        let half = size * HALF[axis];
        if d[axis].abs() > 1e-9 {
            let side = d[axis].signum();
            let t = (side * half - from[axis]) / d[axis];
            if t > 1e-4 && t < best {
                best = t;
                let mut n = [0.0; 3];
                n[axis] = -side;
                normal = n.into();
            }
        }
    }
    if let Some(plate) = plate.filter(|_| d.x.abs() > 1e-9) {
        let t = (plate.x - from.x) / d.x;
        let q = from + d * t;
        let [top, near, bottom, far] = plate.sides;
        let inside = q.y > top && q.y < bottom && q.z > near && q.z < far;
        if t > 1e-4 && t < best && inside {
            best = t;
            normal = Vec3::new(-d.x.signum(), 0.0, 0.0);
        }
    }
    (best, normal)
}

/// Whether a segment between two surface points is free.
fn free(plate: Option<Plate>, size: f32, a: Vec3, b: Vec3) -> bool {
    let way = b - a;
    let long = way.length();
    let d = way / long;
    meet(plate, size, a + d * 1e-3, d).0 > long - 3e-3
}

impl Room {
    pub fn new(side: u32, places: &[[f32; 2]], plate: Option<Plate>) -> Self {
        let gate = Gate {
            start_m: 1.0,
            bin_width_m: 0.0384,
            bins: 480,
        };
        Self::with(side, places, plate, gate, Vec3::ZERO, |_, _| true)
    }

    /// `sends`: whether a spot's light to a pixel is in the histogram at all.
    pub fn with(
        side: u32,
        places: &[[f32; 2]],
        plate: Option<Plate>,
        gate: Gate,
        laser: Vec3,
        sends: impl Fn(usize, usize) -> bool,
    ) -> Self {
        Self::shaped(side, places, plate, gate, laser, Shape::PLAIN, sends)
    }

    /// The same in a room of another shape. No spot may be on the mirror, and no light comes to a
    /// surface by way of it.
    pub fn shaped(
        side: u32,
        places: &[[f32; 2]],
        plate: Option<Plate>,
        gate: Gate,
        laser: Vec3,
        shape: Shape,
        sends: impl Fn(usize, usize) -> bool,
    ) -> Self {
        let size = shape.size;
        let camera = Camera {
            intrinsics: Intrinsics::from_fov(90.0, side, side),
            origin: Vec3::ZERO,
            right: Vec3::new(1.0, 0.0, 0.0),
            down: Vec3::new(0.0, 1.0, 0.0),
            forward: Vec3::new(0.0, 0.0, 1.0),
        };
        let n = side as usize;
        let (pixels, bins) = (n * n, gate.bins as usize);
        let seen: Vec<(Vec3, Vec3)> = places
            .iter()
            .map(|[x, y]| {
                let d = camera.ray(x * side as f32, y * side as f32).normalized();
                let (r, normal) = meet(plate, size, Vec3::ZERO, d);
                (d * r, normal)
            })
            .collect();
        let spots: Vec<Place> = seen
            .iter()
            .map(|(point, _)| Place {
                point: *point,
                path_m: (*point - laser).length(),
            })
            .collect();
        let mut histogram = vec![0.0f32; pixels * bins];
        let mut depth = vec![0.0; pixels];
        let mut mirror = vec![0; pixels];
        let mut lit = vec![0; pixels * places.len()];
        let mut faces = vec![false; pixels * places.len()];
        for p in 0..pixels {
            let (column, row) = ((p % n) as f32, (p / n) as f32);
            let d = camera.ray(column + 0.5, row + 0.5);
            let (r, normal) = meet(plate, size, Vec3::ZERO, d.normalized());
            let x = d.normalized() * r;
            depth[p] = x.z;
            mirror[p] = u8::from(shape.mirrors(x));
            for (k, (l, at)) in seen.iter().enumerate() {
                let way = (x - *l).normalized();
                let cosines = (at.dot(way), -normal.dot(way));
                faces[k * pixels + p] = cosines.0.min(cosines.1) > 0.1;
                let facing = cosines.0.min(cosines.1) > -1e-3;
                lit[k * pixels + p] = u8::from(facing && free(plate, size, *l, x));
            }
            for part in 0..PARTS * PARTS {
                let (a, b) = (part % PARTS, part / PARTS);
                let of = |k: usize| (k as f32 + 0.5) / PARTS as f32;
                let d = camera.ray(column + of(a), row + of(b)).normalized();
                let (mut r, mut normal) = meet(plate, size, Vec3::ZERO, d);
                let mut x = d * r;
                if shape.mirrors(x) {
                    let back = Vec3::new(d.x, d.y, -d.z);
                    let (more, at) = meet(plate, size, x, back);
                    (r, normal, x) = (r + more, at, x + back * more);
                }
                for (k, (l, at)) in seen.iter().enumerate() {
                    let way = x - *l;
                    let long = way.length();
                    let cosines = (at.dot(way) / long, -normal.dot(way) / long);
                    if cosines.0 <= 1e-4
                        || cosines.1 <= 1e-4
                        || !sends(k, p)
                        || !free(plate, size, *l, x)
                    {
                        continue;
                    }
                    let path = spots[k].path_m + long + r;
                    if let Some(bin) = gate.bin(f64::from(path)) {
                        let share = cosines.0 * cosines.1 / (long * long);
                        histogram[p * bins + bin as usize] += share / (PARTS * PARTS) as f32;
                    }
                }
            }
        }
        for ([x, y], spot) in places.iter().zip(&spots) {
            let pixel = (y * side as f32) as usize * n + (x * side as f32) as usize;
            let path = f64::from(spot.path_m + spot.point.length());
            if let Some(bin) = gate.bin(path) {
                histogram[pixel * bins + bin as usize] += 1e4;
            }
        }
        let directions = spots
            .iter()
            .map(|s| (s.point - laser).normalized())
            .collect();
        Self {
            camera,
            gate,
            laser,
            plate,
            mirror,
            spots,
            directions,
            histogram,
            depth,
            lit,
            faces,
        }
    }

    /// Beams, with their places or without.
    pub fn beams(&self, known: bool) -> Vec<Spot> {
        let all = self.spots.iter().zip(&self.directions);
        all.map(|(place, direction)| Spot {
            direction: *direction,
            place: known.then_some(*place),
        })
        .collect()
    }

    pub fn capture<'a>(&'a self, spots: &'a [Spot]) -> Capture<'a> {
        Capture {
            histogram: &self.histogram,
            gate: self.gate,
            camera: &self.camera,
            laser: self.laser,
            spots,
        }
    }

    /// Whether all pixels around one have its depth's surface and its mask: away from every edge.
    pub fn inner(&self, mask: &[u8], p: usize, reach: usize) -> bool {
        let n = self.camera.intrinsics.width as usize;
        let (column, row) = (p % n, p / n);
        let near = |x: usize| x.saturating_sub(reach)..(x + reach + 1).min(n);
        near(row).all(|v| {
            near(column).all(|u| {
                let q = v * n + u;
                mask[q] == mask[p] && (self.depth[q] - self.depth[p]).abs() < 0.12 * self.depth[p]
            })
        })
    }
}

/// A grid of spots over the film.
pub fn grid(n: usize) -> Vec<[f32; 2]> {
    let at = |k: usize| (k as f32 + 0.5) / n as f32;
    (0..n * n).map(|i| [at(i % n), at(i / n)]).collect()
}

/// Places without any order.
pub fn scattered(count: usize) -> Vec<[f32; 2]> {
    (0..count)
        .map(|i| {
            let x = (i as f32 * 0.754_877_7).fract();
            let y = (i as f32 * 0.569_840_3).fract();
            [0.04 + 0.92 * x, 0.04 + 0.92 * y]
        })
        .collect()
}
