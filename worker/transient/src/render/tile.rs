//! One tile of the image, from the first pass to finished histograms. A tile is the unit of work of
//! one thread. Its random numbers depend only on its pixels and the pass, so tiles may be rendered
//! in any order.

use super::{
    draws::{Draw, Watched},
    error::{MULTI_REACH, Pool, Spread, TWO_REACH, pool, shut_out},
    region::Region,
};
use crate::{
    api::Overflow,
    film::{Blocks, Film},
    path_reuse::{Effort, Sharing, Tile},
    rng::{Rng, Stream},
    two_bounce::{Sampling, Strata},
    walk::{Scratch, Walk},
};

/// The shared inputs of all tiles.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame<'a> {
    pub walk: Walk<'a>,
    pub film: &'a Film,
    pub sampling: &'a Sampling,
    pub effort: Effort,
    pub seed: u64,
    pub width: u32,
    pub height: u32,
    /// Whether the parts are requested.
    pub split: bool,
}

/// The passes to make: the number of the first one, and the count.
#[derive(Debug, Clone, Copy)]
pub(super) struct Order {
    pub first: u32,
    pub count: u32,
    /// Whether the two-bounce part is sampled. Otherwise it is empty.
    pub two: bool,
}

/// Renders one tile after another and reuses its buffers. There is one per thread.
pub(super) struct TileRenderer {
    scratch: Scratch,
    sharing: Sharing,
    blocks: Blocks,
    strata: Strata,
    /// One pass over the pixels that share vertices.
    pass: Vec<f32>,
    /// The last pass of even number, if the alternating sum is requested.
    held: Vec<f32>,
    pub done: Done,
}

/// A finished tile, in render units.
#[derive(Debug, Default)]
pub(super) struct Done {
    /// Σ over passes of the 3+ part, slots by pixel.
    sum: Vec<f32>,
    /// Σ over passes of the square of the 3+ part, channel 0.
    square: Vec<f32>,
    /// Σ over passes with alternating sign, channel 0; empty if not requested.
    alternating: Vec<f32>,
    /// Variance of the mean of the 3+ part, channel 0, pooled.
    multi_variance: Vec<f32>,
    /// Mean of the two-bounce part.
    two: Vec<f32>,
    /// Variance of `two`, channel 0.
    two_variance: Vec<f32>,
    /// A draw of the error of `two`, channel 0; empty if not requested.
    two_noise: Vec<f32>,
    /// Variance of the sum over slots of the two-bounce mean.
    two_total_variance: Vec<f64>,
    /// Sums over the gate's slots of both parts' variances by pixel, before pooling. A sum over so
    /// many slots is precise enough by itself, and pooling would spread the noise of bright pixels
    /// to dim ones.
    pixel_variance: Vec<(f64, f64)>,
    watched: Watched,
    /// Energy of the whole tile by pass.
    all: Vec<f64>,
    pooling: Pool,
    pub passes: u32,
    /// All rays, and those of two bounces.
    pub rays: u64,
    pub two_rays: u64,
}

/// Means and variances of one channel-0 slot of one pixel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moments {
    pub two: f64,
    pub two_variance: f64,
    pub multi: f64,
    pub multi_variance: f64,
}

/// Returns the mean and its variance from Σx and Σx² over `n` passes.
fn mean(sum: f64, square: f64, n: f64) -> (f64, f64) {
    if n == 0.0 {
        return (0.0, 0.0);
    }
    let spread = if n > 1.0 {
        (square - sum * sum / n).max(0.0) / (n - 1.0)
    } else {
        square
    };
    (sum / n, spread / n)
}

/// Returns the sum over the gate's slots.
fn inside(film: &Film, slots: &[f32]) -> f64 {
    slots[1..film.slots - 1].iter().map(|&v| f64::from(v)).sum()
}

