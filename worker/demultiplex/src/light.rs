//! The light of one pixel shared out among the spots: what each would bring by geometry, and how
//! much of it is there.

use picofarm_scene::Vec3;
use picofarm_settings::Gate;
use rayon::prelude::*;

use crate::{
    Settings,
    geometry::{Rays, Source},
    peaks::Peaks,
};

/// Bins of the returns of one pixel and spot.
const KERNEL: usize = 8;
/// Sweeps over the spots of the non-negative least squares.
const SWEEPS: usize = 25;
/// Shares greater than this say no more.
const MOST: f32 = 1e6;
/// The most that counts of a bin over what full light brings.
const WIDE: f32 = 8.0;
/// Cosines from which on light by two bounces can be seen.
pub const CARRIES: f32 = 0.02;

/// What a spot brings to a pixel.
#[derive(Debug, Clone, Copy, Default)]
pub struct Share {
    /// cos·cos/r², 1/m²; 0 where the cosines cannot carry light or the time is outside of the gate.
    pub expected: f32,
    /// Amplitude by non-negative least squares over all spots, divided by the expected amplitude.
    pub found: f32,
    /// The same for all spots in its bins together.
    pub pooled: f32,
    /// The most that any single bin allows, likewise.
    pub bound: f32,
    /// Expected light of other spots in the same bins over its own.
    pub others: f32,
    /// Expected light over the noise of its bins.
    pub clear: f32,
    /// The share of its light in its brightest bin: a pixel's own width spreads it.
    pub peak: f32,
    /// Cosine at the spot, and at what the pixel sees.
    pub cosines: [f32; 2],
    /// Bins about its time, over the background and over what full light brings.
    pub window: [f32; 5],
    /// What all spots together leave of its bins, likewise.
    pub left: f32,
    /// Slow background in its bin, likewise.
    pub slow: f32,
    /// Share of the pixel's peaks that no spot explains.
    pub unexplained: f32,
}

/// All pixels and spots: `[pixel][source]`.
pub struct Light<'a> {
    pub histogram: &'a [f32],
    pub gate: &'a Gate,
    pub rays: &'a Rays,
    pub sources: &'a [Source],
    pub settings: &'a Settings,
}

/// A source's return in a pixel.
#[derive(Clone, Copy)]
struct Return {
    first: usize,
    kernel: [f32; KERNEL],
    /// What full light brings.
    full: f32,
}

#[derive(Default)]
struct Worker {
    peaks: Peaks,
    returns: Vec<Option<Return>>,
    rest: Vec<f32>,
    weight: Vec<f32>,
    norm: Vec<f32>,
}

