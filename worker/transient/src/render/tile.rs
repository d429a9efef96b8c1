//! One tile of the image, from the first pass to finished histograms. A tile is the unit of work of
//! one thread. Its random numbers depend only on its pixels and the pass, so tiles may be rendered
//! in any order.

use crate::{
    film::{blocks::Blocks, slots::Film},
    numeric::rng::{Rng, Stream},
    paths::{
        path_reuse::{sharing::Sharing, tile::Tile},
        scratch::Scratch,
        two_bounce::Strata,
    },
    render::{
        done::{Done, inside},
        frame::Frame,
        pooling::{TWO_REACH, pool, shut_out},
        region::Region,
    },
};

/// The passes to make: the number of the first one, and the count.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Order {
    pub first: u32,
    pub count: u32,
    /// Whether the two-bounce part is sampled. Otherwise it is empty.
    pub two: bool,
}

/// Renders one tile after another and reuses its buffers. There is one per thread.
pub(crate) struct TileRenderer {
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
