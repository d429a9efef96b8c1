//! Forecasts the cost and error of a render from a few of its tiles.

use std::collections::HashMap;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    api::{Budget, Plan, RenderError, Stop, Unstopped},
    film::{slots::Film, splat::Splat},
    render::{
        done::Done,
        draws::{Draw, joined, likely},
        error::{median_after, passes_for},
        frame::{Frame, unit},
        image::tile_side,
        layer::Layer,
        region::Region,
        rounds::{FIRST_PASSES, MAX_PASSES, TWO_PASSES},
        sources::Sources,
        stat::{Stat, relative_median},
        thin::Thin,
        tile::{Order, TileRenderer},
        watch::Watch,
    },
};

/// The number of sampled tiles along each side of the image, and their passes.
const TILES: u32 = 3;
const PASSES: u32 = 8;

/// The forecast of a render.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// The renderer's decisions for the scene.
    pub plan: Plan,
    /// Passes (camera paths per pixel); 0 if no walk is needed.
    pub passes: u32,
    /// Median per-pixel relative error after these passes; see [`crate::ErrorEstimate`].
    pub error: f32,
    /// Rays of the whole render.
    pub rays: u64,
    /// Warnings about the scene or gate that are certain beforehand; empty if there are none.
    pub warnings: Vec<String>,
}

/// Renders a few tiles with a few passes, and enough light paths to estimate their contribution to
/// those tiles, and scales up. `rays` is the number of rays of the ground truth.
///
/// # Errors
/// Returns [`RenderError::Memory`] if an allocation fails.
pub(crate) fn forecast(
    frame: &Frame,
    budget: &Budget,
    plan: Plan,
    rays: u64,
) -> Result<Forecast, RenderError> {
    let walks = frame.walk.max_bounces >= 3 && !frame.walk.emitters.list.is_empty();
    let side = |n: u32| f64::from(frame.sampling.sides(n).0);
    let all = f64::from(frame.width) * f64::from(frame.height);
    if !walks {
        let mut found = look(frame, 0);
        let drawn_rays = drawn(frame, &mut found, TWO_PASSES)?;
        let rays = rays + (found.rays * all) as u64;
        return Ok(Forecast {
            plan,
            passes: 0,
            error: {
                let stats = found.stats();
                let likely = likely(&stats, &found.draws(), 0.5);
                (likely * relative_median(stats.into_iter())) as f32
            },
            rays: rays + drawn_rays * u64::from(TWO_PASSES),
            warnings: vec![],
        });
    }
    let (one, mut found) = (look(frame, 1), look(frame, PASSES));
    let drawn_rays = drawn(frame, &mut found, PASSES)?;
    let two = |n: u32| frame.sampling.variance(n);
    let stats = found.stats();
    let likely = likely(&stats, &found.draws(), 0.5);
    let (passes, error) = match *budget {
        Budget::Samples(n) => (n, median_after(&stats, PASSES, n, &two)),
        Budget::Error(target) => {
            let target = (target / likely) as f32;
            let range = (FIRST_PASSES, MAX_PASSES);
            let n = passes_for(&stats, PASSES, target, range, two);
            (n, median_after(&stats, PASSES, n, &two))
        }
    };
    // Rays of a pixel: two bounces take a constant times side², and all passes take the same
    // number.
    let (s1, s8) = (side(1).powi(2), side(PASSES).powi(2));
    let eight = f64::from(PASSES);
    let of_two = ((eight * one.rays - found.rays) / (eight * s1 - s8)).clamp(0.0, found.rays / s8);
    let of_pass = (found.rays - of_two * s8) / eight;
    let of_pixel = of_two * side(passes).powi(2) + of_pass * f64::from(passes);
    let drawn = drawn_rays * u64::from(passes);
    Ok(Forecast {
        plan,
        passes,
        error: (likely * error) as f32,
        rays: rays + (of_pixel * all) as u64 + drawn,
        warnings: vec![],
    })
}

/// The results of the sampled tiles.
struct Found {
    pub regions: Vec<Region>,
    pub tiles: Vec<Looked>,
    /// Rays of one pixel.
    pub rays: f64,
}

/// The result of one tile.
struct Looked {
    /// h by pixel and bin.
    light: Vec<f32>,
    stats: Vec<Stat>,
    /// Draws by pixel of the tile.
    draws: Vec<(usize, Draw)>,
    rays: u64,
}

impl Found {
    pub fn stats(&self) -> Vec<Stat> {
        self.tiles.iter().flat_map(|t| &t.stats).copied().collect()
    }

    /// Returns draws of the errors of some pixels, by their index in all tiles together.
    pub fn draws(&self) -> Vec<(usize, Draw)> {
        let (mut draws, mut before) = (vec![], 0);
        for tile in &self.tiles {
            draws.extend(tile.draws.iter().map(|&(k, draw)| (before + k, draw)));
            before += tile.stats.len();
        }
        draws
    }
}