impl Light<'_> {
    /// Shares of all pairs, and the relative albedo of each pixel, from ranges and normals of what
    /// pixels see.
    pub fn shares(&self, range: &[f32], normals: &[Vec3]) -> (Vec<Share>, Vec<f32>) {
        let n = self.sources.len();
        let mut shares = self.raw(range, normals);
        let mut scale = vec![1.0f32; n];
        let mut albedo = Vec::new();
        for _ in 0..3 {
            let raw: Vec<f32> = shares
                .par_chunks(n)
                .map(|shares| amplitude(shares, &scale))
                .collect();
            albedo = median_3x3(&raw, self.rays.width, self.rays.step());
            let mut bright: Vec<f32> = albedo.iter().copied().filter(|a| *a > 0.0).collect();
            let typical = quantile(&mut bright, 0.5).unwrap_or(1.0);
            let least = (1e-4 * typical).max(1e-30);
            albedo.iter_mut().for_each(|a| *a = a.max(least));
            for (i, scale) in scale.iter_mut().enumerate() {
                let lit = |p: usize| {
                    let s = &shares[p * n + i];
                    let t = s.found / albedo[p];
                    (s.expected > 0.0 && t > 0.3 * *scale).then_some(t)
                };
                let mut all: Vec<f32> = (0..albedo.len()).filter_map(lit).collect();
                let faced = (0..albedo.len()).filter(|p| shares[p * n + i].expected > 0.0);
                // A few pixels may hold light of other spots.
                if all.len() > 50 && 5 * all.len() > faced.count() {
                    *scale = quantile(&mut all, 0.5).unwrap_or(1.0).clamp(0.05, 5.0);
                }
            }
        }
        // Least squares of a column that is scaled have a solution that is scaled.
        for (shares, albedo) in shares.chunks_mut(n).zip(&albedo) {
            for (share, scale) in shares.iter_mut().zip(&scale) {
                let full = albedo * scale;
                share.found = (share.found / full).min(MOST);
                share.pooled = (share.pooled / full).min(MOST);
                share.bound = (share.bound / full).min(MOST);
                share.clear = (share.clear * full).min(MOST);
                for value in share
                    .window
                    .iter_mut()
                    .chain([&mut share.left, &mut share.slow])
                {
                    *value = (*value / full).clamp(-WIDE, WIDE);
                }
            }
        }
        (shares, albedo)
    }

    /// Shares for spots and surfaces that all reflect alike.
    fn raw(&self, range: &[f32], normals: &[Vec3]) -> Vec<Share> {
        let n = self.sources.len();
        let mut shares = vec![Share::default(); self.rays.len() * n];
        shares
            .par_chunks_mut(n * self.rays.width)
            .enumerate()
            .for_each_init(Worker::default, |worker, (row, shares)| {
                for (column, shares) in shares.chunks_mut(n).enumerate() {
                    let p = row * self.rays.width + column;
                    self.pixel(worker, p, range[p], normals[p], shares);
                }
            });
        shares
    }

    fn pixel(&self, w: &mut Worker, p: usize, range: f32, normal: Vec3, shares: &mut [Share]) {
        let bins = self.gate.bins as usize;
        let h = &self.histogram[p * bins..][..bins];
        let reach = crate::sweep::reach(self.gate, self.settings);
        w.peaks
            .background(h, reach, self.sources.len(), self.settings);
        w.rest.clear();
        w.rest
            .extend(h.iter().zip(&w.peaks.slow).map(|(h, s)| h - s));
        let noise = 0.03 * w.peaks.top;
        w.weight.clear();
        w.weight.extend(h.iter().map(|h| {
            let own = 0.1 * h;
            1.0 / (own * own + noise * noise).sqrt().max(1e-30)
        }));
        let x = self.rays.unit[p] * range;
        let (right, down) = self.footprint(p, x, normal);
        w.returns.clear();
        for (source, share) in self.sources.iter().zip(shares.iter_mut()) {
            let (mut expected, cosines) = expected(source, x, normal);
            let found = match expected > 0.0 {
                true => self.kernel(source, x, right, down),
                false => None,
            };
            if found.is_none() {
                expected = 0.0;
            }
            *share = Share {
                expected,
                cosines,
                peak: found.map_or(0.0, |(_, kernel)| {
                    kernel.iter().copied().fold(0.0, f32::max)
                }),
                ..Share::default()
            };
            w.returns.push(found.map(|(first, kernel)| Return {
                first,
                kernel,
                full: expected,
            }));
        }
        let peaks: f32 = w.rest.iter().map(|r| r.min(w.peaks.top)).sum();
        self.windows(w, x, shares);
        solve(w, shares);
        let left: f32 = w.rest.iter().map(|r| r.clamp(0.0, w.peaks.top)).sum();
        let unexplained = if peaks > 0.0 { left / peaks } else { 0.0 };
        for (share, r) in shares.iter_mut().zip(&w.returns) {
            share.unexplained = unexplained;
            if let Some(r) = r {
                let rest = r.kernel.iter().zip(&w.rest[r.first..]);
                share.left = rest.map(|(k, rest)| k * rest).sum::<f32>() / r.full;
            }
        }
    }

    /// Bins about the times of all spots, before any light is shared out.
    fn windows(&self, w: &Worker, x: Vec3, shares: &mut [Share]) {
        let per_bin = 1.0 / self.gate.bin_width_m as f32;
        for (source, share) in self.sources.iter().zip(shares) {
            if share.expected <= 0.0 {
                continue;
            }
            let time = (source.path(x) - self.gate.start_m as f32) * per_bin;
            for (n, value) in share.window.iter_mut().enumerate() {
                let bin = time as i64 + n as i64 - 2;
                let rest = usize::try_from(bin).ok().and_then(|b| w.rest.get(b));
                *value = rest.copied().unwrap_or(0.0) / share.expected;
            }
            let slow = w.peaks.slow.get(time.max(0.0) as usize);
            share.slow = slow.copied().unwrap_or(0.0) / share.expected;
        }
    }

    /// How far the seen point moves over a third of a pixel to the right and down.
    fn footprint(&self, p: usize, x: Vec3, normal: Vec3) -> (Vec3, Vec3) {
        let lens = &self.rays.lens;
        let third = |d: Vec3| {
            let film = self.rays.film(p);
            let other = film + d;
            let facing = normal.dot(other);
            let z = match facing.abs() > 1e-3 {
                true => (normal.dot(x) / facing).clamp(0.9 * x.z, 1.1 * x.z),
                false => x.z,
            };
            other * z - x
        };
        (
            third(Vec3::new(1.0 / (3.0 * lens.fx), 0.0, 0.0)),
            third(Vec3::new(0.0, 1.0 / (3.0 * lens.fy), 0.0)),
        )
    }

    /// Shares of bins that 3×3 parts of a pixel's footprint fall into; `None` outside of the gate.
    fn kernel(
        &self,
        source: &Source,
        x: Vec3,
        right: Vec3,
        down: Vec3,
    ) -> Option<(usize, [f32; KERNEL])> {
        let way = x - source.point;
        let gradient = way / way.length().max(1e-3) + x / x.length().max(1e-3);
        let (du, dv) = (gradient.dot(right), gradient.dot(down));
        let middle = source.path(x);
        let per_bin = 1.0 / self.gate.bin_width_m as f32;
        let least = middle - du.abs() - dv.abs();
        let first = ((least - self.gate.start_m as f32) * per_bin).floor();
        if !(first >= 0.0 && first + KERNEL as f32 <= self.gate.bins as f32) {
            return None;
        }
        let mut kernel = [0.0; KERNEL];
        for a in [-1.0, 0.0, 1.0] {
            for b in [-1.0, 0.0, 1.0] {
                let t = (middle + a * du + b * dv - self.gate.start_m as f32) * per_bin - first;
                kernel[(t.max(0.0) as usize).min(KERNEL - 1)] += 1.0 / 9.0;
            }
        }
        Some((first as usize, kernel))
    }
}

