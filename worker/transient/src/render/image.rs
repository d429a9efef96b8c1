//! The whole image: rounds over its tiles, joined with the results of earlier rounds, and the
//! pilot.

use std::{
    ops::Range,
    sync::{
        Mutex, MutexGuard,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    draws::{self, Draw},
    error::{Errors, Spread, Stat, joined_variance},
    region::Region,
    tile::{Done, Frame, Order, TileRenderer},
};
use crate::{
    api::{Progress, RenderError},
    two_bounce::Sampling,
};

/// Side of a tile in pixels: in a large image, and in a small one or one with many histograms per
/// pixel. A larger tile cuts fewer of the squares that share vertices at its edges, and takes more
/// memory.
const LARGE_TILE: u32 = 32;
const SMALL_TILE: u32 = 16;
/// The number of pixels from which an image is large, and of channels from which a pixel has many
/// histograms.
const LARGE: usize = 1 << 16;
const MANY: usize = 5;
/// The parts with their standard errors.
#[derive(Debug)]
pub(super) struct Parts {
    pub two: Vec<f32>,
    pub two_se: Vec<f32>,
    pub two_noise: Vec<f32>,
    pub multi: Vec<f32>,
    pub multi_se: Vec<f32>,
    pub multi_noise: Vec<f32>,
}

/// The image that rounds accumulate.
#[derive(Debug)]
pub(super) struct Image {
    pub transient: Vec<f32>,
    pub split: Option<Parts>,
    pub groups: Vec<Vec<f32>>,
    pub stats: Vec<Stat>,
    /// Spread of the image's whole energy.
    pub total_spread: Spread,
    /// Energy outside the gate.
    pub overflow: f64,
    tiles: Vec<Region>,
    /// Passes over every tile so far.
    pub passes: u32,
    /// The value that the two-bounce variance is proportional to after these passes, see
    /// [`crate::two_bounce::Sampling::variance`].
    two_unit: f64,
    of_tiles: Vec<OfTile>,
    /// The two-bounce part of each tile, if later rounds need it: index among the slots of all
    /// channels of its pixels, and value.
    tile_two: Vec<Vec<(u32, f32)>>,
    /// Rays of the last strata of two bounces, the passes that these strata were made for, and rays
    /// of all passes.
    two_rays: u64,
    strata_for: u32,
    multi_rays: u64,
    width: usize,
    bins: usize,
}

/// Sums of a tile beyond its pixels' light.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct OfTile {
    /// Energy of three bounces and more, and its spread.
    multi: f64,
    spread: Spread,
    /// Variance of the energy of two bounces.
    two_variance: f64,
    /// Energy outside the gate, of two bounces and of more bounces.
    overflow: (f64, f64),
    /// Draws of the errors of the watched pixels: of three bounces and more, and of two.
    draws: Vec<Draw>,
    two_draws: Vec<f64>,
}

/// The work of a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Round {
    /// The number of passes.
    pub passes: u32,
    /// Whether the two-bounce part is sampled as well. Otherwise it stays unchanged.
    pub two: bool,
    /// Whether more rounds may follow.
    pub more: bool,
}

impl Round {
    /// Returns the only round of a render.
    pub fn only(passes: u32) -> Self {
        Self {
            passes,
            two: true,
            more: false,
        }
    }
}

/// A range of tiles taken out of an image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Slice {
    /// The planes of [`Image::planes`], pixels in the order of the tiles.
    planes: Vec<Vec<f32>>,
    stats: Vec<Stat>,
    tiles: Vec<OfTile>,
    /// The number of passes over these tiles.
    passes: u32,
}

/// Reports the progress of the render to the caller and asks whether to stop.
pub(super) struct Watch<'a> {
    progress: &'a dyn Progress,
    stopped: AtomicBool,
    tiles: AtomicUsize,
    from: f32,
    to: f32,
}

impl<'a> Watch<'a> {
    /// Returns a watch over the round that advances the render from fraction `from` to `to`.
    pub fn new(progress: &'a dyn Progress, from: f32, to: f32) -> Self {
        Self {
            progress,
            stopped: AtomicBool::new(false),
            tiles: AtomicUsize::new(0),
            from,
            to,
        }
    }

    /// Returns false to stop.
    pub fn go_on(&self) -> bool {
        self.ask(1, 0.0)
    }