impl Done {
    fn reset(&mut self, film: &Film, region: &Region, split: bool) {
        let pixels = region.pixels();
        let zero = |v: &mut Vec<f32>, n: usize| {
            v.clear();
            v.resize(n, 0.0);
        };
        zero(&mut self.sum, pixels * film.pixel());
        zero(&mut self.square, pixels * film.slots);
        zero(
            &mut self.alternating,
            if split { pixels * film.slots } else { 0 },
        );
        zero(&mut self.two, pixels * film.pixel());
        zero(&mut self.two_variance, pixels * film.slots);
        zero(
            &mut self.two_noise,
            if split { pixels * film.slots } else { 0 },
        );
        self.two_total_variance.clear();
        self.two_total_variance.resize(pixels, 0.0);
        self.pixel_variance.clear();
        self.pixel_variance.resize(pixels, (0.0, 0.0));
        self.watched.reset(region, film.slots);
        self.all.clear();
        self.passes = 0;
    }

    /// Returns the sum of the two-bounce and 3+ means of any channel's slot of pixel `k`.
    pub fn value(&self, film: &Film, k: usize, channel: usize, slot: usize) -> f64 {
        let at = k * film.pixel() + channel * film.slots + slot;
        let n = f64::from(self.passes.max(1));
        f64::from(self.two[at]) + f64::from(self.sum[at]) / n
    }

    /// Returns the means and variances of a slot of pixel `k`, channel 0.
    pub fn moments(&self, film: &Film, k: usize, slot: usize) -> Moments {
        let (wide, narrow) = (k * film.pixel() + slot, k * film.slots + slot);
        let n = f64::from(self.passes.max(1));
        Moments {
            two: f64::from(self.two[wide]),
            two_variance: f64::from(self.two_variance[narrow]),
            multi: f64::from(self.sum[wide]) / n,
            multi_variance: f64::from(self.multi_variance[narrow]),
        }
    }

    /// Returns a draw of the 3+ part's error in a slot of pixel `k`, channel 0, including the
    /// correlations between pixels and bins; 0 with fewer than two passes.
    pub fn noise(&self, film: &Film, k: usize, slot: usize) -> f64 {
        let pairs = f64::from(self.passes / 2 * 2);
        let x = f64::from(self.alternating[k * film.slots + slot]);
        // Σ±x over n passes has n times the variance of a pass; the mean has 1/n of it.
        x / (pairs * f64::from(self.passes)).sqrt().max(1.0)
    }

    /// Like `noise`, for the two-bounce part.
    pub fn two_noise(&self, film: &Film, k: usize, slot: usize) -> f64 {
        f64::from(self.two_noise[k * film.slots + slot])
    }

    /// Updates the variances to the completed passes.
    fn estimate(&mut self, film: &Film, region: &Region) {
        let n = f64::from(self.passes);
        self.multi_variance.clear();
        for (sum, square) in self
            .sum
            .chunks(film.pixel())
            .zip(self.square.chunks(film.slots))
        {
            let both = sum[..film.slots].iter().zip(square);
            self.multi_variance.extend(
                both.map(|(&sum, &square)| mean(f64::from(sum), f64::from(square), n).1 as f32),
            );
        }
        shut_out(&mut self.multi_variance, film.slots);
        for (out, v) in self
            .pixel_variance
            .iter_mut()
            .zip(self.multi_variance.chunks(film.slots))
        {
            out.1 = inside(film, v);
        }
        let (variance, pooling) = (&mut self.multi_variance, &mut self.pooling);
        pool(variance, region, film.slots, MULTI_REACH, pooling);
    }

    /// Returns Σ over the gate's slots of both parts' variances in pixel `k`.
    pub fn pixel_variance(&self, k: usize) -> (f64, f64) {
        self.pixel_variance[k]
    }

    /// Returns draws of the errors of the watched pixels' 3+ part.
    pub fn draws(&self) -> Vec<Draw> {
        self.watched
            .draws(self.passes, |k| self.pixel_variance[k].1)
    }

    /// Returns ‖draw of the error of the watched pixels' two-bounce part‖².
    pub fn two_draws(&self) -> Vec<f64> {
        self.watched.two_draws()
    }

    /// Returns the indices of the watched pixels.
    pub fn watched(&self) -> &[usize] {
        self.watched.pixels()
    }

    /// Returns the tile's energy of three bounces and more, and its spread. Pixels that share
    /// vertices have correlated errors, so this is not the sum of their spreads.
    pub fn multi_energy(&self) -> (f64, Spread) {
        let n = f64::from(self.passes.max(1));
        (self.all.iter().sum::<f64>() / n, Spread::of(&self.all))
    }

