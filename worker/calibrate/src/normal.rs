//! Derivatives of predicted times, and the normal equations of a calibration.

use crate::{
    fit::{error, tukey},
    model::{FOCAL, Model, SHARED, T0, WIDTH},
    numeric::{V3, along, dot, sub, unit},
    times::Time,
};

/// Derivatives of predictions with respect to the open parameters.
pub(crate) struct Rows<'a> {
    model: &'a Model,
    pub spots: Vec<(V3, f64)>,
}

impl<'a> Rows<'a> {
    pub fn new(model: &'a Model) -> Self {
        let spots = (0..model.beams.len()).map(|k| model.spot(k)).collect();
        Self { model, spots }
    }

    pub fn weigh(&self, k: usize, x: V3, time: &Time, scale: f64) -> (f64, f64) {
        let e = error(self.model, self.spots[k], x, time);
        let sigma = time.error * self.model.width;
        (e, tukey(e / scale) / (sigma * sigma))
    }

    /// Derivative of a pixel's unit ray with respect to the logarithm of the focal length.
    pub fn turn(&self, pixel: usize) -> V3 {
        let ray = self.model.ray(pixel);
        // d = (a/f, b/f, 1): its derivative is (−a/f, −b/f, 0), without the part along the ray.
        let along_film = [-ray[0], -ray[1], 0.0];
        let own = dot(along_film, ray);
        along(along_film, ray, -own)
    }

    /// Derivatives of a spot's place and path with respect to parameter `j`.
    pub fn spot(&self, k: usize, j: usize) -> (V3, f64) {
        let beam = &self.model.beams[k];
        let mut axis = [0.0; 3];
        match j {
            1..=3 => {
                axis[j - 1] = 1.0;
                match beam.point {
                    // The spot stays; the path grows as the laser leaves.
                    Some(point) => {
                        let away = unit(sub(self.model.laser, point));
                        ([0.0; 3], away[j - 1])
                    }
                    None => (axis, 0.0),
                }
            }
            _ if j == SHARED + k && beam.point.is_none() => (beam.direction, 1.0),
            _ => (axis, 0.0),
        }
    }

    pub fn two_bounce(
        &self,
        k: usize,
        away: V3,
        bin: f64,
        turn: V3,
        range: f64,
        list: &[usize],
    ) -> Vec<f64> {
        let derive = |j: &usize| match *j {
            T0 => -1.0,
            WIDTH => -self.model.width * bin,
            FOCAL => range * dot(turn, away),
            _ => {
                let (place, path) = self.spot(k, *j);
                path - dot(place, away)
            }
        };
        list.iter().map(derive).collect()
    }

    pub fn one_bounce(&self, k: usize, seen: V3, bin: f64, list: &[usize]) -> Vec<f64> {
        let derive = |j: &usize| match *j {
            T0 => -1.0,
            WIDTH => -self.model.width * bin,
            FOCAL => 0.0,
            _ => {
                let (place, path) = self.spot(k, *j);
                path + dot(place, seen)
            }
        };
        list.iter().map(derive).collect()
    }

    pub fn film(&self, k: usize, point: V3, axis: usize, list: &[usize]) -> Vec<f64> {
        let focal = self.model.lens[axis];
        let slope = point[axis] / point[2];
        let derive = |j: &usize| match *j {
            T0 | WIDTH => 0.0,
            FOCAL => focal * slope,
            _ => {
                let (place, _) = self.spot(k, *j);
                focal * (place[axis] - slope * place[2]) / point[2]
            }
        };
        list.iter().map(derive).collect()
    }
}

/// Sums of one pixel.
pub(crate) struct Block {
    matrix: Vec<Vec<f64>>,
    right: Vec<f64>,
    cross: Vec<f64>,
    own: f64,
    own_right: f64,
}

impl Block {
    pub fn new(n: usize) -> Self {
        Self {
            matrix: vec![vec![0.0; n]; n],
            right: vec![0.0; n],
            cross: vec![0.0; n],
            own: 0.0,
            own_right: 0.0,
        }
    }

    pub fn add(&mut self, row: &[f64], slope: f64, e: f64, w: f64) {
        for (i, a) in row.iter().enumerate() {
            for (m, b) in self.matrix[i].iter_mut().zip(row) {
                *m += w * a * b;
            }
            self.right[i] -= w * a * e;
            self.cross[i] += w * a * slope;
        }
        self.own += w * slope * slope;
        self.own_right -= w * slope * e;
    }
}

/// Normal equations.
pub(crate) struct Normal {
    pub matrix: Vec<Vec<f64>>,
    pub right: Vec<f64>,
    squares: f64,
    weights: f64,
    /// Variance of an error over its expectation.
    pub unit: f64,
}

impl Normal {
    pub fn new(n: usize) -> Self {
        Self {
            matrix: vec![vec![0.0; n]; n],
            right: vec![0.0; n],
            squares: 0.0,
            weights: 0.0,
            unit: 1.0,
        }
    }

    pub fn add(&mut self, row: &[f64], e: f64, w: f64) {
        for (i, a) in row.iter().enumerate() {
            for (m, b) in self.matrix[i].iter_mut().zip(row) {
                *m += w * a * b;
            }
            self.right[i] -= w * a * e;
        }
    }

    pub fn count(&mut self, e: f64, w: f64, sigma: f64) {
        self.squares += w * e * e;
        self.weights += w * sigma * sigma;
        self.unit = (self.squares / self.weights.max(1e-300)).max(1.0);
    }

    pub fn eliminate(&mut self, block: &Block) {
        if block.own <= 0.0 {
            return;
        }
        for i in 0..self.right.len() {
            for j in 0..self.right.len() {
                self.matrix[i][j] +=
                    block.matrix[i][j] - block.cross[i] * block.cross[j] / block.own;
            }
            self.right[i] += block.right[i] - block.cross[i] * block.own_right / block.own;
        }
    }
}