    /// Returns whether any call has returned that the render must stop.
    pub fn stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }

    /// Returns false to stop. It is called often, because a tile of many passes takes long.
    fn ask(&self, count: usize, share: f32) -> bool {
        let done = self.tiles.load(Ordering::Relaxed);
        let at = self.from + (self.to - self.from) * (done as f32 + share) / count as f32;
        if !self.progress.at(at.min(1.0)) {
            self.stopped.store(true, Ordering::Relaxed);
        }
        !self.stopped.load(Ordering::Relaxed)
    }
}

fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(|e| e.into_inner())
}

/// Checks that `count` values can be allocated at once.
///
/// # Errors
/// Returns [`RenderError::Memory`] if they cannot.
pub(super) fn room<T>(count: usize, what: &str) -> Result<(), RenderError> {
    let mut all = Vec::<T>::new();
    all.try_reserve_exact(count)
        .map_err(|_| RenderError::Memory {
            what: what.to_owned(),
            gib: count as f64 * size_of::<T>() as f64 / (1u64 << 30) as f64,
        })
}

/// Returns `count` zeros. Pages that are never written take no memory, so this function does not
/// write them.
///
/// # Errors
/// Returns [`RenderError::Memory`] if the allocation fails.
pub(super) fn zeros(count: usize, what: &str) -> Result<Vec<f32>, RenderError> {
    room::<f32>(count, what)?;
    Ok(vec![0.0; count])
}

/// Returns the side in pixels of the tiles that an image is rendered in.
pub(super) fn tile_side(frame: &Frame) -> u32 {
    let pixels = frame.width as usize * frame.height as usize;
    match pixels >= LARGE && frame.film.channels < MANY {
        true => LARGE_TILE,
        false => SMALL_TILE,
    }
}

impl Image {
    /// Returns an empty image.
    ///
    /// # Errors
    /// Returns [`RenderError::Memory`] if the allocation fails.
    pub fn new(frame: &Frame) -> Result<Self, RenderError> {
        let (width, height) = (frame.width, frame.height);
        let pixels = width as usize * height as usize;
        let bins = frame.film.gate.bins as usize;
        let all = frame.film.channels + if frame.split { 6 } else { 0 };
        room::<f32>(pixels * bins * all, "the histograms of the image")?;
        let empty = || zeros(pixels * bins, "the histograms of the image");
        let side = tile_side(frame);
        let starts = |length: u32| (0..length).step_by(side as usize);
        let tiles: Vec<Region> = starts(height)
            .flat_map(|row| {
                starts(width).map(move |col| Region {
                    row,
                    col,
                    rows: side.min(height - row),
                    cols: side.min(width - col),
                })
            })
            .collect();
        let split = match frame.split {
            true => Some(Parts {
                two: empty()?,
                two_se: empty()?,
                two_noise: empty()?,
                multi: empty()?,
                multi_se: empty()?,
                multi_noise: empty()?,
            }),
            false => None,
        };
        let groups: Result<_, RenderError> = (1..frame.film.channels).map(|_| empty()).collect();
        Ok(Self {
            transient: empty()?,
            split,
            groups: groups?,
            stats: vec![Stat::default(); pixels],
            total_spread: Spread::default(),
            overflow: 0.0,
            passes: 0,
            two_unit: 0.0,
            of_tiles: vec![OfTile::default(); tiles.len()],
            tile_two: vec![vec![]; tiles.len()],
            two_rays: 0,
            strata_for: 0,
            multi_rays: 0,
            tiles,
            width: width as usize,
            bins,
        })
    }

    /// Returns the number of tiles.
    pub fn tiles(&self) -> usize {
        self.tiles.len()
    }

    /// Returns the number of passes that trace as many rays as the two-bounce samples of a round of
    /// `passes`.
    pub fn strata_cost(&self, sampling: &Sampling, passes: u32) -> u32 {
        let side = |n: u32| f64::from(sampling.sides(n).0);
        let more = (side(passes) / side(self.strata_for)).powi(2);
        let of_pass = self.multi_rays as f64 / f64::from(self.passes.max(1));
        // The cast saturates.
        (more * self.two_rays as f64 / of_pass.max(1.0)).round() as u32
    }