/// cos·cos/r² and both cosines.
pub fn expected(source: &Source, x: Vec3, normal: Vec3) -> (f32, [f32; 2]) {
    let way = x - source.point;
    let long = way.length().max(1e-3);
    let at_spot = match source.normal == Vec3::ZERO {
        true => 1.0,
        false => source.normal.dot(way) / long,
    };
    let own = match normal == Vec3::ZERO {
        true => 1.0,
        false => -normal.dot(way) / long,
    };
    let near = long.max(0.05);
    let carries = at_spot > CARRIES && own > CARRIES;
    let value = if carries {
        at_spot * own / (near * near)
    } else {
        0.0
    };
    (value, [at_spot, own])
}

/// Non-negative least squares by coordinate descent in a fixed order.
fn solve(w: &mut Worker, shares: &mut [Share]) {
    let bins = w.rest.len();
    w.norm.clear();
    for (r, share) in w.returns.iter().zip(shares.iter_mut()) {
        let Some(r) = r else {
            w.norm.push(0.0);
            continue;
        };
        let (mut norm, mut bound, mut noise) = (0.0, f32::INFINITY, 0.0);
        for (m, k) in r.kernel.iter().enumerate() {
            let b = r.first + m;
            if *k <= 0.0 || b >= bins {
                continue;
            }
            let q = k * r.full;
            norm += (q * w.weight[b]) * (q * w.weight[b]);
            noise += k / w.weight[b];
            if *k > 0.25 {
                bound = bound.min(w.rest[b].max(0.0) / q);
            }
        }
        share.bound = if bound.is_finite() {
            bound.min(MOST)
        } else {
            1.0
        };
        share.clear = r.full / noise.max(1e-30);
        w.norm.push(if norm.is_finite() { norm } else { 0.0 });
    }
    for _ in 0..SWEEPS {
        for ((r, share), norm) in w.returns.iter().zip(shares.iter_mut()).zip(&w.norm) {
            let (Some(r), true) = (r, *norm > 0.0) else {
                continue;
            };
            let mut slope = 0.0;
            for (m, k) in r.kernel.iter().enumerate() {
                if *k > 0.0 {
                    let b = r.first + m;
                    slope += k * r.full * w.weight[b] * w.weight[b] * w.rest[b];
                }
            }
            let next = (share.found + slope / norm).clamp(0.0, f32::MAX);
            let change = next - share.found;
            if change != 0.0 {
                for (m, k) in r.kernel.iter().enumerate() {
                    if *k > 0.0 {
                        w.rest[r.first + m] -= k * r.full * change;
                    }
                }
                share.found = next;
            }
        }
    }
    for i in 0..shares.len() {
        let Some(r) = w.returns[i] else { continue };
        let own: f32 = r.kernel.iter().map(|k| k * k).sum();
        let (mut others, mut there) = (0.0, shares[i].found * own * r.full);
        for (j, other) in w.returns.iter().enumerate() {
            let Some(o) = other else { continue };
            let apart = o.first as i64 - r.first as i64;
            if j == i || apart.abs() >= KERNEL as i64 {
                continue;
            }
            let mut shared = 0.0;
            for (m, k) in r.kernel.iter().enumerate() {
                let q = m as i64 - apart;
                if (0..KERNEL as i64).contains(&q) {
                    shared += k * o.kernel[q as usize];
                }
            }
            others += o.full * shared;
            there += o.full * shared * shares[j].found;
        }
        shares[i].pooled = there / (others + own * r.full).max(1e-30);
        shares[i].others = (others / (own * r.full).max(1e-30)).min(MOST);
    }
}

