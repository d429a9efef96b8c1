//! Pixels that see two surfaces: which of them fills more of the pixel. Such a pixel's histogram is
//! a mixture of the histograms on both sides of the edge, so that one share is left to find.

use rayon::prelude::*;

use crate::{
    geometry::{Rays, depth_of},
    planes::Slants,
};

/// Share of depth that makes an edge.
const LEAP: f32 = 0.04;
/// Farthest pixel that may stand for a side.
const REACH: usize = 2;
/// Bins over which a histogram is smoothed each way: times differ a little between neighbours.
const SMOOTH: usize = 2;
/// Share of the front surface below which a pixel sees the one behind. The light of the front comes
/// first, so that the method tends to the front by itself.
const FRONT: f64 = 0.35;
/// Which greatest bin is the most that counts: one-bounce returns are no mixture.
const RANK: usize = 3;

/// The histograms.
pub struct Unmix<'a> {
    pub rays: &'a Rays,
    pub histogram: &'a [f32],
    pub bins: usize,
}

impl Unmix<'_> {
    /// Gives pixels at an edge the surface behind, where that fills most of them.
    pub fn apply(&self, slants: &mut Slants) {
        let rays = self.rays;
        let depth: Vec<f32> = (0..rays.len()).map(|p| slants.depth(rays, p)).collect();
        let pure: Vec<bool> = (0..rays.len())
            .map(|p| self.near(p, 1).all(|q| alike(depth[p], depth[q])))
            .collect();
        let side = |p: usize, wanted: &dyn Fn(f32) -> bool| {
            self.near(p, REACH)
                .filter(|q| pure[*q] && wanted(depth[*q]))
                .min_by_key(|q| (self.apart(p, *q), *q))
        };
        let found: Vec<Option<usize>> = (0..rays.len())
            .into_par_iter()
            .map_init(Vec::new, |_: &mut Vec<f32>, p| {
                if pure[p] {
                    return None;
                }
                let all = || self.near(p, REACH).filter(|q| pure[*q]);
                let nearest = all().map(|q| depth[q]).fold(f32::INFINITY, f32::min);
                let farthest = all().map(|q| depth[q]).fold(0.0, f32::max);
                if alike(nearest, farthest) || farthest <= nearest {
                    return None;
                }
                let front = side(p, &|z| alike(z, nearest))?;
                let back = side(p, &|z| alike(z, farthest))?;
                let (mut above, mut below) = (0.0f64, 0.0f64);
                let [h, f, b] = [p, front, back].map(|q| self.smooth(q));
                for k in 0..self.bins {
                    let step = f64::from(f[k] - b[k]);
                    above += f64::from(h[k] - b[k]) * step;
                    below += step * step;
                }
                (above < FRONT * below).then_some(back)
            })
            .collect();
        let planes = slants.plane.clone();
        for (p, from) in found.into_iter().enumerate() {
            let Some(q) = from else { continue };
            let z = depth_of(&planes[q], rays.film(p));
            if alike(z, depth[q]) {
                slants.plane[p] = planes[q];
            }
        }
    }

    fn near(&self, p: usize, reach: usize) -> impl Iterator<Item = usize> {
        let (width, height) = (self.rays.width, self.rays.height);
        let (column, row) = (p % width, p / width);
        let rows = row.saturating_sub(reach)..(row + reach + 1).min(height);
        rows.flat_map(move |v| {
            let columns = column.saturating_sub(reach)..(column + reach + 1).min(width);
            columns.map(move |u| v * width + u)
        })
    }

    fn apart(&self, p: usize, q: usize) -> usize {
        let width = self.rays.width;
        let along = (p % width).abs_diff(q % width);
        let across = (p / width).abs_diff(q / width);
        along * along + across * across
    }

    /// A pixel's histogram without its strongest bins, smoothed.
    fn smooth(&self, p: usize) -> Vec<f32> {
        let h = &self.histogram[p * self.bins..][..self.bins];
        let mut sorted = h.to_vec();
        let rank = RANK.clamp(1, h.len()) - 1;
        let top = *sorted.select_nth_unstable_by(rank, |a, b| b.total_cmp(a)).1;
        let value = |k: usize| h[k].min(top);
        (0..self.bins)
            .map(|k| {
                let part = k.saturating_sub(SMOOTH)..(k + SMOOTH + 1).min(self.bins);
                part.map(value).sum()
            })
            .collect()
    }
}

fn alike(a: f32, b: f32) -> bool {
    (a - b).abs() <= LEAP * a.min(b)
}
