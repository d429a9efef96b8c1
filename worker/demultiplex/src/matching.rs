//! Semi-global matching (Hirschmüller, CVPR 2005): ranges that agree with the scores along eight
//! directions of the image.

use rayon::prelude::*;

use crate::{Settings, geometry::Rays, sweep::Volume};

/// Differences of log intensity across which a leap costs half.
const EDGE: f32 = 0.2;
/// Least share of a leap's cost across an edge.
const LEAST: f32 = 0.2;

/// How much a leap costs at each pixel: less where the intensity changes.
pub fn edges(rays: &Rays, intensity: &[f32]) -> Vec<f32> {
    let log: Vec<f32> = intensity.iter().map(|x| libm::logf(x.max(1e-30))).collect();
    (0..rays.len())
        .map(|p| {
            let (column, row) = (p % rays.width, p / rays.width);
            let dx = if column > 0 {
                (log[p] - log[p - 1]).abs()
            } else {
                0.0
            };
            let dy = if row > 0 {
                (log[p] - log[p - rays.width]).abs()
            } else {
                0.0
            };
            (1.0 / (1.0 + dx.max(dy) / EDGE)).max(LEAST)
        })
        .collect()
}

/// Aggregated costs and the best place between steps of each pixel, with how far its cost is below
/// the best one elsewhere.
pub fn best(rays: &Rays, volume: &Volume, edges: &[f32], settings: &Settings) -> Vec<f32> {
    let count = volume.ranges.count;
    let mut sum = vec![0.0f32; volume.score.len()];
    for (dx, dy) in [
        (1, 0),
        (-1, 0),
        (0, 1),
        (0, -1),
        (1, 1),
        (-1, -1),
        (1, -1),
        (-1, 1),
    ] {
        match dy {
            0 => along_rows(rays, volume, edges, dx, &mut sum, settings),
            _ => across_rows(rays, volume, edges, (dx, dy), &mut sum, settings),
        }
    }
    sum.par_chunks(count).map(lowest).collect()
}

fn along_rows(
    rays: &Rays,
    volume: &Volume,
    edges: &[f32],
    dx: i64,
    sum: &mut [f32],
    settings: &Settings,
) {
    let (count, width) = (volume.ranges.count, rays.width);
    sum.par_chunks_mut(count * width)
        .enumerate()
        .for_each(|(row, sum)| {
            let mut last = vec![0.0; count];
            let mut next = vec![0.0; count];
            for n in 0..width {
                let column = if dx > 0 { n } else { width - 1 - n };
                let p = row * width + column;
                let before = (n > 0).then_some(&last[..]);
                step(volume.of(p), before, edges[p], settings, &mut next);
                add(&mut sum[column * count..][..count], &next);
                std::mem::swap(&mut last, &mut next);
            }
        });
}

fn across_rows(
    rays: &Rays,
    volume: &Volume,
    edges: &[f32],
    (dx, dy): (i64, i64),
    sum: &mut [f32],
    settings: &Settings,
) {
    let (count, width, height) = (volume.ranges.count, rays.width, rays.height);
    let mut last = vec![0.0; count * width];
    let mut next = vec![0.0; count * width];
    for n in 0..height {
        let row = if dy > 0 { n } else { height - 1 - n };
        let sum = &mut sum[row * width * count..][..width * count];
        sum.par_chunks_mut(count)
            .zip(next.par_chunks_mut(count))
            .enumerate()
            .for_each(|(column, (sum, next))| {
                let from = column as i64 - dx;
                let there = n > 0 && from >= 0 && from < width as i64;
                let before = there.then(|| &last[from as usize * count..][..count]);
                let p = row * width + column;
                step(volume.of(p), before, edges[p], settings, next);
                add(sum, next);
            });
        std::mem::swap(&mut last, &mut next);
    }
}

fn add(sum: &mut [f32], more: &[f32]) {
    for (s, m) in sum.iter_mut().zip(more) {
        *s += m;
    }
}

/// Costs of a path's pixel from those of the pixel before.
fn step(score: &[f32], before: Option<&[f32]>, edge: f32, settings: &Settings, out: &mut [f32]) {
    let Some(before) = before else {
        for (o, s) in out.iter_mut().zip(score) {
            *o = -s;
        }
        return;
    };
    let (one, two) = (settings.step_cost, 2.0 * settings.step_cost);
    let least = before.iter().copied().fold(f32::INFINITY, f32::min);
    let leap = least + settings.leap_cost * edge;
    let n = score.len();
    let reach = |k: usize| {
        let mut v = before[k].min(leap);
        if k > 0 {
            v = v.min(before[k - 1] + one);
        }
        if k + 1 < n {
            v = v.min(before[k + 1] + one);
        }
        if k > 1 {
            v = v.min(before[k - 2] + two);
        }
        if k + 2 < n {
            v = v.min(before[k + 2] + two);
        }
        v
    };
    for k in [0, 1, n - 2, n - 1] {
        out[k] = reach(k) - score[k] - least;
    }
    for k in 2..n - 2 {
        let near = (before[k - 1].min(before[k + 1])) + one;
        let far = (before[k - 2].min(before[k + 2])) + two;
        out[k] = before[k].min(leap).min(near).min(far) - score[k] - least;
    }
}

/// The place of the least cost, between steps.
fn lowest(cost: &[f32]) -> f32 {
    let mut k = 0;
    for (n, c) in cost.iter().enumerate() {
        if *c < cost[k] {
            k = n;
        }
    }
    let k = k.clamp(1, cost.len() - 2);
    let (a, b, c) = (cost[k - 1], cost[k], cost[k + 1]);
    let off = 0.5 * (a - c) / (a - 2.0 * b + c).max(1e-6);
    k as f32 + off.clamp(-0.5, 0.5)
}
