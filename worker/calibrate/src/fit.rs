//! Robust least squares of a calibration: Gauss-Newton over shared parameters and the ranges of
//! beams, with the range of each pixel eliminated.

use crate::{
    model::{FOCAL, LASER, Model, SHARED, T0, WIDTH},
    normal::{Block, Normal, Rows},
    numeric::{V3, along, dot, inverse, length, median, sub, unit},
    pulse::Return,
    times::Time,
};

/// Limits of errors, bins, beyond which a time does not count; the first ones are wide so that a
/// wrong start is left.
const LIMITS: [f64; 12] = [16.0, 8.0, 8.0, 4.0, 4.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0];
/// Limit, bins, from which on times say more of a laser's place than the pixels of returns do.
const FILM_LIMIT: f64 = 1.5;
/// Bounds of the standard error of a return's time, bins. It follows from the returns' own scatter,
/// because some captures put a return in the middle of its bin.
const RETURN_BINS: [f64; 2] = [0.05, 0.3];
/// Standard error of a return's place, pixels.
const RETURN_PIXELS: f64 = 0.3;
/// Least range of a pixel, metres.
const NEAREST_M: f64 = 0.05;

/// What was observed.
#[derive(Debug, Clone)]
pub(crate) struct Observed {
    /// Pixels that take part.
    pub pixels: Vec<usize>,
    /// Times `[spot][pixel of the list]`.
    pub times: Vec<Vec<Option<Time>>>,
    /// Returns of one bounce.
    pub returns: Vec<Option<Return>>,
}

/// Which parameters are estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Free {
    /// The laser's x, y and z.
    pub laser: [bool; 3],
    pub width: bool,
    pub focal: bool,
}

impl Free {
    pub const T0: Self = Self {
        laser: [false; 3],
        width: false,
        focal: false,
    };
    pub const LASER: Self = Self {
        laser: [true; 3],
        ..Self::T0
    };
}

/// A fitted calibration.
#[derive(Debug, Clone)]
pub(crate) struct Fitted {
    pub model: Model,
    /// Range of each pixel of the list, metres; NaN where unknown.
    pub ranges: Vec<f64>,
    /// Standard errors of the shared parameters; 0 where held.
    pub errors: [f64; SHARED],
    /// Correlation of t0 with the laser's three coordinates: the greatest magnitude.
    pub tied: f64,
    /// Share of the times within one bin of the prediction.
    pub agreeing: f64,
    /// Root mean square of the agreeing times' distances, metres of path.
    pub rms_m: f64,
}

/// The weight of an error of `x` limits: Tukey's.
pub(crate) fn tukey(x: f64) -> f64 {
    let rest = 1.0 - x * x;
    if rest > 0.0 { rest * rest } else { 0.0 }
}

/// Error of a time, metres: prediction minus observation.
pub(crate) fn error(model: &Model, spot: (V3, f64), x: V3, time: &Time) -> f64 {
    spot.1 + length(sub(spot.0, x)) + length(x) - model.path(time.bin)
}

impl Observed {
    /// The same with at most `most` pixels.
    pub fn thinned(&self, most: usize) -> Self {
        let step = self.pixels.len().div_ceil(most).max(1);
        Self {
            pixels: self.pixels.iter().copied().step_by(step).collect(),
            times: self
                .times
                .iter()
                .map(|t| t.iter().copied().step_by(step).collect())
                .collect(),
            returns: self.returns.clone(),
        }
    }

    fn time(&self, spot: usize, n: usize) -> Option<Time> {
        self.times[spot][n]
    }

    /// The range of each pixel that most times agree on.
    pub fn ranges(&self, model: &Model, limit: f64) -> Vec<f64> {
        let spots: Vec<(V3, f64)> = (0..self.times.len()).map(|k| model.spot(k)).collect();
        (0..self.pixels.len())
            .map(|n| {
                let ray = model.ray(self.pixels[n]);
                let own: Vec<(usize, Time)> = (0..spots.len())
                    .filter_map(|k| self.time(k, n).map(|t| (k, t)))
                    .collect();
                let mut best = (f64::NAN, 0.0);
                for (k, time) in &own {
                    let found = model.range(ray, spots[*k], model.path(time.bin));
                    let Some(range) = found.filter(|r| *r > NEAREST_M) else {
                        continue;
                    };
                    let x = along([0.0; 3], ray, range);
                    let score: f64 = own
                        .iter()
                        .map(|(j, t)| {
                            let off = error(model, spots[*j], x, t) / model.width;
                            tukey(off / limit)
                        })
                        .sum();
                    if score > best.1 {
                        best = (range, score);
                    }
                }
                best.0
            })
            .collect()
    }

    /// Fits a calibration, beginning from `start`.
    pub fn fit(&self, start: &Model, free: Free) -> Fitted {
        let mut model = start.clone();
        let bins: Vec<Option<f64>> = self.returns.iter().map(|r| r.map(|r| r.bin)).collect();
        model.place_beams(&bins);
        let count = SHARED + model.beams.len();
        let mut open = vec![false; count];
        open[T0] = true;
        (0..3).for_each(|a| open[LASER[a]] = free.laser[a]);
        open[WIDTH] = free.width;
        open[FOCAL] = free.focal;
        for (k, beam) in model.beams.iter().enumerate() {
            open[SHARED + k] = beam.point.is_none() && bins[k].is_some();
        }
        let list: Vec<usize> = (0..count).filter(|k| open[*k]).collect();
        let mut covariance = None;
        for (round, limit) in LIMITS.iter().enumerate() {
            let mut ranges = self.ranges(&model, *limit);
            let normal = self.normal(&model, &mut ranges, *limit, &list);
            let Some(inverse) = inverse(&normal.matrix) else {
                covariance = None;
                break;
            };
            let mut step = vec![0.0; count];
            for (i, k) in list.iter().enumerate() {
                let sum: f64 = inverse[i]
                    .iter()
                    .zip(&normal.right)
                    .map(|(a, b)| a * b)
                    .sum();
                // A wrong start must not throw the fit out of its valley.
                step[*k] = sum.clamp(-0.3, 0.3);
            }
            model.step(&step);
            if round + 1 == LIMITS.len() {
                covariance = Some((inverse, normal.unit));
            }
        }
        let mut errors = [0.0; SHARED];
        let mut tied = 0.0f64;
        if let Some((inverse, unit)) = &covariance {
            for (i, k) in list.iter().enumerate().filter(|(_, k)| **k < SHARED) {
                errors[*k] = (inverse[i][i] * unit).sqrt();
                if LASER.contains(k) {
                    let both = (inverse[i][i] * inverse[0][0]).sqrt();
                    tied = tied.max((inverse[0][i] / both).abs());
                }
            }
        }
        self.judged(model, errors, tied)
    }