    /// Returns the variance of the tile's energy of two bounces.
    pub fn two_energy_variance(&self) -> f64 {
        self.two_total_variance.iter().sum()
    }

    /// Returns the energy outside the gate, of two bounces and of more bounces.
    pub fn overflow(&self, film: &Film) -> (f64, f64) {
        let (mut two, mut multi) = (Overflow::default(), Overflow::default());
        let n = f64::from(self.passes.max(1));
        for (sum, of_two) in self
            .sum
            .chunks(film.pixel())
            .zip(self.two.chunks(film.pixel()))
        {
            multi.take(film, sum, 1.0 / n);
            two.take(film, of_two, 1.0);
        }
        (two.energy, multi.energy)
    }

    /// Returns the two-bounce means of all slots, pixel by pixel.
    pub fn two(&self) -> &[f32] {
        &self.two
    }

    /// Returns the 3+ mean of any channel's slot of pixel `k`.
    pub fn multi(&self, film: &Film, k: usize, channel: usize, slot: usize) -> f64 {
        let at = k * film.pixel() + channel * film.slots + slot;
        f64::from(self.sum[at]) / f64::from(self.passes.max(1))
    }
}

impl TileRenderer {
    pub fn new(frame: &Frame) -> Self {
        let walk = &frame.walk;
        Self {
            scratch: Scratch::new(walk.world, walk.emitters, walk.mirrors),
            sharing: Sharing::default(),
            blocks: Blocks::new(frame.film),
            strata: Strata::default(),
            pass: vec![],
            held: vec![],
            done: Done::default(),
        }
    }

    /// Renders a region into `done`. Returns `None` if `go_on`, called with the completed fraction,
    /// returns false.
    pub fn render(
        &mut self,
        frame: &Frame,
        region: &Region,
        order: &Order,
        go_on: &dyn Fn(f32) -> bool,
    ) -> Option<()> {
        let rays = self.scratch.stack.rays;
        self.done.reset(frame.film, region, frame.split);
        self.held.resize(self.done.alternating.len(), 0.0);
        if order.two {
            self.two(frame, region, order, go_on)?;
        }
        self.done.two_rays = self.scratch.stack.rays - rays;
        while self.done.passes < order.count {
            if !go_on(self.done.passes as f32 / order.count as f32) {
                return None;
            }
            self.pass(frame, region, order.first + self.done.passes);
        }
        self.done.estimate(frame.film, region);
        self.done.rays = self.scratch.stack.rays - rays;
        Some(())
    }

    /// Samples the two-bounce part of every pixel.
    fn two(
        &mut self,
        frame: &Frame,
        region: &Region,
        order: &Order,
        go_on: &dyn Fn(f32) -> bool,
    ) -> Option<()> {
        let (walk, film) = (&frame.walk, frame.film);
        if walk.max_bounces < 2 || walk.emitters.list.is_empty() {
            return Some(());
        }
        let (coarse, fine) = frame.sampling.sides(order.count);
        for k in 0..region.pixels() {
            if !go_on(0.0) {
                return None;
            }
            let row = region.row + k as u32 / region.cols;
            let col = region.col + k as u32 % region.cols;
            let index = row as usize * frame.width as usize + col as usize;
            let side = if frame.sampling.refined[index] {
                fine
            } else {
                coarse
            };
            let mut rng = Rng::new(
                frame.seed,
                Stream::Two,
                index as u64,
                u64::from(order.first),
            );
            self.blocks.clear();
            let strata = self.strata.sample_pixel(
                walk,
                film,
                (row, col, side),
                &mut rng,
                &mut self.scratch,
                &mut self.blocks,
            );
            let n = 1.0 / strata as f32;
            let wide = &mut self.done.two[k * film.pixel()..(k + 1) * film.pixel()];
            for (out, v) in wide.iter_mut().zip(&self.blocks.sum) {
                *out = v * n;
            }
            let narrow = &mut self.done.two_variance[k * film.slots..(k + 1) * film.slots];
            for (out, v) in narrow.iter_mut().zip(&self.blocks.square) {
                *out = v * n * n;
            }
            self.done.watched.two(k, &self.blocks.noise, n);
            if frame.split {
                let noise = &mut self.done.two_noise[k * film.slots..(k + 1) * film.slots];
                for (out, v) in noise.iter_mut().zip(&self.blocks.noise) {
                    *out = v * n;
                }
            }
            self.done.two_total_variance[k] = self.blocks.total_square * f64::from(n * n);
        }
        shut_out(&mut self.done.two_variance, film.slots);
        let variances = self.done.two_variance.chunks(film.slots);
        for (out, v) in self.done.pixel_variance.iter_mut().zip(variances) {
            out.0 = inside(film, v);
        }
        let Done {
            two_variance,
            pooling,
            ..
        } = &mut self.done;
        pool(two_variance, region, film.slots, TWO_REACH, pooling);
        Some(())
    }