    /// Returns the errors of the image so far.
    pub fn errors(&self) -> Errors {
        let tiles = self.tiles.iter().zip(&self.of_tiles);
        let watched = tiles.flat_map(|(region, of)| {
            let draws = of.draws.iter().zip(&of.two_draws);
            let draws = draws.map(|(draw, two)| draws::joined(*draw, *two));
            draws::watched(region).zip(draws).map(move |(k, draw)| {
                let (row, col) = (k as u32 / region.cols, k as u32 % region.cols);
                let (row, col) = (region.row + row, region.col + col);
                (row as usize * self.width + col as usize, draw)
            })
        });
        Errors {
            stats: self.stats.clone(),
            draws: watched.collect(),
            spread: self.total_spread,
            samples: self.passes,
            two_unit: self.two_unit,
        }
    }

    /// Returns every plane of values by pixel and bin.
    fn planes(&mut self) -> Vec<&mut Vec<f32>> {
        let mut planes = vec![&mut self.transient];
        if let Some(s) = &mut self.split {
            planes.extend([
                &mut s.two,
                &mut s.two_se,
                &mut s.two_noise,
                &mut s.multi,
                &mut s.multi_se,
                &mut s.multi_noise,
            ]);
        }
        planes.extend(&mut self.groups);
        planes
    }

    /// Returns the pixels of a range of tiles as runs, one per tile row: first pixel and length.
    fn runs(&self, range: Range<usize>) -> Vec<(usize, usize)> {
        let width = self.width;
        let of_tile = |t: &Region| {
            let (col, cols) = (t.col as usize, t.cols as usize);
            let rows = t.row as usize..(t.row + t.rows) as usize;
            rows.map(move |row| (row * width + col, cols))
        };
        self.tiles[range].iter().flat_map(of_tile).collect()
    }

    /// Extracts a range of tiles.
    pub fn take(mut self, range: Range<usize>) -> Slice {
        let (runs, bins) = (self.runs(range.clone()), self.bins);
        let cut = |plane: &mut Vec<f32>| {
            let run =
                |&(first, count): &(usize, usize)| &plane[first * bins..(first + count) * bins];
            runs.iter().flat_map(run).copied().collect()
        };
        let planes = self.planes().into_iter().map(cut).collect();
        let stats = runs
            .iter()
            .flat_map(|&(first, count)| &self.stats[first..first + count]);
        Slice {
            planes,
            stats: stats.copied().collect(),
            tiles: self.of_tiles[range].to_vec(),
            passes: self.passes,
        }
    }

    /// Inserts a range of tiles. Returns `false` if the slice does not fit an image of this shape.
    /// Call [`Image::total`] after the last one.
    pub fn put(&mut self, range: Range<usize>, slice: &Slice) -> bool {
        let (runs, bins) = (self.runs(range.clone()), self.bins);
        let pixels: usize = runs.iter().map(|(_, count)| count).sum();
        let mut tiles = self.tiles[range.clone()].iter().zip(&slice.tiles);
        let watched = tiles.all(|(region, of)| {
            let count = draws::count(region);
            of.draws.len() == count && of.two_draws.len() == count
        });
        let planes = self.planes();
        if slice.tiles.len() != range.len()
            || !watched
            || slice.stats.len() != pixels
            || slice.planes.len() != planes.len()
            || slice.planes.iter().any(|p| p.len() != pixels * bins)
        {
            return false;
        }
        for (to, mut from) in planes.into_iter().zip(slice.planes.iter().map(|p| &p[..])) {
            for &(first, count) in &runs {
                let (run, rest) = from.split_at(count * bins);
                to[first * bins..(first + count) * bins].copy_from_slice(run);
                from = rest;
            }
        }
        let mut from = &slice.stats[..];
        for (first, count) in runs {
            let (run, rest) = from.split_at(count);
            self.stats[first..first + count].copy_from_slice(run);
            from = rest;
        }
        self.passes = slice.passes;
        self.of_tiles[range].clone_from_slice(&slice.tiles);
        true
    }