/// What full light amounts to in a pixel: an upper quantile over its spots, those that stand alone
/// counting more.
fn amplitude(shares: &[Share], scale: &[f32]) -> f32 {
    let mut all: Vec<(f32, f32)> = shares
        .iter()
        .zip(scale)
        .filter(|(s, _)| s.expected > 0.0)
        .map(|(s, scale)| (s.found / scale, s.expected.sqrt() / (1.0 + s.others)))
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f32 = all.iter().map(|a| a.1).sum();
    let mut sum = 0.0;
    for (value, weight) in &all {
        sum += weight;
        if sum >= 0.75 * total {
            return *value;
        }
    }
    0.0
}

fn quantile(all: &mut [f32], share: f32) -> Option<f32> {
    all.sort_by(f32::total_cmp);
    all.get((share * all.len() as f32) as usize).copied()
}

/// Median over each pixel and its eight neighbours that are `step` pixels away.
pub fn median_3x3(image: &[f32], width: usize, step: usize) -> Vec<f32> {
    let height = image.len() / width;
    let of = |p: usize| {
        let (column, row) = (p % width, p / width);
        let mut near = Vec::with_capacity(9);
        for v in [row.checked_sub(step), Some(row), Some(row + step)] {
            for u in [column.checked_sub(step), Some(column), Some(column + step)] {
                if let (Some(v), Some(u)) = (v, u)
                    && v < height
                    && u < width
                {
                    near.push(image[v * width + u]);
                }
            }
        }
        near.sort_by(f32::total_cmp);
        near[near.len() / 2]
    };
    (0..image.len()).into_par_iter().map(of).collect()
}
