//! What a render would take, from a few tiles of it.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    FIRST_PASSES, GOAL, MAX_PASSES,
    draws::{Draw, likely},
    error::{Stat, median_after, passes_for, relative_median},
    image::tile_side,
    region::Region,
    tile::{Done, Frame, Order, TileRenderer},
};
use crate::{
    api::{Budget, Plan},
    film::Film,
};

/// Number of the tiles looked at along each side of the image, and their passes.
const TILES: u32 = 3;
const PASSES: u32 = 8;

/// What a render would do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// What the renderer decides for the scene.
    pub plan: Plan,
    /// Passes (camera paths per pixel) on average over the pixels; 0 where no walk is needed.
    pub passes: u32,
    /// Median per-pixel relative error that they come to; see [`crate::ErrorEstimate`].
    pub error: f32,
    /// Rays of the whole render.
    pub rays: u64,
    /// What is wrong with scene or gate, as far as it is certain beforehand; empty if nothing.
    pub warnings: Vec<String>,
}

/// Renders a few tiles with a few passes and scales up; `rays` are those of the ground truth.
pub(super) fn forecast(frame: &Frame, budget: &Budget, plan: Plan, rays: u64) -> Forecast {
    let walks = frame.walk.max_bounces >= 3 && !frame.walk.emitters.list.is_empty();
    let side = |n: u32| f64::from(frame.sampling.sides(n).0);
    let all = f64::from(frame.width) * f64::from(frame.height);
    if !walks {
        let found = look(frame, 0);
        return Forecast {
            plan,
            passes: 0,
            error: {
                let stats = found.tiles.concat();
                let likely = likely(&stats, &found.draws, 0.5);
                (likely * relative_median(stats.into_iter())) as f32
            },
            rays: rays + (found.rays * all) as u64,
            warnings: vec![],
        };
    }
    let (one, found) = (look(frame, 1), look(frame, PASSES));
    let two = |n: u32| frame.sampling.variance(n);
    let stats = found.tiles.concat();
    let likely = likely(&stats, &found.draws, 0.5);
    let (passes, error) = match *budget {
        Budget::Samples(n) => (n, median_after(&stats, PASSES, n, &two)),
        Budget::Error(target) => {
            let target = (target / likely) as f32;
            // As `further` shares them out.
            let most = (FIRST_PASSES, MAX_PASSES);
            let n = passes_for(&stats, PASSES, GOAL * target, most, two);
            let own = (FIRST_PASSES.max(n / 2), (2 * n).min(MAX_PASSES));
            let tiles = found.tiles.iter();
            let spent = tiles.map(|t| passes_for(t, PASSES, GOAL * target, own, two));
            let mean = spent.sum::<u32>().div_ceil(found.tiles.len() as u32);
            (mean, median_after(&stats, PASSES, n, &two))
        }
    };
    // Rays of a pixel: two bounces take side² times something, and each pass takes the same.
    let (s1, s8) = (side(1).powi(2), side(PASSES).powi(2));
    let eight = f64::from(PASSES);
    let of_two = ((eight * one.rays - found.rays) / (eight * s1 - s8)).clamp(0.0, found.rays / s8);
    let of_pass = (found.rays - of_two * s8) / eight;
    let of_pixel = of_two * side(passes).powi(2) + of_pass * f64::from(passes);
    Forecast {
        plan,
        passes,
        error: (likely * error) as f32,
        rays: rays + (of_pixel * all) as u64,
        warnings: vec![],
    }
}

/// What was found in the tiles looked at.
struct Found {
    /// The pixels of each.
    tiles: Vec<Vec<Stat>>,
    /// Draws of the errors of some of them, by their place in all tiles together.
    draws: Vec<(usize, Draw)>,
    /// Rays of one pixel.
    rays: f64,
}

/// One of them.
struct Looked {
    stats: Vec<Stat>,
    /// By pixel of the tile.
    draws: Vec<(usize, Draw)>,
    rays: u64,
}

/// The tiles looked at.
pub(super) fn regions(frame: &Frame) -> Vec<Region> {
    // As wide as the image's own: the more pixels share vertices, the smaller is their error.
    let widest = tile_side(frame);
    let starts = |length: u32| -> Vec<u32> {
        let side = widest.min(length);
        let count = TILES.min(length / side);
        let middle = |i| length * (2 * i + 1) / (2 * count);
        (0..count)
            .map(|i| middle(i).saturating_sub(side / 2).min(length - side))
            .collect()
    };
    let columns = starts(frame.width);
    starts(frame.height)
        .into_iter()
        .flat_map(|row| {
            columns.iter().map(move |&col| Region {
                row,
                col,
                rows: widest.min(frame.height),
                cols: widest.min(frame.width),
            })
        })
        .collect()
}

fn look(frame: &Frame, passes: u32) -> Found {
    let regions = regions(frame);
    let pixels: usize = regions.iter().map(Region::pixels).sum();
    // Passes from the far end of the range: the render's own would be no forecast.
    let order = Order {
        first: u32::MAX - PASSES,
        count: passes,
    };
    let found: Vec<Looked> = regions
        .into_par_iter()
        .map_init(
            || TileRenderer::new(frame),
            |renderer, region| {
                renderer
                    .render(frame, &region, &order, &|_| true)
                    .expect("nobody stops it");
                let stats = (0..region.pixels()).map(|k| stat(&renderer.done, frame.film, k));
                let pixels = renderer.done.watched().iter().copied();
                Looked {
                    stats: stats.collect(),
                    draws: pixels.zip(renderer.done.draws()).collect(),
                    rays: renderer.done.rays,
                }
            },
        )
        .collect();
    let (mut draws, mut before) = (vec![], 0);
    for tile in &found {
        draws.extend(tile.draws.iter().map(|&(k, draw)| (before + k, draw)));
        before += tile.stats.len();
    }
    Found {
        draws,
        rays: found.iter().map(|f| f.rays).sum::<u64>() as f64 / pixels as f64,
        tiles: found.into_iter().map(|f| f.stats).collect(),
    }
}

/// A pixel's sums, in render units: only their ratios count.
fn stat(done: &Done, film: &Film, k: usize) -> Stat {
    let mut stat = Stat::default();
    for slot in 1..film.slots - 1 {
        let m = done.moments(film, k, slot);
        let h = m.two + m.multi;
        stat.norm2 += h * h;
        stat.total += h;
        stat.two_variance += m.two_variance;
        stat.multi_variance += m.multi_variance;
    }
    stat
}