    /// Makes one more round over a range of the tiles. Returns the number of rays traced.
    pub fn round(
        &mut self,
        frame: &Frame,
        range: Range<usize>,
        round: Round,
        watch: &Watch,
    ) -> Result<u64, RenderError> {
        let tiles = self.tiles.clone();
        let count = range.len();
        let order = Order {
            first: self.passes,
            count: round.passes,
            two: round.two,
        };
        let two = match round.two {
            true => frame.sampling.weight(self.two_unit, round.passes),
            false => 0.0,
        };
        let image = Mutex::new(&mut *self);
        // At most one per thread for the whole round, because their buffers are large and
        // allocation is expensive.
        let idle: Mutex<Vec<TileRenderer>> = Mutex::default();
        let rays: Vec<Option<(u64, u64)>> = range
            .into_par_iter()
            .map(|t| {
                if watch.stopped.load(Ordering::Relaxed) {
                    return None;
                }
                let known = lock(&idle).pop();
                let mut renderer = known.unwrap_or_else(|| TileRenderer::new(frame));
                renderer.render(frame, &tiles[t], &order, &|share| watch.ask(count, share))?;
                lock(&image).join(frame, (t, two, round.more), &renderer.done);
                watch.tiles.fetch_add(1, Ordering::Relaxed);
                let rays = (renderer.done.rays, renderer.done.two_rays);
                lock(&idle).push(renderer);
                Some(rays)
            })
            .collect();
        let (mut all, mut of_two) = (0, 0);
        for r in rays {
            let (traced, two) = r.ok_or(RenderError::Stopped)?;
            all += traced;
            of_two += two;
        }
        self.multi_rays += all - of_two;
        if round.two {
            (self.two_rays, self.strata_for) = (of_two, round.passes);
            self.two_unit = frame.sampling.joined(self.two_unit, round.passes);
        }
        self.passes += round.passes;
        self.total();
        Ok(all)
    }

    /// Sums over the tiles, in their order.
    pub fn total(&mut self) {
        let each = self.of_tiles.iter().map(|of| {
            let two = Spread {
                variance: of.two_variance,
                of_variance: 0.0,
            };
            of.spread.plus(two)
        });
        self.total_spread = each.fold(Spread::default(), Spread::plus);
        let outside = self.of_tiles.iter().map(|of| of.overflow.0 + of.overflow.1);
        self.overflow = outside.sum();
    }

