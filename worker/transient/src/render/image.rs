//! The whole image: rounds over its tiles, joined to what earlier rounds found, and the pilot.

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
    error::{Errors, Spread, Stat},
    region::Region,
    tile::{Done, Frame, Order, TileRenderer},
};
use crate::{
    api::{Progress, RenderError},
    two_bounce::Sampling,
};

/// Side of a tile in pixels: of a large image, and of a small one or one with many histograms a pixel.
/// A larger tile cuts fewer of the squares that share vertices at its edges, and takes more memory.
const LARGE_TILE: u32 = 32;
const SMALL_TILE: u32 = 16;
/// Pixels from which an image is large, channels from which a pixel has many histograms.
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

/// What rounds fill.
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
    /// What the two-bounce variance is in proportion to after them, see [`crate::two_bounce::Sampling::variance`].
    two_unit: f64,
    tile_spread: Vec<Spread>,
    tile_overflow: Vec<f64>,
    /// Draws of the errors of each tile's watched pixels.
    tile_draws: Vec<Vec<Draw>>,
    /// Of two bounces alone, by tile: the light, where later rounds may need it, variance of the energy, and ‖draw‖².
    tile_two: Vec<OfTwo>,
    /// Rays of the last strata of two bounces, and those of all passes of more.
    two_rays: u64,
    multi_rays: u64,
    /// Passes that the last strata were made for.
    strata_for: u32,
    width: usize,
    bins: usize,
}

/// What of a tile's two-bounce part is kept apart.
#[derive(Debug, Clone, Default)]
struct OfTwo {
    light: Vec<(u32, f32)>,
    total_variance: f64,
    draws: Vec<f64>,
}

/// What a round does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Round {
    /// Passes.
    pub passes: u32,
    /// It samples the two-bounce part as well. Else that stays what it is.
    pub two: bool,
    /// Later ones may leave the two-bounce part as it is.
    pub keeps: bool,
}

impl OfTwo {
    /// Joins the light of another round: `a` times what there is, and `b` times that.
    fn join(&mut self, a: f32, b: f32, new: Vec<(u32, f32)>) {
        if a == 0.0 {
            self.light = new;
            return;
        }
        let old = std::mem::take(&mut self.light);
        let scaled = |list: Vec<(u32, f32)>, factor: f32| {
            list.into_iter().map(move |(at, v)| (at, factor * v))
        };
        self.light = scaled(old, a).chain(scaled(new, b)).collect();
        self.light.sort_by_key(|(at, _)| *at);
        self.light.dedup_by(|next, kept| {
            let same = next.0 == kept.0;
            if same {
                kept.1 += next.1;
            }
            same
        });
    }
}

impl From<u32> for Round {
    /// The only round of a render.
    fn from(passes: u32) -> Self {
        Self {
            passes,
            two: true,
            keeps: false,
        }
    }
}

/// A range of tiles taken out of an image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Slice {
    /// The planes of [`Image::planes`], pixels in the order of the tiles.
    planes: Vec<Vec<f32>>,
    stats: Vec<Stat>,
    /// Spread, overflow and draws of errors of each tile.
    tiles: Vec<(Spread, f64, Vec<Draw>)>,
    /// Passes over them.
    passes: u32,
}

/// Tells the caller how far the render is and hears whether to stop.
pub(super) struct Watch<'a> {
    progress: &'a dyn Progress,
    stopped: AtomicBool,
    tiles: AtomicUsize,
    from: f32,
    to: f32,
}

impl<'a> Watch<'a> {
    /// A watch over the round that takes the render from share `from` to `to`.
    pub fn new(progress: &'a dyn Progress, from: f32, to: f32) -> Self {
        Self {
            progress,
            stopped: AtomicBool::new(false),
            tiles: AtomicUsize::new(0),
            from,
            to,
        }
    }

    /// False to stop.
    pub fn go_on(&self) -> bool {
        self.ask(1, 0.0)
    }

    /// Whether anyone has heard that the render shall stop.
    pub fn stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }

    /// False to stop. Asked often, since a tile of many passes takes long.
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

/// Whether so many values find room, all at once.
///
/// # Errors
/// [`RenderError::Memory`].
pub(super) fn room<T>(count: usize, what: &str) -> Result<(), RenderError> {
    let mut all = Vec::<T>::new();
    all.try_reserve_exact(count)
        .map_err(|_| RenderError::Memory {
            what: what.to_owned(),
            gib: count as f64 * size_of::<T>() as f64 / (1u64 << 30) as f64,
        })
}

/// So many zeros. Pages that nobody writes to take no memory, which is why they are not written here.
///
/// # Errors
/// [`RenderError::Memory`].
pub(super) fn zeros(count: usize, what: &str) -> Result<Vec<f32>, RenderError> {
    room::<f32>(count, what)?;
    Ok(vec![0.0; count])
}

