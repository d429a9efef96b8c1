//! Shadows by a small learnt model over what the physics knows of a pair: boosted trees, twice. The
//! second forest sees the first one's answers around a pixel, so that masks are coherent.

use std::sync::LazyLock;

use rayon::prelude::*;

use crate::{
    forest::Forest,
    geometry::{Rays, Source},
    light::{Share, median_3x3},
    shadows::{Judged, alike},
};

/// The weights, which the example `learn` writes.
static WEIGHTS: LazyLock<Vec<Forest>> = LazyLock::new(|| {
    Forest::read(include_bytes!("learned.bin")).expect("the file is of this program")
});

/// Names of the features of a pair.
pub const FEATURES: [&str; 37] = [
    "found",
    "pooled",
    "bound",
    "others",
    "clear",
    "cosine at the spot",
    "cosine",
    "expected",
    "distance",
    "depth",
    "behind",
    "little behind",
    "outside",
    "deepest",
    "clearance",
    "first hit",
    "physics",
    "physics, smooth",
    "confidence",
    "depth range",
    "albedo",
    "bin -2",
    "bin -1",
    "bin 0",
    "bin +1",
    "bin +2",
    "left over",
    "unexplained",
    "found around",
    "mirror",
    "slow",
    "above the spot",
    "spot above",
    "lit spots",
    "behind around",
    "brightness",
    "peak",
];
/// Names of what [`Scene::around`] adds for the second forest.
pub const AROUND: [&str; 7] = [
    "log odds before",
    "log odds near",
    "log odds around",
    "share of spots that light it",
    "log odds, median",
    "light of other spots",
    "rest without other spots",
];
/// Bins from which on two spots' light does not overlap.
const OVERLAP: f32 = 2.0;

/// What the features are made of.
pub struct Scene<'a> {
    pub rays: &'a Rays,
    pub depth: &'a [f32],
    pub confidence: &'a [f32],
    pub mirror: &'a [f32],
    pub albedo: &'a [f32],
    /// Log intensity.
    pub log: &'a [f32],
    /// Width of a bin, metres.
    pub bin_m: f32,
    pub sources: &'a [Source],
    pub normals: &'a [picofarm_scene::Vec3],
    /// `[pixel][source]`.
    pub shares: &'a [Share],
    /// `[source]`, each `[pixel]`.
    pub judged: &'a [Judged],
}