    /// Joins a tile's new passes with its earlier ones, weighted by passes. `two` is the weight of
    /// the new two-bounce part, 0 if there is none. `more` is true if more rounds may follow.
    fn join(&mut self, frame: &Frame, (t, two, more): (usize, f64, bool), done: &Done) {
        let (film, region, bins) = (frame.film, self.tiles[t], self.bins);
        let (spent, added) = (f64::from(self.passes), f64::from(done.passes));
        let b = match spent == 0.0 {
            true => 1.0,
            false => added / (spent + added),
        };
        let (a, stays) = (1.0 - b, 1.0 - two);
        // Converts render units to metres: every path has one 1/d² left over.
        let unit = f64::from(frame.walk.world.scale) * f64::from(frame.walk.world.scale);
        let unit2 = unit * unit;
        let blend = |(a, b): (f64, f64), old: f64, x: f64| old * a * a + x * b * b;
        // A single pass gives no error estimate, so its error is assumed to be that of the passes
        // before it.
        let alone = spent > 0.0 && done.passes == 1;
        let multi = |old: f64, x: f64| match alone {
            true => old * a,
            false => blend((a, b), old, x),
        };
        let before = dense(&self.tile_two[t], region.pixels() * film.pixel());
        let mut after = before.clone();
        if two > 0.0 {
            for (after, new) in after.iter_mut().zip(done.two()) {
                *after = (f64::from(*after) * stays + f64::from(*new) * two) as f32;
            }
        }
        // Joins both parts of a slot, from their previous sum.
        let joined = |old: f32, at: usize, x: f64| {
            let (before, after) = (f64::from(before[at]) * unit, f64::from(after[at]) * unit);
            // A rounding residue is not light.
            let old = (f64::from(old) - before).max(0.0);
            let x = x * unit;
            ((after + old * a + x * b) as f32, x - old)
        };
        for k in 0..region.pixels() {
            let row = region.row as usize + k / region.cols as usize;
            let col = region.col as usize + k % region.cols as usize;
            let pixel = row * self.width + col;
            let mut stat = Stat::default();
            let mut difference2 = 0.0;
            for bin in 0..bins {
                let m = done.moments(film, k, bin + 1);
                let at = pixel * bins + bin;
                let place = k * film.pixel() + bin + 1;
                let (h, difference) = joined(self.transient[at], place, m.multi);
                self.transient[at] = h;
                stat.norm2 += f64::from(h) * f64::from(h);
                stat.total += f64::from(h);
                difference2 += difference * difference;
                if let Some(s) = &mut self.split {
                    let root = |variance: f64| variance.sqrt() as f32;
                    let square = |x: f32| f64::from(x) * f64::from(x);
                    let mean = |(a, b): (f64, f64), old: f32, x: f64| {
                        (f64::from(old) * a + x * unit * b) as f32
                    };
                    let of_two = (stays, two);
                    s.two[at] = mean((0.0, 1.0), 0.0, f64::from(after[place]));
                    let variance = blend(of_two, square(s.two_se[at]), m.two_variance * unit2);
                    s.two_se[at] = root(variance);
                    let noise = done.two_noise(film, k, bin + 1);
                    s.two_noise[at] = mean(of_two, s.two_noise[at], noise);
                    s.multi[at] = mean((a, b), s.multi[at], m.multi);
                    s.multi_noise[at] = match alone {
                        true => (f64::from(s.multi_noise[at]) * a.sqrt()) as f32,
                        false => mean((a, b), s.multi_noise[at], done.noise(film, k, bin + 1)),
                    };
                    let old = square(s.multi_se[at]);
                    s.multi_se[at] = root(multi(old, m.multi_variance * unit2));
                }
            }
            for (g, group) in self.groups.iter_mut().enumerate() {
                for bin in 0..bins {
                    let at = pixel * bins + bin;
                    let place = k * film.pixel() + (g + 1) * film.slots + bin + 1;
                    let x = done.multi(film, k, g + 1, bin + 1);
                    group[at] = joined(group[at], place, x).0;
                }
            }
            let (two_variance, multi_variance) = done.pixel_variance(k);
            let old = self.stats[pixel];
            let variances = (old.multi_variance, multi_variance * unit2);
            self.stats[pixel] = Stat {
                two_variance: blend((stays, two), old.two_variance, two_variance * unit2),
                multi_variance: joined_variance((spent, added), variances, difference2),
                ..stat
            };
        }
        // Errors of rounds are independent, so on average their squares add up. For few passes,
        // their variance replaces the draws.
        let of = &mut self.of_tiles[t];
        of.draws.resize(draws::count(&region), Draw::default());
        of.two_draws.resize(of.draws.len(), 0.0);
        let pixels = draws::watched(&region).map(|k| {
            let (row, col) = (k / region.cols as usize, k % region.cols as usize);
            (region.row as usize + row) * self.width + region.col as usize + col
        });
        for ((draw, new), pixel) in of.draws.iter_mut().zip(done.draws()).zip(pixels) {
            if draws::are_drawn(done.passes) {
                for (old, new) in draw.iter_mut().zip(new) {
                    *old = blend((a, b), *old, new * unit2);
                }
            } else if draws::are_drawn(self.passes) {
                draw.iter_mut().for_each(|old| *old *= a);
            } else {
                *draw = draws::of_variance(self.stats[pixel].multi_variance);
            }
        }
        for (old, new) in of.two_draws.iter_mut().zip(done.two_draws()) {
            *old = blend((stays, two), *old, new * unit2);
        }
        let (energy, spread) = done.multi_energy();
        let (energy, spread) = (energy * unit, spread.scaled(unit));
        of.spread = of.spread.joined((spent, of.multi), spread, (added, energy));
        of.multi = of.multi * a + energy * b;
        let two_variance = done.two_energy_variance() * unit2;
        of.two_variance = blend((stays, two), of.two_variance, two_variance);
        let outside = done.overflow(film);
        of.overflow.0 = of.overflow.0 * stays + outside.0 * unit * two;
        of.overflow.1 = of.overflow.1 * a + outside.1 * unit * b;
        if two > 0.0 && more {
            self.tile_two[t] = sparse(&after);
        }
    }
}

/// Returns the nonzero values with their indices.
fn sparse(values: &[f32]) -> Vec<(u32, f32)> {
    let each = (0u32..).zip(values.iter().copied());
    each.filter(|(_, v)| *v != 0.0).collect()
}

/// Expands sparse values to all `count` values.
fn dense(values: &[(u32, f32)], count: usize) -> Vec<f32> {
    let mut all = vec![0.0; count];
    for &(at, v) in values {
        all[at as usize] = v;
    }
    all
}