/// Side in pixels of the tiles that an image is rendered in.
pub(super) fn tile_side(frame: &Frame) -> u32 {
    let pixels = frame.width as usize * frame.height as usize;
    match pixels >= LARGE && frame.film.channels < MANY {
        true => LARGE_TILE,
        false => SMALL_TILE,
    }
}

impl Image {
    /// An image that nothing was found in yet.
    ///
    /// # Errors
    /// [`RenderError::Memory`].
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
            tile_spread: vec![Spread::default(); tiles.len()],
            tile_overflow: vec![0.0; tiles.len()],
            tile_draws: vec![vec![]; tiles.len()],
            tile_two: vec![OfTwo::default(); tiles.len()],
            two_rays: 0,
            multi_rays: 0,
            strata_for: 0,
            tiles,
            width: width as usize,
            bins,
        })
    }

    /// How many tiles there are.
    pub fn tiles(&self) -> usize {
        self.tiles.len()
    }

    /// How many passes sampling two bounces takes as many rays as, in a round of so many.
    pub fn strata_cost(&self, sampling: &Sampling, passes: u32) -> u32 {
        let side = |n: u32| f64::from(sampling.sides(n).0);
        let more = (side(passes) / side(self.strata_for)).powi(2);
        let of_pass = self.multi_rays as f64 / f64::from(self.passes.max(1));
        // Casting saturates.
        (more * self.two_rays as f64 / of_pass.max(1.0)).round() as u32
    }

    /// The errors of what was found so far.
    pub fn errors(&self) -> Errors {
        let tiles = self.tiles.iter().zip(&self.tile_draws);
        let watched = tiles.flat_map(|(region, draws)| {
            draws::watched(region).zip(draws).map(move |(k, draw)| {
                let (row, col) = (k as u32 / region.cols, k as u32 % region.cols);
                let (row, col) = (region.row + row, region.col + col);
                (row as usize * self.width + col as usize, *draw)
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

    /// Everything that there is of each pixel and bin.
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

    /// Places of the pixels of a range of tiles, a run of a tile's row each: first pixel and how many.
    fn runs(&self, range: Range<usize>) -> Vec<(usize, usize)> {
        let width = self.width;
        let of_tile = |t: &Region| {
            let (col, cols) = (t.col as usize, t.cols as usize);
            let rows = t.row as usize..(t.row + t.rows) as usize;
            rows.map(move |row| (row * width + col, cols))
        };
        self.tiles[range].iter().flat_map(of_tile).collect()
    }

    /// Takes a range of tiles out.
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
        let tile = |t: usize| {
            let draws = self.tile_draws[t].clone();
            (self.tile_spread[t], self.tile_overflow[t], draws)
        };
        Slice {
            planes,
            stats: stats.copied().collect(),
            tiles: range.map(tile).collect(),
            passes: self.passes,
        }
    }

    /// Puts a range of tiles in; `false` if it is not one of such an image. [`Image::total`] when all are in.
    pub fn put(&mut self, range: Range<usize>, slice: &Slice) -> bool {
        let (runs, bins) = (self.runs(range.clone()), self.bins);
        let pixels: usize = runs.iter().map(|(_, count)| count).sum();
        let mut tiles = self.tiles[range.clone()].iter().zip(&slice.tiles);
        let watched = tiles.all(|(region, of)| of.2.len() == draws::count(region));
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
        for (t, (spread, overflow, draws)) in range.zip(&slice.tiles) {
            self.tile_spread[t] = *spread;
            self.tile_overflow[t] = *overflow;
            self.tile_draws[t].clone_from(draws);
        }
        true
    }

    /// One more round over a range of the tiles. Returns the rays traced.
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
        let image = Mutex::new(&mut *self);
        // As many as threads, for the whole round: their buffers are large, and new memory is dear.
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
                lock(&image).join(frame, t, round, &mut renderer.done);
                watch.tiles.fetch_add(1, Ordering::Relaxed);
                let rays = (renderer.done.rays, renderer.done.two_rays);
                lock(&idle).push(renderer);
                Some(rays)
            })
            .collect();
        let (mut all, mut two) = (0, 0);
        for r in rays {
            let (of_tile, of_two) = r.ok_or(RenderError::Stopped)?;
            all += of_tile;
            two += of_two;
        }
        self.multi_rays += all - two;
        if round.two {
            (self.two_rays, self.strata_for) = (two, round.passes);
            let before = (self.passes, self.two_unit);
            self.two_unit = frame.sampling.joined(before, round.passes);
        }
        self.passes += round.passes;
        self.total();
        Ok(all)
    }

    /// Sums over the tiles, in their order.
    pub fn total(&mut self) {
        let each = self.tile_spread.iter();
        self.total_spread = each.fold(Spread::default(), |all, &s| all.plus(s));
        self.overflow = self.tile_overflow.iter().sum();
    }

    /// Joins a tile's new passes to its earlier ones, each weighed by its passes.
    fn join(&mut self, frame: &Frame, t: usize, round: Round, done: &mut Done) {
        if !round.two {
            done.put_two(&self.tile_two[t].light);
        }
        let done = &*done;
        let (film, region, bins) = (frame.film, self.tiles[t], self.bins);
        let spent = f64::from(self.passes);
        let new = if spent == 0.0 {
            1.0
        } else {
            f64::from(done.passes) / (spent + f64::from(done.passes))
        };
        let (a, b) = (1.0 - new, new);
        // Render units → metres: every path has one 1/d² left over.
        let unit = f64::from(frame.walk.world.scale) * f64::from(frame.walk.world.scale);
        let unit2 = unit * unit;
        let blend = |old: f64, x: f64| old * a * a + x * b * b;
        // A single pass does not tell how far it is off; those before it do.
        let alone = done.passes == 1 && !round.two;
        let blend_multi = |old: f64, x: f64| if alone { old * a } else { blend(old, x) };
        for k in 0..region.pixels() {
            let row = region.row as usize + k / region.cols as usize;
            let col = region.col as usize + k % region.cols as usize;
            let pixel = row * self.width + col;
            let mut stat = Stat::default();
            for bin in 0..bins {
                let m = done.moments(film, k, bin + 1);
                let at = pixel * bins + bin;
                let old = f64::from(self.transient[at]) * a;
                let h = (old + (m.two + m.multi) * unit * b) as f32;
                self.transient[at] = h;
                stat.norm2 += f64::from(h) * f64::from(h);
                stat.total += f64::from(h);
                if let Some(s) = &mut self.split {
                    let mean = |old: f32, x: f64| (f64::from(old) * a + x * unit * b) as f32;
                    let error = |old: f32, x: f64| {
                        let old = f64::from(old);
                        blend(old * old, x * unit2).sqrt() as f32
                    };
                    if round.two {
                        s.two[at] = mean(s.two[at], m.two);
                        s.two_se[at] = error(s.two_se[at], m.two_variance);
                        s.two_noise[at] = mean(s.two_noise[at], done.two_noise(film, k, bin + 1));
                    }
                    s.multi[at] = mean(s.multi[at], m.multi);
                    if alone {
                        let less = a.sqrt() as f32;
                        s.multi_noise[at] *= less;
                        s.multi_se[at] *= less;
                    } else {
                        s.multi_noise[at] = mean(s.multi_noise[at], done.noise(film, k, bin + 1));
                        s.multi_se[at] = error(s.multi_se[at], m.multi_variance);
                    }
                }
            }
            for (g, group) in self.groups.iter_mut().enumerate() {
                for bin in 0..bins {
                    let h = &mut group[pixel * bins + bin];
                    let x = done.value(film, k, g + 1, bin + 1);
                    *h = (f64::from(*h) * a + x * unit * b) as f32;
                }
            }
            (stat.two_variance, stat.multi_variance) = done.pixel_variance(k);
            let old = self.stats[pixel];
            self.stats[pixel] = Stat {
                two_variance: match round.two {
                    true => blend(old.two_variance, stat.two_variance * unit2),
                    false => old.two_variance,
                },
                multi_variance: blend_multi(old.multi_variance, stat.multi_variance * unit2),
                ..stat
            };
        }
        // Errors of rounds are independent: on average their squares add up.
        let draws = &mut self.tile_draws[t];
        draws.resize(draws::count(&region), Draw::default());
        let two = &mut self.tile_two[t];
        two.draws.resize(draws.len(), 0.0);
        let of_two = two.draws.iter().copied();
        for ((old, new), of_two) in draws.iter_mut().zip(done.draws()).zip(of_two) {
            // Of two bounces what there was stays, where no more was sampled.
            let stays = if round.two { 0.0 } else { of_two };
            for (old, new) in old.iter_mut().zip(new) {
                *old = match alone {
                    true => stays * (1.0 - a) + *old * a,
                    false => stays * (1.0 - a * a) + blend(*old, new * unit2),
                };
            }
        }
        let stays = if round.two { 0.0 } else { two.total_variance };
        let mut before = self.tile_spread[t];
        before.variance = (before.variance - stays).max(0.0);
        let mut joined = match alone {
            true => before.scaled(a.sqrt()),
            false => before.scaled(a).plus(done.total_spread().scaled(unit * b)),
        };
        joined.variance += stays;
        self.tile_spread[t] = joined;
        if round.two {
            two.total_variance = blend(two.total_variance, done.two_total_variance() * unit2);
            for (old, new) in two.draws.iter_mut().zip(done.two_draws()) {
                *old = blend(*old, new * unit2);
            }
            if round.keeps {
                two.join(a as f32, b as f32, done.take_two());
            }
        }
        self.tile_overflow[t] = self.tile_overflow[t] * a + done.overflow(film) * unit * b;
    }
}
