//! The place of one spot from the times of its light at pixels whose ranges are known: as a
//! receiver finds itself among beacons.

use crate::{
    fit::Observed,
    model::Model,
    numeric::{V3, along, inverse, length, sub, unit},
};

/// Limits of errors, bins.
const LIMITS: [f64; 9] = [24.0, 12.0, 8.0, 4.0, 4.0, 2.0, 2.0, 1.0, 1.0];
/// Fewest times.
const FEWEST: usize = 20;
/// Distance of a return from its spot, bins and pixels, up to which it belongs to the spot.
const NEAR: (f64, f64) = (2.0, 2.5);

/// A spot that was located by its times.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Found {
    pub point: V3,
    /// Standard error of its place, metres.
    pub error: f64,
    /// Times within one bin, before and after.
    pub agreeing: [usize; 2],
}

/// Finds the place of spot `k`, whose path from the laser is straight.
pub(crate) fn locate(model: &Model, seen: &Observed, ranges: &[f64], k: usize) -> Option<Found> {
    let stated = model.beams[k]
        .point
        .filter(|_| model.beams[k].fold == 0.0)?;
    let r = seen.returns[k]?;
    let times: Vec<(V3, f64, f64)> = (0..seen.pixels.len())
        .filter_map(|n| {
            let time = seen.times[k][n].filter(|_| ranges[n].is_finite())?;
            let x = along([0.0; 3], model.ray(seen.pixels[n]), ranges[n]);
            Some((x, model.path(time.bin), time.error * model.width))
        })
        .collect();
    let error = |point: V3, (x, path, _): &(V3, f64, f64)| {
        length(sub(point, model.laser)) + length(sub(point, *x)) + length(*x) - path
    };
    let near = |point: V3| {
        let close = times.iter().filter(|t| error(point, t).abs() < model.width);
        close.count()
    };
    let solve = |mut point: V3| -> Option<(V3, f64)> {
        let mut spread = 0.0;
        for limit in LIMITS {
            let (mut m, mut r) = (vec![vec![0.0; 3]; 3], [0.0; 3]);
            let (mut squares, mut count) = (0.0, 0.0);
            for t in &times {
                let e = error(point, t);
                let rest = 1.0 - (e / (limit * model.width)).powi(2);
                if rest <= 0.0 {
                    continue;
                }
                let w = rest * rest / (t.2 * t.2);
                let (a, b) = (unit(sub(point, model.laser)), unit(sub(point, t.0)));
                let row = [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
                for i in 0..3 {
                    for j in 0..3 {
                        m[i][j] += w * row[i] * row[j];
                    }
                    r[i] -= w * row[i] * e;
                }
                squares += w * e * e;
                count += w * t.2 * t.2;
            }
            let inverse = inverse(&m)?;
            for i in 0..3 {
                let step: f64 = (0..3).map(|j| inverse[i][j] * r[j]).sum();
                point[i] += step.clamp(-0.5, 0.5);
            }
            let trace: f64 = (0..3).map(|i| inverse[i][i]).sum();
            spread = (trace * (squares / count.max(1e-300)).max(1.0)).sqrt();
        }
        Some((point, spread))
    };
    // A spot is where its return is seen, so a place away from it is wrong.
    let denied = |point: V3| {
        let late = length(sub(point, model.laser)) + length(point) - model.path(r.bin);
        let film = model.film(point).unwrap_or([f64::INFINITY; 2]);
        let u = film[0] - (r.pixel % model.columns) as f64 - 0.5;
        let v = film[1] - (r.pixel / model.columns) as f64 - 0.5;
        late.abs() > NEAR.0 * model.width || (u * u + v * v).sqrt() > NEAR.1
    };
    // From the stated place, and from where its return is seen.
    let mut starts = vec![stated];
    let ray = model.ray(r.pixel);
    if let Some(range) = model.range(ray, (model.laser, 0.0), model.path(r.bin)) {
        starts.push(along([0.0; 3], ray, range));
    }
    let mut best: Option<Found> = None;
    for (point, error) in starts.into_iter().filter_map(solve) {
        let after = near(point);
        if after >= FEWEST && !denied(point) && best.is_none_or(|b| after > b.agreeing[1]) {
            best = Some(Found {
                point,
                error,
                agreeing: [near(stated), after],
            });
        }
    }
    best
}
