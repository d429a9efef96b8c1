//! Rays of pixels, places of spots, and normals of depth maps, all in the camera's frame.

use picofarm_scene::{Intrinsics, Vec3};
use picofarm_settings::Gate;

use crate::{Capture, Place};

/// Focal length per step between neighbours, pixels.
const STEP_FOCAL: f32 = 64.0;

/// The pinhole: unit directions through the middles of pixels.
#[derive(Debug, Clone)]
pub struct Rays {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Intrinsics in pixels.
    pub lens: Intrinsics,
    /// Unit directions, row-major.
    pub unit: Vec<Vec3>,
    /// Range over z-depth.
    pub slant: Vec<f32>,
}

impl Rays {
    pub fn new(lens: Intrinsics) -> Self {
        let (width, height) = (lens.width as usize, lens.height as usize);
        let film = (0..width * height).map(|p| film(&lens, (p % width) as f32, (p / width) as f32));
        let (unit, slant) = film.map(|d| (d.normalized(), d.length())).unzip();
        Self {
            width,
            height,
            lens,
            unit,
            slant,
        }
    }

    /// Pixels.
    pub fn len(&self) -> usize {
        self.unit.len()
    }

    /// Pixels between neighbours that are compared, so that neighbourhoods have the same angle in
    /// images of any size: 1 up to 128 pixels over 90°, 2 at 256.
    pub fn step(&self) -> usize {
        (self.lens.fx.max(self.lens.fy) / STEP_FOCAL)
            .round()
            .max(1.0) as usize
    }

    /// The point of z-depth 1 on the ray of a pixel's middle.
    pub fn film(&self, pixel: usize) -> Vec3 {
        film(
            &self.lens,
            (pixel % self.width) as f32,
            (pixel / self.width) as f32,
        )
    }

    /// The pixel that sees a point.
    pub fn pixel_of(&self, q: Vec3) -> Option<usize> {
        if q.z <= 1e-3 {
            return None;
        }
        let u = q.x / q.z * self.lens.fx + self.lens.cx;
        let v = q.y / q.z * self.lens.fy + self.lens.cy;
        let inside = u >= 0.0 && v >= 0.0 && u < self.width as f32 && v < self.height as f32;
        inside.then(|| v as usize * self.width + u as usize)
    }
}

fn film(lens: &Intrinsics, column: f32, row: f32) -> Vec3 {
    Vec3::new(
        (column + 0.5 - lens.cx) / lens.fx,
        (row + 0.5 - lens.cy) / lens.fy,
        1.0,
    )
}

/// A spot in the camera's frame.
#[derive(Debug, Clone, Copy)]
pub struct Source {
    /// Index of its beam.
    pub beam: usize,
    /// L, metres.
    pub point: Vec3,
    /// |L|².
    pub square: f32,
    /// Path from the laser to L, metres.
    pub path_m: f32,
    /// Normal of the surface that it is on, towards the camera's side; zero where unknown.
    pub normal: Vec3,
}

impl Source {
    pub fn new(beam: usize, point: Vec3, path_m: f32) -> Self {
        Self {
            beam,
            point,
            square: point.dot(point),
            path_m,
            normal: Vec3::ZERO,
        }
    }

    /// Two-bounce path by way of a point in the camera's frame, metres.
    #[inline]
    pub fn path(&self, x: Vec3) -> f32 {
        self.path_m + (x - self.point).length() + x.length()
    }
}

/// Places of all beams, world axes; `None` where a beam has no return.
pub fn places(capture: &Capture) -> Vec<Option<Place>> {
    let own = |spot: &crate::Spot| own_return(capture, spot.direction.normalized());
    let all = capture.spots.iter();
    all.map(|spot| spot.place.or_else(|| own(spot))).collect()
}

/// Steps of a quarter of a bin along a beam.
const STEPS_A_BIN: f64 = 4.0;

/// Where the histogram is brightest along a beam at the time of its one-bounce return: laser → L →
/// camera. The return fills one bin, so the middle of the steps that share it is taken.
fn own_return(capture: &Capture, direction: Vec3) -> Option<Place> {
    let camera = capture.camera;
    let rays = Rays {
        width: camera.intrinsics.width as usize,
        height: camera.intrinsics.height as usize,
        lens: camera.intrinsics,
        unit: Vec::new(),
        slant: Vec::new(),
    };
    let Gate {
        bin_width_m, bins, ..
    } = capture.gate;
    let step = (bin_width_m / 2.0 / STEPS_A_BIN) as f32;
    let farthest = capture.gate.end_m().max(0.0) as f32;
    let at = |n: usize| -> Option<(usize, f32)> {
        let point = capture.laser + direction * (n as f32 * step);
        let there = camera.to_camera(point);
        let pixel = rays.pixel_of(there)?;
        let path = n as f32 * step + there.length();
        let bin = capture.gate.bin(f64::from(path))? as usize;
        let (column, row) = (pixel % rays.width, pixel / rays.width);
        let mut best = (0, f32::NEG_INFINITY);
        // A spot on the edge of a pixel may shine in the next one.
        for v in row.saturating_sub(1)..(row + 2).min(rays.height) {
            for u in column.saturating_sub(1)..(column + 2).min(rays.width) {
                let index = (v * rays.width + u) * bins as usize + bin;
                if capture.histogram[index] > best.1 {
                    best = (index, capture.histogram[index]);
                }
            }
        }
        Some(best)
    };
    let count = (farthest / step) as usize + 1;
    let mut best: Option<(usize, f32, usize, usize)> = None;
    for n in 1..count {
        let Some((index, value)) = at(n) else {
            continue;
        };
        match &mut best {
            Some((i, _, _, last)) if *i == index => *last = n,
            Some((_, v, _, _)) if value <= *v => {}
            _ if value > 0.0 => best = Some((index, value, n, n)),
            _ => {}
        }
    }
    let (_, _, first, last) = best?;
    let path_m = 0.5 * (first + last) as f32 * step;
    Some(Place {
        point: capture.laser + direction * path_m,
        path_m,
    })
}

