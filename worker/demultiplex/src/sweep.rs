//! The plane sweep: for each pixel and each range, how many peaks stand where the spots' two-bounce
//! times would be.

use picofarm_scene::Vec3;
use picofarm_settings::Gate;
use rayon::prelude::*;

use crate::{
    Settings,
    geometry::{Rays, Source},
    peaks::Peaks,
};

/// Ranges that are tried.
#[derive(Debug, Clone, Copy)]
pub struct Ranges {
    /// The first, metres.
    pub first_m: f32,
    /// Between two, metres.
    pub step_m: f32,
    /// How many.
    pub count: usize,
}

impl Ranges {
    /// Ranges up to where the gate ends: no light that returns within it comes from beyond half its
    /// length.
    pub fn new(gate: &Gate, settings: &Settings) -> Self {
        let step_m = (settings.step_bins * gate.bin_width_m as f32).max(5e-3);
        let end = settings.farthest_m.min(0.5 * gate.end_m() as f32);
        let first_m = settings.nearest_m.min(0.25 * end).max(step_m);
        let count = ((end - first_m) / step_m).max(8.0) as usize + 1;
        Self {
            first_m,
            step_m,
            count,
        }
    }

    /// The range of a place between steps.
    pub fn at(&self, k: f32) -> f32 {
        self.first_m + k * self.step_m
    }

    /// The place between steps of a range.
    #[inline]
    pub fn place(&self, range: f32) -> f32 {
        (range - self.first_m) / self.step_m
    }
}

/// A score for each pixel and range: `[pixel][range]`.
#[derive(Debug, Clone)]
pub struct Volume {
    /// The ranges.
    pub ranges: Ranges,
    /// Scores.
    pub score: Vec<f32>,
    /// The greatest range of each pixel at which no light comes too early, metres.
    pub bound: Vec<f32>,
}

impl Volume {
    /// Scores of a pixel.
    pub fn of(&self, pixel: usize) -> &[f32] {
        &self.score[pixel * self.ranges.count..][..self.ranges.count]
    }

    /// The score between steps; −1 beyond them.
    #[inline]
    pub fn at(&self, pixel: usize, range: f32) -> f32 {
        let x = self.ranges.place(range);
        let last = self.ranges.count - 1;
        if !(x >= 0.0 && x < last as f32) {
            return -1.0;
        }
        let k = x as usize;
        let f = x - k as f32;
        let s = &self.score[pixel * self.ranges.count + k..][..2];
        s[0] + f * (s[1] - s[0])
    }
}

/// The knowledge before the sweep: the spots that may light a pixel's surface.
#[derive(Debug, Clone, Copy, Default)]
pub struct Known<'a> {
    /// Normals of what pixels see; empty = unknown.
    pub normals: &'a [Vec3],
    /// Probability that a spot lights what a pixel sees, `[pixel][source]`; empty = unknown.
    pub lit: &'a [f32],
}

/// The most by which a pulse's width brings light earlier, metres of path.
const PULSE_M: f32 = 0.15;
/// Cosine from which on a surface counts as facing a spot in full.
const FULL: f32 = 0.1;

/// The sweep.
pub fn sweep(
    histogram: &[f32],
    gate: &Gate,
    rays: &Rays,
    sources: &[Source],
    known: Known,
    settings: &Settings,
) -> Volume {
    let ranges = Ranges::new(gate, settings);
    let bins = gate.bins as usize;
    let reach = reach(gate, settings);
    let full = settings.full_score * (sources.len() as f32 / 16.0).min(1.0);
    let quiet = quiet(gate, sources);
    let mut score = vec![0.0f32; rays.len() * ranges.count];
    let mut bound = vec![0.0f32; rays.len()];
    score
        .par_chunks_mut(ranges.count * rays.width)
        .zip(bound.par_chunks_mut(rays.width))
        .enumerate()
        .for_each_init(Worker::default, |worker, (row, (out, bound))| {
            let columns = out.chunks_mut(ranges.count).zip(bound);
            for (column, (out, bound)) in columns.enumerate() {
                let p = row * rays.width + column;
                let h = &histogram[p * bins..][..bins];
                worker.peaks.find(h, reach, sources.len(), settings);
                worker.pixel(p, gate, rays, sources, known, ranges);
                level(&worker.sum, full, out);
                worker.peaks.earliest(h, settings.early_share, quiet);
                *bound = worker.bound(ranges, settings.early_bins);
            }
        });
    Volume {
        ranges,
        score,
        bound,
    }
}

/// Number of the first bins in which no light of the laser can be: every path leads by way of a
/// spot, and none from there to the camera is shorter than the straight line.
pub fn quiet(gate: &Gate, sources: &[Source]) -> usize {
    let straight = sources.iter().map(|s| s.path_m + s.square.sqrt());
    let first_m = straight.fold(f32::INFINITY, f32::min) - PULSE_M;
    ((f64::from(first_m) - gate.start_m) / gate.bin_width_m).max(0.0) as usize
}