/// Returns the sampled tiles.
pub(crate) fn regions(frame: &Frame) -> Vec<Region> {
    // The regions are as wide as the image's own tiles, because the error decreases with the number
    // of pixels that share vertices.
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
    // Passes from the far end of the range, because with the render's own passes the result would
    // not be a forecast.
    let order = Order {
        first: u32::MAX - PASSES,
        count: passes,
        two: true,
    };
    let found: Vec<Looked> = regions
        .par_iter()
        .map_init(
            || TileRenderer::new(frame),
            |renderer, region| {
                renderer
                    .render(frame, region, &order, &|_| true)
                    .expect("nobody stops it");
                let stats = (0..region.pixels()).map(|k| stat(&renderer.done, frame.film, k));
                let pixels = renderer.done.watched().iter().copied();
                let slots = 1..frame.film.slots - 1;
                let light = (0..region.pixels()).flat_map(|k| {
                    let h = |slot| {
                        let m = renderer.done.moments(frame.film, k, slot);
                        (m.two + m.multi) as f32
                    };
                    slots.clone().map(h).collect::<Vec<f32>>()
                });
                let of_two = renderer.done.two_draws();
                let draws = renderer.done.draws().into_iter().zip(of_two);
                let draws = draws.map(|(draw, of_two)| joined(draw, of_two));
                Looked {
                    light: light.collect(),
                    stats: stats.collect(),
                    draws: pixels.zip(draws).collect(),
                    rays: renderer.done.rays,
                }
            },
        )
        .collect();
    let rays = found.iter().map(|f| f.rays).sum::<u64>() as f64 / pixels as f64;
    Found {
        regions,
        tiles: found,
        rays,
    }
}

/// Adds the light drawn into the image, scaled to its state after `after` passes. Returns the rays
/// of one pass. Light paths cross tiles, so the sampled tiles receive as little of them as all
/// others. Therefore fewer light paths are traced than in a pass, and their variance is scaled.
fn drawn(frame: &Frame, found: &mut Found, after: u32) -> Result<u64, RenderError> {
    let Some(sources) = Sources::of(frame) else {
        return Ok(0);
    };
    let Found { regions, tiles, .. } = found;
    let pixels: usize = regions.iter().map(Region::pixels).sum();
    let whole = frame.width as usize * frame.height as usize;
    let thin = Thin {
        of: (whole / pixels.max(1)).max(1) as u32,
        regions,
    };
    let watch = Watch::new(&Unstopped, 0.0, 1.0);
    // The contributions of camera paths alone, and those of fewer light paths.
    let mut layers = [Layer::new(frame), Layer::new(frame)];
    let mut rays = 0;
    for pass in 0..PASSES {
        let of = (u32::MAX - PASSES + pass, &watch);
        let (mut splats, traced) = sources.pass(frame, of, thin);
        rays += traced;
        splats.sort_by_key(|s| (s.technique.is_of_light_paths(), s.pixel, s.slot));
        let kind = |s: &Splat| usize::from(s.technique.is_of_light_paths());
        for part in splats.chunk_by(|a, b| kind(a) == kind(b)) {
            layers[kind(&part[0])].add(frame, part, pass)?;
        }
    }
    let places = places(frame, regions);
    let (bins, unit) = (frame.film.slots - 2, unit(frame));
    for (layer, of) in layers.iter_mut().zip([1, thin.of]) {
        // Scales the variance of these passes to that after `after` passes.
        let less = f64::from(PASSES) / f64::from(of) / f64::from(after);
        layer.settle(frame)?;
        layer.each(frame, PASSES, Stop(&Unstopped), |pixel, of| {
            let Some(&(tile, k)) = places.get(&pixel) else {
                return;
            };
            let tile = &mut tiles[tile];
            let stat = &mut tile.stats[k];
            for (bin, mean, _) in of.light() {
                let (h, mean) = (&mut tile.light[k * bins + bin], mean / unit);
                stat.norm2 += mean * (mean + 2.0 * f64::from(*h));
                stat.total += mean;
                *h += mean as f32;
            }
            let scale = 1.0 / (unit * unit);
            let variance = of.pixel_variance() * scale;
            stat.norm2 -= (1.0 - less) * variance;
            stat.multi_variance += less * variance;
            let draw = tile.draws.iter_mut().find(|(of, _)| *of == k);
            if let (Some(own), Some((_, draw))) = (of.draw(), draw) {
                for (square, of_layer) in draw.iter_mut().zip(own) {
                    *square += less * of_layer * scale;
                }
            }
        })?;
    }
    Ok(rays * u64::from(thin.of) / u64::from(PASSES))
}

/// Returns the tile and the pixel of the tile, by pixel of the image.
pub(crate) fn places(frame: &Frame, regions: &[Region]) -> HashMap<usize, (usize, usize)> {
    let each = regions.iter().enumerate().flat_map(|(tile, r)| {
        (0..r.pixels()).map(move |k| {
            let (row, col) = (r.row + k as u32 / r.cols, r.col + k as u32 % r.cols);
            ((row * frame.width + col) as usize, (tile, k))
        })
    });
    each.collect()
}

/// Returns a pixel's sums in render units, because only their ratios count.
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