    /// The same calibration, unchanged, with its residuals.
    pub fn judged(&self, model: Model, errors: [f64; SHARED], tied: f64) -> Fitted {
        let ranges = self.ranges(&model, 1.0);
        let mut off: Vec<f64> = Vec::new();
        for k in 0..self.times.len() {
            off.extend(self.residuals(&model, &ranges, k).iter().flatten());
        }
        let near: Vec<f64> = off
            .iter()
            .copied()
            .filter(|e| e.abs() < model.width)
            .collect();
        let squares = near.iter().fold(0.0, |sum, e| sum + e * e);
        let all = self.times.iter().flatten().flatten().count().max(1);
        let agreeing = near.len() as f64 / all as f64;
        let rms_m = (squares / near.len().max(1) as f64).sqrt();
        Fitted {
            ranges,
            errors,
            tied,
            agreeing,
            rms_m,
            model,
        }
    }

    /// Prediction minus observation of one spot's times, metres.
    pub fn residuals(&self, model: &Model, ranges: &[f64], spot: usize) -> Vec<Option<f64>> {
        let place = model.spot(spot);
        (0..self.pixels.len())
            .map(|n| {
                let time = self.time(spot, n).filter(|_| ranges[n].is_finite())?;
                let x = along([0.0; 3], model.ray(self.pixels[n]), ranges[n]);
                Some(error(model, place, x, &time))
            })
            .collect()
    }

    fn normal(&self, model: &Model, ranges: &mut [f64], limit: f64, list: &[usize]) -> Normal {
        let mut normal = Normal::new(list.len());
        let rows = Rows::new(model);
        let scale = model.width * limit;
        for (n, range) in ranges.iter_mut().enumerate() {
            if !range.is_finite() {
                continue;
            }
            let ray = model.ray(self.pixels[n]);
            let turn = rows.turn(self.pixels[n]);
            // Two steps to the best range under these weights.
            for _ in 0..2 {
                let x = along([0.0; 3], ray, *range);
                let (mut up, mut down) = (0.0, 0.0);
                for k in 0..self.times.len() {
                    let Some(time) = self.time(k, n) else {
                        continue;
                    };
                    let (e, w) = rows.weigh(k, x, &time, scale);
                    let slope = 1.0 + dot(ray, unit(sub(x, rows.spots[k].0)));
                    up += w * e * slope;
                    down += w * slope * slope;
                }
                if down > 0.0 {
                    *range = (*range - up / down).max(NEAREST_M);
                }
            }
            let x = along([0.0; 3], ray, *range);
            let mut block = Block::new(list.len());
            for k in 0..self.times.len() {
                let Some(time) = self.time(k, n) else {
                    continue;
                };
                let (e, w) = rows.weigh(k, x, &time, scale);
                if w > 0.0 {
                    let away = unit(sub(x, rows.spots[k].0));
                    let slope = 1.0 + dot(ray, away);
                    let row = rows.two_bounce(k, away, time.bin, turn, *range, list);
                    block.add(&row, slope, e, w);
                    normal.count(e, w, time.error * model.width);
                }
            }
            normal.eliminate(&block);
        }
        let late: Vec<Option<f64>> = (0..self.returns.len())
            .map(|k| {
                let (point, to_spot) = rows.spots[k];
                self.returns[k].map(|r| to_spot + length(point) - model.path(r.bin))
            })
            .collect();
        let mut sizes: Vec<f64> = late.iter().flatten().map(|e| e.abs()).collect();
        let scatter = 1.48 * median(&mut sizes).unwrap_or(0.0) / model.width;
        let error = scatter.clamp(RETURN_BINS[0], RETURN_BINS[1]) * model.width;
        for (k, r) in self.returns.iter().enumerate() {
            let (Some(r), Some(e)) = (r, late[k]) else {
                continue;
            };
            let (point, _) = rows.spots[k];
            let w = tukey(e / (scale + 3.0 * error)) / (error * error);
            let row = rows.one_bounce(k, unit(point), r.bin, list);
            normal.add(&row, e, w);
            if let Some(film) = model
                .film(point)
                .filter(|_| limit > FILM_LIMIT || list.contains(&FOCAL))
            {
                let seen = [r.pixel % model.columns, r.pixel / model.columns];
                let off = [0, 1].map(|a| film[a] - (seen[a] as f64 + 0.5));
                let far = (off[0] * off[0] + off[1] * off[1]).sqrt() / (3.0 + limit);
                let w = tukey(far) / (RETURN_PIXELS * RETURN_PIXELS);
                for (axis, off) in off.iter().enumerate() {
                    let row = rows.film(k, point, axis, list);
                    normal.add(&row, *off, w);
                }
            }
        }
        normal
    }
}
