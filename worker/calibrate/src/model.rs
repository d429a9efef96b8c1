//! A calibration in the camera's frame, and the times that it predicts.

use picofarm_demultiplex::{Capture, Place, Spot};
use picofarm_scene::{Camera, Intrinsics, Vec3};
use picofarm_settings::Gate;

use crate::numeric::{V3, along, dot, length, sub, unit};

/// Parameters that all spots share: t0, laser x, y, z, bin width, focal length.
pub(crate) const SHARED: usize = 6;
pub(crate) const T0: usize = 0;
pub(crate) const LASER: [usize; 3] = [1, 2, 3];
pub(crate) const WIDTH: usize = 4;
pub(crate) const FOCAL: usize = 5;

/// A beam in the camera's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Beam {
    /// Unit direction at the laser.
    pub direction: V3,
    /// Its spot, if that is stated; otherwise the spot is at `range` along the beam.
    pub point: Option<V3>,
    /// Path from the laser minus the straight line, metres: mirrors fold a beam.
    pub fold: f64,
    /// Distance from the laser along the beam, metres.
    pub range: f64,
}

/// Calibration of a capture, in the camera's frame.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Model {
    pub start: f64,
    pub width: f64,
    pub laser: V3,
    pub lens: [f64; 4],
    pub columns: usize,
    pub beams: Vec<Beam>,
}

fn local(camera: &Camera, p: Vec3) -> V3 {
    let axis = |a: Vec3| dot(p.to_f64(), a.to_f64()) - dot(camera.origin.to_f64(), a.to_f64());
    [axis(camera.right), axis(camera.down), axis(camera.forward)]
}

/// Double precision of a vector.
trait Exact {
    fn to_f64(self) -> V3;
}

impl Exact for Vec3 {
    fn to_f64(self) -> V3 {
        [self.x, self.y, self.z].map(f64::from)
    }
}

impl Model {
    pub fn new(capture: &Capture) -> Self {
        let camera = capture.camera;
        let i = &camera.intrinsics;
        let laser = local(camera, capture.laser);
        let turn = |d: Vec3| {
            let axis = |a: Vec3| dot(d.to_f64(), a.to_f64());
            unit([axis(camera.right), axis(camera.down), axis(camera.forward)])
        };
        let beams = capture.spots.iter().map(|spot| {
            let point = spot.place.map(|p| local(camera, p.point));
            let straight = point.map_or(0.0, |p| length(sub(p, laser)));
            let path = spot.place.map_or(0.0, |p| f64::from(p.path_m));
            // Single precision of a stated path is no fold.
            let fold = path - straight;
            Beam {
                direction: turn(spot.direction),
                point,
                fold: if fold > 0.3 { fold } else { 0.0 },
                range: straight,
            }
        });
        Self {
            start: capture.gate.start_m,
            width: capture.gate.bin_width_m,
            laser,
            lens: [i.fx, i.fy, i.cx, i.cy].map(f64::from),
            columns: i.width as usize,
            beams: beams.collect(),
        }
    }

    /// Optical path at a time, metres.
    pub fn path(&self, bin: f64) -> f64 {
        self.start + self.width * bin
    }

    /// A spot and the path to it from the laser, metres.
    pub fn spot(&self, k: usize) -> (V3, f64) {
        let beam = &self.beams[k];
        match beam.point {
            Some(point) => (point, length(sub(point, self.laser)) + beam.fold),
            None => (along(self.laser, beam.direction, beam.range), beam.range),
        }
    }

    /// Unit direction through the middle of a pixel.
    pub fn ray(&self, pixel: usize) -> V3 {
        let [fx, fy, cx, cy] = self.lens;
        let (u, v) = ((pixel % self.columns) as f64, (pixel / self.columns) as f64);
        unit([(u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, 1.0])
    }

    /// Film position of a point, pixels; `None` behind the camera.
    pub fn film(&self, p: V3) -> Option<[f64; 2]> {
        let [fx, fy, cx, cy] = self.lens;
        (p[2] > 1e-6).then(|| [p[0] / p[2] * fx + cx, p[1] / p[2] * fy + cy])
    }

    /// Range along a unit ray at which a two-bounce path has a length: closed form; `None` if the
    /// light would come before its spot is lit.
    pub fn range(&self, ray: V3, (point, to_spot): (V3, f64), path: f64) -> Option<f64> {
        let c = path - to_spot;
        let below = 2.0 * (c - dot(ray, point));
        let above = c * c - dot(point, point);
        (below > 1e-9 && above > 0.0).then(|| above / below)
    }

    /// Places beams without a stated spot where their returns of one bounce say.
    pub fn place_beams(&mut self, bins: &[Option<f64>]) {
        for (k, bin) in bins.iter().enumerate() {
            let beam = self.beams[k];
            let Some(path) = bin.map(|bin| self.path(bin)) else {
                continue;
            };
            // |laser + d·s| + s = path.
            let away = path * path - dot(self.laser, self.laser);
            let below = 2.0 * (path + dot(self.laser, beam.direction));
            if beam.point.is_none() && away > 0.0 && below > 1e-9 {
                self.beams[k].range = away / below;
            }
        }
    }

    /// Adds a step to the parameters: the shared ones, then the range of each beam.
    pub fn step(&mut self, step: &[f64]) {
        self.start += step[T0];
        for (x, k) in self.laser.iter_mut().zip(LASER) {
            *x += step[k];
        }
        // The gate grows about its begin.
        self.width *= 1.0 + step[WIDTH];
        self.lens[0] *= 1.0 + step[FOCAL];
        self.lens[1] *= 1.0 + step[FOCAL];
        for (beam, step) in self.beams.iter_mut().zip(&step[SHARED..]) {
            beam.range = (beam.range + step).max(0.01);
        }
    }

    /// The gate of this calibration.
    pub fn gate(&self, bins: u32) -> Gate {
        Gate {
            start_m: self.start,
            bin_width_m: self.width,
            bins,
        }
    }

    /// Intrinsics of this calibration.
    pub fn intrinsics(&self, stated: &Intrinsics) -> Intrinsics {
        Intrinsics {
            fx: self.lens[0] as f32,
            fy: self.lens[1] as f32,
            cx: self.lens[2] as f32,
            cy: self.lens[3] as f32,
            ..*stated
        }
    }

    /// The laser in world axes.
    pub fn laser(&self, camera: &Camera) -> Vec3 {
        Self::world(camera, self.laser)
    }

    /// A point of the camera's frame in world axes.
    pub fn world(camera: &Camera, p: V3) -> Vec3 {
        let axis = |k: usize| {
            let [o, r, d, f] =
                [camera.origin, camera.right, camera.down, camera.forward].map(|a| a.to_f64()[k]);
            (o + r * p[0] + d * p[1] + f * p[2]) as f32
        };
        Vec3::new(axis(0), axis(1), axis(2))
    }

    /// The beams in world axes, with their spots if `placed`.
    pub fn spots(&self, camera: &Camera, stated: &[Spot], placed: &[bool]) -> Vec<Spot> {
        let all = stated.iter().enumerate();
        all.map(|(k, stated)| {
            let (point, path) = self.spot(k);
            Spot {
                direction: stated.direction,
                place: placed[k].then(|| Place {
                    point: Self::world(camera, point),
                    path_m: path as f32,
                }),
            }
        })
        .collect()
    }
}
