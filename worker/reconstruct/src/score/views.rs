//! Scores of depth in novel views: the distance along the ray at T = 0.5 compared with the true
//! distance.

use picofarm_scene::{Camera, Intrinsics, Vec3};
use rayon::prelude::*;
use serde::Serialize;

use crate::{Measured, render::Distances, world::World};

/// The kind of surface that a pixel of a novel view sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// A surface that the measuring camera also saw.
    Visible,
    /// A surface within the measuring camera's view that an object hid.
    Occluded,
    /// A surface outside the measuring camera's view.
    Outside,
    /// A mirror anywhere.
    Specular,
    /// Nothing: the ray leaves the scene. Not included in any error.
    Open,
}

/// The errors over some pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Split {
    /// The number of pixels.
    pub pixels: u64,
    /// The mean absolute error, metres; 0 without pixels.
    pub l1_m: f64,
    /// The root mean square error, metres.
    pub rmse_m: f64,
}

/// The errors over all views.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ViewScore {
    /// The number of views.
    pub views: usize,
    /// All pixels that see a surface, except mirrors.
    pub all: Split,
    /// Pixels within the measuring camera's view.
    pub within_view: Split,
    /// See [`Class::Visible`].
    pub visible: Split,
    /// See [`Class::Occluded`].
    pub occluded: Split,
    /// Occluded pixels except floor, ceiling and wall.
    pub occluded_objects: Split,
    /// See [`Class::Outside`].
    pub outside: Split,
    /// See [`Class::Specular`].
    pub specular: Split,
    /// The number of pixels that see nothing.
    pub open_pixels: u64,
    /// The share of open pixels at which the reconstruction has a surface.
    pub open_filled: f64,
    /// The peak signal-to-noise ratio over `all`, dB.
    pub psnr_db: f64,
    /// The peak: the largest true distance, metres.
    pub psnr_range_m: f64,
}

#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    count: u64,
    /// Sums in units of 2⁻³²: the same in any order.
    absolute: u128,
    square: u128,
}

/// Least distance of a view from surfaces, metres.
const CLEAR_M: f32 = 0.25;

const UNIT: f64 = 4_294_967_296.0;

impl Sum {
    fn add(&mut self, error: f64) {
        self.count += 1;
        self.absolute += (error.abs() * UNIT) as u128;
        self.square += (error * error * UNIT) as u128;
    }

    fn join(mut self, other: Self) -> Self {
        self.count += other.count;
        self.absolute += other.absolute;
        self.square += other.square;
        self
    }

    fn split(self) -> Split {
        let n = (self.count as f64).max(1.0) * UNIT;
        Split {
            pixels: self.count,
            l1_m: self.absolute as f64 / n,
            rmse_m: (self.square as f64 / n).sqrt(),
        }
    }
}

/// Sums by class (see [`Class`]), then for occluded objects; the number of filled open pixels; the
/// largest distance.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    of: [Sum; 6],
    filled: u64,
    largest: f32,
}

impl Sums {
    fn join(mut self, other: Self) -> Self {
        for (a, b) in self.of.iter_mut().zip(other.of) {
            *a = a.join(b);
        }
        self.filled += other.filled;
        self.largest = self.largest.max(other.largest);
        self
    }
}

/// Scores a field by its depth in other views. `measured` is the measuring camera.
pub fn score_views(
    renderer: &dyn Distances,
    measured: &Camera,
    world: &World,
    views: &[Camera],
) -> ViewScore {
    let rows: Vec<(usize, u32)> = views
        .iter()
        .enumerate()
        .flat_map(|(v, c)| (0..c.intrinsics.height).map(move |row| (v, row)))
        .collect();
    let sums = rows
        .par_iter()
        .map(|&(v, row)| of_row(renderer, measured, world, &views[v], row))
        .reduce(Sums::default, Sums::join);
    let [visible, occluded, outside, specular, open, objects] = sums.of;
    let within = visible.join(occluded);
    let all = within.join(outside).split();
    let range = f64::from(sums.largest);
    ViewScore {
        views: views.len(),
        all,
        within_view: within.split(),
        visible: visible.split(),
        occluded: occluded.split(),
        occluded_objects: objects.split(),
        outside: outside.split(),
        specular: specular.split(),
        open_pixels: open.count,
        open_filled: sums.filled as f64 / (open.count as f64).max(1.0),
        psnr_db: 20.0 * libm::log10(range.max(1e-9) / all.rmse_m.max(1e-9)),
        psnr_range_m: range,
    }
}

