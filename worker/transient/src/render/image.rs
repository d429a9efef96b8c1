//! The whole image: rounds over its tiles, joined with the results of earlier rounds, and the
//! pilot.

use std::{
    ops::Range,
    sync::{Mutex, MutexGuard, atomic::Ordering},
};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    api::RenderError,
    paths::two_bounce::Sampling,
    render::{
        draws::{self, Draw},
        error::Errors,
        frame::Frame,
        memory::{room, zeros},
        region::Region,
        rounds::Round,
        spread::Spread,
        stat::Stat,
        tile::{Order, TileRenderer},
        watch::Watch,
    },
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
pub(crate) struct Parts {
    pub two: Vec<f32>,
    pub two_se: Vec<f32>,
    pub two_noise: Vec<f32>,
    pub multi: Vec<f32>,
    pub multi_se: Vec<f32>,
    pub multi_noise: Vec<f32>,
}

/// The image that rounds accumulate.
#[derive(Debug)]
pub(crate) struct Image {
    pub transient: Vec<f32>,
    pub split: Option<Parts>,
    pub groups: Vec<Vec<f32>>,
    pub stats: Vec<Stat>,
    /// Spread of the image's whole energy.
    pub total_spread: Spread,
    /// Energy outside the gate.
    pub overflow: f64,
    pub tiles: Vec<Region>,
    /// Passes over every tile so far.
    pub passes: u32,
    /// The value that the two-bounce variance is proportional to after these passes, see
    /// [`crate::paths::two_bounce::Sampling::variance`].
    pub two_unit: f64,
    pub of_tiles: Vec<OfTile>,
    /// The two-bounce part of each tile, if later rounds need it: index among the slots of all
    /// channels of its pixels, and value.
    pub tile_two: Vec<Vec<(u32, f32)>>,
    /// Rays of the last strata of two bounces, the passes that these strata were made for, and rays
    /// of all passes.
    pub two_rays: u64,
    pub strata_for: u32,
    pub multi_rays: u64,
    pub width: usize,
    pub bins: usize,
}

/// Sums of a tile beyond its pixels' light.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct OfTile {
    /// Energy of three bounces and more, and its spread.
    pub multi: f64,
    pub spread: Spread,
    /// Variance of the energy of two bounces.
    pub two_variance: f64,
    /// Energy outside the gate, of two bounces and of more bounces.
    pub overflow: (f64, f64),
    /// Draws of the errors of the watched pixels: of three bounces and more, and of two.
    pub draws: Vec<Draw>,
    pub two_draws: Vec<f64>,
}

fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(|e| e.into_inner())
}

/// Returns the side in pixels of the tiles that an image is rendered in.
pub(crate) fn tile_side(frame: &Frame) -> u32 {
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
}