impl Scene<'_> {
    /// Log intensity and albedo of the median pixel. Both are in units of the brightest bin, which
    /// depends on the size of a pixel.
    fn usual(&self) -> [f32; 2] {
        [self.log, self.albedo].map(|image| {
            let mut all = image.to_vec();
            let middle = all.len() / 2;
            *all.select_nth_unstable_by(middle, f32::total_cmp).1
        })
    }

    /// Features of all pairs of a source, `[feature][pixel]`.
    pub fn features(&self, i: usize) -> Vec<Vec<f32>> {
        let (n, pixels) = (self.sources.len(), self.rays.len());
        let mut out = vec![vec![0.0f32; pixels]; FEATURES.len()];
        let source = &self.sources[i];
        let judged = &self.judged[i];
        let [usual_log, usual_albedo] = self.usual();
        let step = self.rays.step();
        for p in 0..pixels {
            let s = &self.shares[p * n + i];
            let way = &judged.way[p];
            let x = self.rays.unit[p] * (self.depth[p] * self.rays.slant[p]);
            let off = x - source.point;
            let (mut low, mut high) = (f32::INFINITY, 0.0f32);
            let (mut found, mut behind, mut count) = (0.0, 0.0, 0.0);
            for q in around(self.rays, p, step, step) {
                low = low.min(self.depth[q]);
                high = high.max(self.depth[q]);
                if alike(self.depth, p, q) {
                    found += self.shares[q * n + i].found.min(2.0);
                    behind += judged.way[q].behind;
                    count += 1.0;
                }
            }
            let pair = &self.shares[p * n..][..n];
            let facing = pair.iter().filter(|s| s.expected > 0.0).count().max(1) as f32;
            let lit = pair
                .iter()
                .filter(|s| s.expected > 0.0 && s.found > 0.35)
                .count() as f32;
            let values = [
                s.found.min(4.0),
                s.pooled.min(4.0),
                s.bound.min(4.0),
                s.others.min(50.0),
                s.clear.min(1e3),
                s.cosines[0],
                s.cosines[1],
                s.expected,
                off.length(),
                self.depth[p],
                way.behind,
                way.little,
                way.outside,
                way.deepest,
                way.clearance,
                way.first,
                judged.logit[p],
                judged.smooth[p],
                self.confidence[p],
                (high - low) / self.depth[p],
                self.albedo[p] / usual_albedo.max(f32::MIN_POSITIVE),
                s.window[0],
                s.window[1],
                s.window[2],
                s.window[3],
                s.window[4],
                s.left,
                s.unexplained,
                found / count,
                self.mirror[p],
                s.slow,
                source.normal.dot(off),
                -self.normals[p].dot(off),
                lit / facing,
                behind / count,
                self.log[p] - usual_log,
                s.peak,
            ];
            for (out, value) in out.iter_mut().zip(values) {
                out[p] = if value.is_finite() { value } else { 0.0 };
            }
        }
        out
    }

    /// What the first forest says around the pairs of a source, `[feature][pixel]`: its log odds,
    /// their means over a small and a wide neighbourhood, the share of lit spots, a median, and the
    /// light that other spots explain.
    pub fn around(&self, i: usize, odds: &[Vec<f32>]) -> Vec<Vec<f32>> {
        let own: Vec<f32> = odds[i].iter().map(|o| o.clamp(-5.0, 5.0)).collect();
        let mean = |reach: usize, stride: usize| -> Vec<f32> {
            let of = |p: usize| {
                let (mut sum, mut count) = (0.0, 0.0);
                for q in around(self.rays, p, reach, stride) {
                    if alike(self.depth, p, q) {
                        sum += own[q];
                        count += 1.0;
                    }
                }
                sum / count
            };
            (0..own.len()).map(of).collect()
        };
        let all = (0..own.len())
            .map(|p| {
                odds.iter()
                    .map(|o| f32::from(u8::from(o[p] > 0.0)))
                    .sum::<f32>()
            })
            .map(|sum| sum / odds.len() as f32)
            .collect();
        let step = self.rays.step();
        let median = median_3x3(&own, self.rays.width, step);
        let [explained, rest] = self.explained(i, odds);
        vec![
            own.clone(),
            mean(step, step),
            mean(6 * step, 2 * step),
            all,
            median,
            explained,
            rest,
        ]
    }

    /// Light of other spots in the bins of a source's pairs if the odds are right, and what is left
    /// of the light there without it; both over what full light of the source brings.
    fn explained(&self, i: usize, odds: &[Vec<f32>]) -> [Vec<f32>; 2] {
        let n = self.sources.len();
        let of = |p: usize| {
            let pair = &self.shares[p * n..][..n];
            let own = &pair[i];
            if own.expected <= 0.0 {
                return (0.0, 0.0);
            }
            let x = self.rays.unit[p] * (self.depth[p] * self.rays.slant[p]);
            let time = self.sources[i].path(x);
            let mut others = 0.0;
            for (j, (source, share)) in self.sources.iter().zip(pair).enumerate() {
                let apart = (source.path(x) - time).abs() / self.bin_m;
                if j == i || share.expected <= 0.0 || apart >= OVERLAP {
                    continue;
                }
                let lit = 1.0 / (1.0 + libm::expf(-odds[j][p]));
                others += lit * share.expected / own.expected * (1.0 - apart / OVERLAP);
            }
            let there: f32 = own.window[1..4].iter().sum();
            (others.min(50.0), (there - others).clamp(-8.0, 8.0))
        };
        let (explained, rest) = (0..self.rays.len()).map(of).unzip();
        [explained, rest]
    }

    /// Log odds of all pairs by given forests, `[source][pixel]`, and with `keep` what the last
    /// forest sees, `[source][feature][pixel]`: how many of a feature's borders its value exceeds.
    pub fn judged(&self, forests: &[Forest], keep: bool) -> (Vec<Vec<f32>>, Vec<Vec<Vec<u8>>>) {
        let pixels = self.rays.len();
        let mut odds: Vec<Vec<f32>> = Vec::new();
        let mut seen = Vec::new();
        for forest in forests {
            let of = |i: usize| {
                let mut all = self.features(i);
                if !odds.is_empty() {
                    all.extend(self.around(i, &odds));
                }
                let seen = cut(forest, &all);
                let odds = forest.log_odds(&seen, pixels);
                (odds, if keep { seen } else { Vec::new() })
            };
            (odds, seen) = (0..self.sources.len()).into_par_iter().map(of).unzip();
        }
        (odds, seen)
    }
}

/// The forests of this crate.
pub fn forests() -> &'static [Forest] {
    &WEIGHTS
}

fn cut(forest: &Forest, features: &[Vec<f32>]) -> Vec<Vec<u8>> {
    let each = features.iter().zip(&forest.borders);
    each.map(|(values, borders)| values.iter().map(|v| Forest::cut(borders, *v)).collect())
        .collect()
}

/// Pixels around one, itself included.
fn around(rays: &Rays, p: usize, reach: usize, stride: usize) -> impl Iterator<Item = usize> {
    let (width, height) = (rays.width, rays.height);
    let (column, row) = ((p % width) as i64, (p / width) as i64);
    let (reach, stride) = (reach as i64 / stride as i64, stride as i64);
    (-reach..=reach).flat_map(move |b| {
        (-reach..=reach).filter_map(move |a| {
            let (u, v) = (column + a * stride, row + b * stride);
            let inside = u >= 0 && v >= 0 && u < width as i64 && v < height as i64;
            inside.then(|| v as usize * width + u as usize)
        })
    })
}