/// Half width of the background's opening in bins.
pub fn reach(gate: &Gate, settings: &Settings) -> usize {
    let bins = f64::from(settings.slow_m) / gate.bin_width_m;
    (bins.round() as usize).clamp(2, 64)
}

#[derive(Default)]
struct Worker {
    peaks: Peaks,
    /// Bins that count already, a bit each: `[range][word]`.
    taken: Vec<u64>,
    sum: Vec<f32>,
    times: Vec<f32>,
    /// The earliest time of any spot's light, for each range.
    least: Vec<f32>,
}

impl Worker {
    /// The greatest range from which no light comes before it can: every path of any number of
    /// bounces leads by way of a spot to what the pixel sees, so that none is shorter than the
    /// least two-bounce path.
    fn bound(&self, ranges: Ranges, margin: f32) -> f32 {
        let latest = self.peaks.first as f32 + margin;
        let late = self.least.iter().position(|t| *t > latest);
        match late {
            Some(k) if k > 0 => {
                let (a, b) = (self.least[k - 1], self.least[k]);
                ranges.at(k as f32 - 1.0 + ((latest - a) / (b - a)).clamp(0.0, 1.0))
            }
            Some(_) => ranges.at(0.0),
            None => f32::INFINITY,
        }
    }

    fn pixel(
        &mut self,
        p: usize,
        gate: &Gate,
        rays: &Rays,
        sources: &[Source],
        known: Known,
        ranges: Ranges,
    ) {
        let bins = self.peaks.out.len();
        let words = bins.div_ceil(64);
        self.taken.clear();
        self.taken.resize(words * ranges.count, 0);
        self.sum.clear();
        self.sum.resize(ranges.count, 0.0);
        self.times.resize(ranges.count, 0.0);
        self.least.clear();
        self.least.resize(ranges.count, f32::INFINITY);
        let ray = rays.unit[p];
        let normal = known.normals.get(p).copied().unwrap_or(Vec3::ZERO);
        let (start, per_bin) = (gate.start_m as f32, 1.0 / gate.bin_width_m as f32);
        for (i, s) in sources.iter().enumerate() {
            let lit = known.lit.get(p * sources.len() + i).copied().unwrap_or(1.0);
            let along = 2.0 * ray.dot(s.point);
            for (k, t) in self.times.iter_mut().enumerate() {
                let r = ranges.first_m + k as f32 * ranges.step_m;
                let way = (r * r - along * r + s.square).max(0.0).sqrt();
                *t = (s.path_m + r + way - start) * per_bin - 0.5;
            }
            for (least, t) in self.least.iter_mut().zip(&self.times) {
                *least = least.min(*t);
            }
            // Cosines' signs are affine in the range.
            let (spot_a, spot_b) = (s.normal.dot(ray), s.normal.dot(s.point));
            let (own_a, own_b) = (normal.dot(ray), normal.dot(s.point));
            let (spot_known, own_known) = (s.normal != Vec3::ZERO, normal != Vec3::ZERO);
            for k in 0..ranges.count {
                let t = self.times[k];
                if !(t >= 0.0 && t < (bins - 1) as f32) {
                    continue;
                }
                let mut weight = lit;
                if spot_known || own_known {
                    let r = ranges.first_m + k as f32 * ranges.step_m;
                    let way = ((t + 0.5) / per_bin + start - s.path_m - r).max(1e-3);
                    if spot_known {
                        weight *= ((r * spot_a - spot_b) / (FULL * way)).clamp(0.0, 1.0);
                    }
                    if own_known {
                        weight *= ((own_b - r * own_a) / (FULL * way)).clamp(0.0, 1.0);
                    }
                    if weight <= 0.0 {
                        continue;
                    }
                }
                let j = t as usize;
                let f = t - j as f32;
                let nearest = j + usize::from(f >= 0.5);
                let taken = &mut self.taken[k * words + nearest / 64];
                let bit = 1u64 << (nearest % 64);
                // Spots that share a bin explain it once.
                if *taken & bit == 0 {
                    *taken |= bit;
                    let o = &self.peaks.out[j..j + 2];
                    self.sum[k] += weight * (o[0] + f * (o[1] - o[0]));
                }
            }
        }
    }
}

/// Scores over the pixel's median, as a share of the best: so that strong and weak pixels count
/// alike.
fn level(sum: &[f32], full: f32, out: &mut [f32]) {
    let mut sorted = sum.to_vec();
    let middle = sorted.len() / 2;
    let (_, median, _) = sorted.select_nth_unstable_by(middle, f32::total_cmp);
    let median = *median;
    let best = sum.iter().copied().fold(0.0f32, f32::max) - median;
    for (o, s) in out.iter_mut().zip(sum) {
        *o = (s - median) / best.max(full);
    }
}