/// Unit normals of a map of z-depths, towards the camera, from a plane through each pixel's
/// neighbourhood: inverse depth is affine in the image where a surface is plane. Neighbours whose
/// depth leaps take no part; zero where too few are left.
pub fn normals(rays: &Rays, depth: &[f32], reach: usize, leap: f32) -> Vec<Vec3> {
    use rayon::prelude::*;
    (0..rays.len())
        .into_par_iter()
        .map(|p| {
            fit(rays, depth, p, reach, leap)
                .map_or(Vec3::ZERO, |plane| normal_of(plane, rays.unit[p]))
        })
        .collect()
}

/// A plane by inverse depth: 1/z = a x + b y + c over the film.
pub type Plane = [f32; 3];

/// The unit normal of a plane towards the camera.
pub fn normal_of(plane: Plane, ray: Vec3) -> Vec3 {
    let n = Vec3::new(plane[0], plane[1], plane[2]);
    let long = n.length();
    let known = long > 1e-12;
    if !known {
        return Vec3::ZERO;
    }
    let n = n / long;
    if n.dot(ray) > 0.0 { -n } else { n }
}

/// Share of inverse depth by which pixels may be off one plane.
const FLAT: f64 = 2e-3;

/// The plane through a pixel's neighbours of alike depth, by least squares in inverse depth. Where
/// they are on no one plane, the corner of the neighbourhood is taken that is flattest: an edge
/// between two surfaces belongs to neither.
pub fn fit(rays: &Rays, depth: &[f32], p: usize, reach: usize, leap: f32) -> Option<Plane> {
    let (whole, error) = fit_part(rays, depth, p, [reach; 4], leap)?;
    if error < FLAT {
        return Some(whole);
    }
    let corners = [
        [reach, 0, reach, 0],
        [reach, 0, 0, reach],
        [0, reach, reach, 0],
        [0, reach, 0, reach],
    ];
    let mut best = (whole, error);
    for corner in corners {
        if let Some(found) = fit_part(rays, depth, p, corner, leap)
            && found.1 < best.1
        {
            best = found;
        }
    }
    Some(best.0)
}

/// The same over pixels up to so many to the left, right, above and below; with the root mean
/// square error as a share of inverse depth.
fn fit_part(
    rays: &Rays,
    depth: &[f32],
    p: usize,
    [left, right, above, below]: [usize; 4],
    leap: f32,
) -> Option<(Plane, f64)> {
    let z0 = depth[p];
    if !(z0 > 0.0 && z0.is_finite()) {
        return None;
    }
    let (column, row) = (p % rays.width, p / rays.width);
    let centre = rays.film(p);
    // Sums about the pixel keep single differences exact.
    let mut m = [[0.0f64; 3]; 3];
    let mut r = [0.0f64; 3];
    let (mut squares, mut count) = (0.0f64, 0);
    for v in row.saturating_sub(above)..(row + below + 1).min(rays.height) {
        for u in column.saturating_sub(left)..(column + right + 1).min(rays.width) {
            let q = v * rays.width + u;
            let z = depth[q];
            let alike = z > 0.0 && (z - z0).abs() <= leap * z0;
            if !alike {
                continue;
            }
            let f = rays.film(q);
            let x = [f64::from(f.x - centre.x), f64::from(f.y - centre.y), 1.0];
            let w = f64::from(z0) / f64::from(z) - 1.0;
            for a in 0..3 {
                for b in 0..3 {
                    m[a][b] += x[a] * x[b];
                }
                r[a] += x[a] * w;
            }
            squares += w * w;
            count += 1;
        }
    }
    if count < 5 {
        return None;
    }
    let k = solve(m, r)?;
    let explained = k[0] * r[0] + k[1] * r[1] + k[2] * r[2];
    let error = ((squares - explained).max(0.0) / f64::from(count - 3)).sqrt();
    let [a, b] = [k[0] / f64::from(z0), k[1] / f64::from(z0)];
    let c = (1.0 + k[2]) / f64::from(z0) - a * f64::from(centre.x) - b * f64::from(centre.y);
    Some(([a as f32, b as f32, c as f32], error))
}

/// Cramer's rule; `None` for a matrix without an inverse.
pub fn solve(m: [[f64; 3]; 3], r: [f64; 3]) -> Option<[f64; 3]> {
    let det = |m: &[[f64; 3]; 3]| {
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
            - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    };
    let d = det(&m);
    let scale = m[0][0].abs() * m[1][1].abs() * m[2][2].abs();
    let invertible = d.is_finite() && d.abs() > 1e-9 * scale;
    if !invertible {
        return None;
    }
    let column = |k: usize| {
        let mut n = m;
        for (row, value) in n.iter_mut().zip(r) {
            row[k] = value;
        }
        det(&n) / d
    };
    Some([column(0), column(1), column(2)])
}

/// z-depth of a plane on a film point; `None` where it is behind the camera.
#[inline]
pub fn depth_of(plane: &Plane, film: Vec3) -> f32 {
    let w = plane[0] * film.x + plane[1] * film.y + plane[2];
    if w > 1e-4 { 1.0 / w } else { f32::INFINITY }
}