fn of_row(
    renderer: &dyn Distances,
    measured: &Camera,
    world: &World,
    view: &Camera,
    row: u32,
) -> Sums {
    let mut stack = world.stack();
    let mut sums = Sums::default();
    let ray = |column| view.ray(column as f32 + 0.5, row as f32 + 0.5).normalized();
    let rays: Vec<Vec3> = (0..view.intrinsics.width).map(ray).collect();
    let found = renderer.distances(view.origin, &rays);
    for (&ray, found) in rays.iter().zip(found) {
        let Some(hit) = world.closest(&mut stack, view.origin, ray) else {
            sums.of[Class::Open as usize].count += 1;
            sums.filled += u64::from(found.met);
            continue;
        };
        let x = view.origin + ray * hit.range;
        let class = match () {
            () if world.is_specular(hit) => Class::Specular,
            () if !in_view(measured, x) => Class::Outside,
            () if world.sees(&mut stack, measured.origin, x) => Class::Visible,
            () => Class::Occluded,
        };
        let error = f64::from(found.or_end_m) - f64::from(hit.range);
        sums.of[class as usize].add(error);
        if class == Class::Occluded && !world.is_room(hit) {
            sums.of[5].add(error);
        }
        sums.largest = sums.largest.max(hit.range);
    }
    sums
}

/// Returns whether a position is within a camera's view, hidden or not.
fn in_view(camera: &Camera, x: Vec3) -> bool {
    let (q, i) = (camera.to_camera(x), &camera.intrinsics);
    let (u, v) = (i.fx * q.x / q.z + i.cx, i.fy * q.y / q.z + i.cy);
    q.z > 0.02 && (0.0..i.width as f32).contains(&u) && (0.0..i.height as f32).contains(&v)
}

/// Returns up to `count` views on a circle around the middle of the visible points, at the camera's
/// height and looking at that middle. The circle's radius is half the distance of the camera from
/// the middle. Views are omitted if they are within 0.25 m of a surface, inside a solid, or behind
/// a wall.
pub fn around(
    measured: &Measured,
    range: &[f32],
    world: &World,
    count: usize,
    resolution: u32,
) -> Vec<Camera> {
    let mut stack = world.stack();
    let open = |eye: Vec3| {
        !world.buried(&mut stack, eye)
            && directions().all(|d| {
                world
                    .closest(&mut stack, eye, d)
                    .is_none_or(|hit| hit.range > CLEAR_M)
            })
    };
    circle(measured, range, open, (count, resolution))
}

/// Like [`around`], but views are omitted if they are within 0.25 m of a surface of the
/// reconstruction itself: no true scene is needed.
pub fn around_unseen(
    measured: &Measured,
    range: &[f32],
    renderer: &dyn Distances,
    count: usize,
    resolution: u32,
) -> Vec<Camera> {
    let all: Vec<Vec3> = directions().collect();
    let open = |eye: Vec3| {
        let found = renderer.distances(eye, &all);
        found.iter().all(|end| !end.met || end.or_end_m > CLEAR_M)
    };
    circle(measured, range, open, (count, resolution))
}

/// Returns directions in which a view needs room.
fn directions() -> impl Iterator<Item = Vec3> {
    (0..64).map(|d| {
        let (z, turn) = ((d as f32 + 0.5) / 32.0 - 1.0, d as f32 * 2.399_963);
        let r = (1.0 - z * z).sqrt();
        Vec3::new(r * libm::cosf(turn), z, r * libm::sinf(turn))
    })
}

/// Returns the views of [`around`] whose positions are `open`.
fn circle(
    measured: &Measured,
    range: &[f32],
    mut open: impl FnMut(Vec3) -> bool,
    (count, resolution): (usize, u32),
) -> Vec<Camera> {
    let camera = &measured.camera;
    let mut far: Vec<f32> = range
        .iter()
        .copied()
        .filter(|r| r.is_finite() && *r > 0.0)
        .collect();
    far.sort_by(f32::total_cmp);
    let Some(&median) = far.get(far.len() / 2) else {
        return Vec::new();
    };
    let mut centre = camera.origin + camera.forward * (0.6 * median);
    let level = Vec3::new(camera.forward.x, 0.0, camera.forward.z);
    if level.length() > 0.1 {
        centre.y = camera.origin.y + camera.forward.y * 0.3 * median;
    }
    let fov =
        2.0 * libm::atanf(camera.intrinsics.width as f32 * 0.5 / camera.intrinsics.fx).to_degrees();
    let intrinsics = Intrinsics::from_fov(fov, resolution, resolution);
    let view = |k: usize| -> Option<Camera> {
        let angle = std::f32::consts::TAU * k as f32 / count as f32;
        let arm = Vec3::new(libm::cosf(angle), 0.0, libm::sinf(angle)) * (0.3 * median);
        let eye = Vec3::new(centre.x, camera.origin.y, centre.z) + arm;
        open(eye).then(|| Camera::look_at(eye, centre, intrinsics))
    };
    (0..count).filter_map(view).collect()
}