    /// Makes one pass over the region. The grid of tiles that share vertices is shifted in each
    /// pass, so that no edge between them remains visible.
    fn pass(&mut self, frame: &Frame, region: &Region, pass: u32) {
        let (film, side) = (frame.film, frame.effort.side);
        let size = film.pixel();
        let start = u64::from(region.row) * u64::from(frame.width) + u64::from(region.col);
        let mut rng = Rng::new(frame.seed, Stream::Grid, start, u64::from(pass));
        let mut shift = || (rng.uniform() * side as f32) as u32;
        let (down, right) = (shift(), shift());
        let cuts = |shift: u32, length: u32| {
            let starts = (0..length).filter(move |i| *i == 0 || (i + shift).is_multiple_of(side));
            starts.map(move |i| (i, (side - (i + shift) % side).min(length - i)))
        };
        let mut all = 0.0f64;
        for (row, rows) in cuts(down, region.rows) {
            for (col, cols) in cuts(right, region.cols) {
                let count = (rows * cols) as usize;
                self.pass.clear();
                self.pass.resize(count * size, 0.0);
                let tile = Tile {
                    row: region.row + row,
                    col: region.col + col,
                    cols,
                    width: frame.width,
                    seed: frame.seed,
                    pass: u64::from(pass),
                    mirrors: &frame.sampling.refined,
                };
                self.sharing.pass(
                    (&frame.walk, film, &frame.effort),
                    &tile,
                    &mut self.scratch,
                    &mut self.pass,
                );
                for k in 0..count as u32 {
                    let (r, c) = (row + k / cols, col + k % cols);
                    let k = k as usize;
                    all += self.fold((r * region.cols + c) as usize, k, film);
                }
            }
        }
        self.done.all.push(all);
        self.done.passes += 1;
    }

    /// Adds pixel `from` of the pass to pixel `to` of the region. Returns its energy inside the
    /// gate.
    fn fold(&mut self, to: usize, from: usize, film: &Film) -> f64 {
        let size = film.pixel();
        let pass = &self.pass[from * size..(from + 1) * size];
        let sum = &mut self.done.sum[to * size..(to + 1) * size];
        for (sum, v) in sum.iter_mut().zip(pass) {
            *sum += v;
        }
        let pass = &pass[..film.slots];
        self.done.watched.add(to, self.done.passes, pass);
        if !self.done.alternating.is_empty() {
            // Held back until the next pass, so that the sum always has equally many of either
            // sign.
            let odd = self.done.passes % 2 == 1;
            let range = to * film.slots..(to + 1) * film.slots;
            let held = &mut self.held[range.clone()];
            let sum = &mut self.done.alternating[range];
            for ((sum, held), v) in sum.iter_mut().zip(held).zip(&pass[..film.slots]) {
                if odd {
                    *sum += *held - v;
                } else {
                    *held = *v;
                }
            }
        }
        let square = &mut self.done.square[to * film.slots..(to + 1) * film.slots];
        // Eight independent sums: precise enough, and the compiler can store them in one register.
        let mut totals = [0.0f32; 8];
        for (square, v) in square.iter_mut().zip(pass) {
            *square += v * v;
        }
        for chunk in pass[1..film.slots - 1].chunks(8) {
            for (t, v) in totals.iter_mut().zip(chunk) {
                *t += v;
            }
        }
        let total: f64 = totals.iter().map(|&t| f64::from(t)).sum();
        total
    }
}
