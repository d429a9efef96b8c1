//! One round over the image: every pixel gets its two-bounce samples and a number of camera paths, and
//! is blended into what earlier rounds found. Work is handed out in runs of pixels of one row, which are
//! contiguous in memory; a pixel's random numbers depend on the pixel and the round alone.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::{
    api::{Overflow, Progress, RenderError},
    film::Pixel,
    multi::{Paths, Walk},
    rng::{Rng, Stream},
    two::{self, Sampling, Scratch},
};

/// Pixels handed out at a time.
const RUN: usize = 32;
/// Pixels and paths of the pilot that sizes [`crate::Budget::Error`].
const PILOT_PIXELS: usize = 256;
pub(super) const PILOT_PATHS: u32 = 32;

/// Paths that share light vertices, and light vertices drawn for each.
const BATCH: u32 = 8;
const LIGHTS_A_PATH: u32 = 2;

/// Everything a round needs to know.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame<'a> {
    pub walk: Walk<'a>,
    pub sampling: &'a Sampling,
    pub seed: u64,
    pub width: u32,
    pub height: u32,
}

/// A pixel's sums for the error estimate.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Stat {
    /// Σ over bins of h².
    pub norm2: f64,
    /// Σ over bins of the two-bounce part's variance.
    pub two_variance: f64,
    /// Σ over bins of the 3+ part's variance.
    pub multi_variance: f64,
    /// Σ over bins of h.
    pub total: f64,
    /// Variance of that sum.
    pub total_variance: f64,
}

/// The parts with their standard errors.
#[derive(Debug)]
pub(super) struct Parts {
    pub two: Vec<f32>,
    pub two_se: Vec<f32>,
    pub multi: Vec<f32>,
    pub multi_se: Vec<f32>,
}

/// What rounds fill.
#[derive(Debug)]
pub(super) struct Buffers {
    pub transient: Vec<f32>,
    pub split: Option<Parts>,
    pub stats: Vec<Stat>,
    bins: usize,
}

impl Buffers {
    pub fn new(pixels: usize, bins: usize, split: bool) -> Self {
        let empty = || vec![0.0f32; pixels * bins];
        Self {
            transient: empty(),
            split: split.then(|| Parts {
                two: empty(),
                two_se: empty(),
                multi: empty(),
                multi_se: empty(),
            }),
            stats: vec![Stat::default(); pixels],
            bins,
        }
    }
}

/// The part of the buffers that one run writes.
struct Run<'a> {
    first: usize,
    transient: &'a mut [f32],
    split: Option<[&'a mut [f32]; 4]>,
    stats: &'a mut [Stat],
}

/// What a round found besides the histograms.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Found {
    outside: Overflow,
    pub rays: u64,
}

impl Found {
    /// Joins this round's overflow (of weight `wave`) to that of earlier ones (of weight `spent`).
    pub fn blend(&self, earlier: &Overflow, spent: u32, wave: u32) -> Overflow {
        let new = share(spent, wave);
        Overflow {
            count: earlier.count + self.outside.count,
            energy: earlier.energy * (1.0 - new) + self.outside.energy * new,
            share: 0.0,
        }
    }
}

/// Weight of a round of `wave` paths after `spent` earlier ones.
fn share(spent: u32, wave: u32) -> f64 {
    if spent == 0 {
        1.0
    } else {
        f64::from(wave) / (f64::from(spent) + f64::from(wave))
    }
}

/// Tells the caller how far the render is and hears whether to stop.
pub(super) struct Watch<'a> {
    progress: &'a dyn Progress,
    stopped: AtomicBool,
    runs: AtomicUsize,
    before: f32,
    total: f32,
}

impl<'a> Watch<'a> {
    /// A watch over the round that takes the render from `spent` to `total` paths.
    pub fn new(progress: &'a dyn Progress, spent: u32, total: u32) -> Self {
        Self {
            progress,
            stopped: AtomicBool::new(false),
            runs: AtomicUsize::new(0),
            before: spent as f32,
            total: total.max(1) as f32,
        }
    }

    /// Notes one finished run of `count`; false to stop.
    fn tick(&self, count: usize) -> bool {
        self.runs.fetch_add(1, Ordering::Relaxed);
        self.ask(count)
    }

    /// False to stop. Asked for each pixel, since a run of many paths takes long.
    fn ask(&self, count: usize) -> bool {
        let done = self.runs.load(Ordering::Relaxed);
        let before = self.before / self.total;
        let at = before + (1.0 - before) * done as f32 / count as f32;
        if !self.progress.at(at.min(1.0)) {
            self.stopped.store(true, Ordering::Relaxed);
        }
        !self.stopped.load(Ordering::Relaxed)
    }
}

/// Buffers of one worker.
struct Bench {
    scratch: Scratch,
    two: Pixel,
    paths: Paths,
}

/// How many of what a pixel got.
#[derive(Debug, Clone, Copy)]
struct Counts {
    strata: u32,
    paths: u32,
    batches: u32,
}

impl Bench {
    fn new(frame: &Frame) -> Self {
        let walk = &frame.walk;
        Self {
            scratch: Scratch::new(walk.world, walk.emitters, walk.gate),
            two: Pixel::new(walk.gate.bins),
            paths: Paths::new(walk.mirrors, walk.gate),
        }
    }

    /// Fills `two` and `paths.pixel`.
    fn pixel(&mut self, frame: &Frame, k: usize, pass: (u32, u32), out: &mut Overflow) -> Counts {
        let walk = &frame.walk;
        let (row, col) = (k as u32 / frame.width, k as u32 % frame.width);
        let (before, paths) = pass;
        self.two.clear();
        self.paths.pixel.clear();
        let mut counts = Counts {
            strata: 1,
            paths,
            batches: 0,
        };
        if walk.max_bounces >= 2 && !walk.emitters.list.is_empty() {
            let (coarse, fine) = frame.sampling.sides(paths);
            let side = if frame.sampling.refined[k] {
                fine
            } else {
                coarse
            };
            let mut rng = Rng::new(frame.seed, Stream::Two, k as u64, u64::from(before));
            counts.strata = two::sample_pixel(
                walk.world,
                walk.emitters,
                walk.gate,
                (row, col, side),
                &mut rng,
                &mut self.scratch,
                (&mut self.two, &mut *out),
            );
        }
        // Paths of a batch share light vertices; batches are independent.
        let batch = (paths / 8).clamp(1, BATCH);
        let mut done = 0;
        while done < paths {
            let now = batch.min(paths - done);
            let pass = u64::from(before) + u64::from(done);
            let mut rng = Rng::new(frame.seed, Stream::Paths, k as u64, pass);
            let lights = LIGHTS_A_PATH * now;
            self.paths.pool.fill(
                walk.world,
                walk.emitters,
                lights,
                &mut rng,
                &mut self.scratch.stack,
            );
            for _ in 0..now {
                let (x, y) = (col as f32 + rng.uniform(), row as f32 + rng.uniform());
                walk.path(&mut rng, x, y, &mut self.scratch, &mut self.paths);
            }
            self.scratch.unit.finish(&mut self.paths.pixel);
            done += now;
            counts.batches += 1;
        }
        out.take(&mut self.scratch.unit, paths.max(1));
        counts
    }
}

/// Renders every pixel once more with `pass` = (paths spent before, paths now).
pub(super) fn round(
    frame: &Frame,
    buffers: &mut Buffers,
    pass: (u32, u32),
    watch: &Watch,
) -> Result<Found, RenderError> {
    let bins = buffers.bins;
    let stride = RUN * bins;
    // Runs end with their row.
    let width = frame.width as usize;
    let mut parts = buffers.split.as_mut().map(|s| {
        [&mut s.two, &mut s.two_se, &mut s.multi, &mut s.multi_se]
            .map(|v| cut(v, width * bins, stride))
    });
    let transient = cut(&mut buffers.transient, width * bins, stride);
    let stats = cut(&mut buffers.stats, width, RUN);
    let mut runs = vec![];
    let mut first = 0;
    for (transient, stats) in transient.into_iter().zip(stats) {
        let split = parts.as_mut().map(|p| {
            p.each_mut()
                .map(|v| v.next().expect("all buffers are cut alike"))
        });
        let count = stats.len();
        runs.push(Run {
            first,
            transient,
            split,
            stats,
        });
        first += count;
    }
    let count = runs.len();
    let found: Vec<Option<Found>> = runs
        .into_par_iter()
        .map_init(
            || Bench::new(frame),
            |bench, run| {
                if watch.stopped.load(Ordering::Relaxed) {
                    return None;
                }
                let found = render_run(frame, bench, run, pass, bins, &|| watch.ask(count))?;
                watch.tick(count).then_some(found)
            },
        )
        .collect();
    let mut sum = Found::default();
    for f in found {
        let f = f.ok_or(RenderError::Stopped)?;
        sum.rays += f.rays;
        sum.outside.count += f.outside.count;
        sum.outside.energy += f.outside.energy;
    }
    Ok(sum)
}

/// Cuts a buffer into rows and those into runs.
fn cut<T>(buffer: &mut [T], row: usize, run: usize) -> std::vec::IntoIter<&mut [T]> {
    let runs: Vec<&mut [T]> = buffer
        .chunks_mut(row)
        .flat_map(|r| r.chunks_mut(run))
        .collect();
    runs.into_iter()
}

/// Renders the pixels of one run; `None` when `go_on` says to stop.
fn render_run(
    frame: &Frame,
    bench: &mut Bench,
    run: Run,
    pass: (u32, u32),
    bins: usize,
    go_on: &dyn Fn() -> bool,
) -> Option<Found> {
    let mut found = Found::default();
    let rays = bench.scratch.stack.rays;
    let new = share(pass.0, pass.1);
    let (a, b) = (1.0 - new, new);
    // Render units → metres: every path has one 1/d² left over.
    let unit = f64::from(frame.walk.world.scale) * f64::from(frame.walk.world.scale);
    let mut split = run.split;
    for (i, stat) in run.stats.iter_mut().enumerate() {
        if !go_on() {
            return None;
        }
        let counts = bench.pixel(frame, run.first + i, pass, &mut found.outside);
        let moments = Moments::new(bench, counts, unit);
        let range = i * bins..(i + 1) * bins;
        let transient = &mut run.transient[range.clone()];
        let mut sums = Stat::default();
        for (k, h) in transient.iter_mut().enumerate() {
            let [two, two_variance, multi, multi_variance] = moments.bin(bench, k);
            *h = (f64::from(*h) * a + (two + multi) * b) as f32;
            sums.norm2 += f64::from(*h) * f64::from(*h);
            sums.total += f64::from(*h);
            sums.two_variance += two_variance;
            sums.multi_variance += multi_variance;
            if let Some(s) = &mut split {
                let at = range.start + k;
                let mean = |old: f32, x: f64| (f64::from(old) * a + x * b) as f32;
                let error = |old: f32, x: f64| {
                    let old = f64::from(old) * a;
                    (old * old + x * b * b).sqrt() as f32
                };
                s[0][at] = mean(s[0][at], two);
                s[1][at] = error(s[1][at], two_variance);
                s[2][at] = mean(s[2][at], multi);
                s[3][at] = error(s[3][at], multi_variance);
            }
        }
        stat.norm2 = sums.norm2;
        stat.total = sums.total;
        let blend = |old: f64, x: f64| old * a * a + x * b * b;
        stat.two_variance = blend(stat.two_variance, sums.two_variance);
        stat.multi_variance = blend(stat.multi_variance, sums.multi_variance);
        stat.total_variance = blend(stat.total_variance, moments.total_variance);
    }
    found.outside.energy *= unit;
    found.rays = bench.scratch.stack.rays - rays;
    Some(found)
}

/// From a pixel's sums to means and variances in physical units.
struct Moments {
    strata: f64,
    paths: f64,
    batches: f64,
    unit: f64,
    total_variance: f64,
}

impl Moments {
    fn new(bench: &Bench, counts: Counts, unit: f64) -> Self {
        let mut m = Self {
            strata: f64::from(counts.strata),
            paths: f64::from(counts.paths),
            batches: f64::from(counts.batches),
            unit,
            total_variance: 0.0,
        };
        let multi = &bench.paths.pixel;
        let total: f64 = multi.sum.iter().map(|&v| f64::from(v)).sum();
        m.total_variance = bench.two.total_square / (m.strata * m.strata) * unit * unit
            + m.of_batches(total, multi.total_square).1;
        m
    }

    /// Mean over paths and its variance from Σx and Σx² over the batches.
    fn of_batches(&self, sum: f64, square: f64) -> (f64, f64) {
        if self.paths == 0.0 {
            return (0.0, 0.0);
        }
        let n = self.batches;
        let spread = if n > 1.0 {
            (square - sum * sum / n).max(0.0) * n / (n - 1.0)
        } else {
            square
        };
        let scale = self.unit / self.paths;
        (sum * scale, spread * scale * scale)
    }

    /// Two-bounce mean and variance, 3+ mean and variance.
    fn bin(&self, bench: &Bench, k: usize) -> [f64; 4] {
        let n = self.strata;
        let two = f64::from(bench.two.sum[k]) / n * self.unit;
        let two_variance = f64::from(bench.two.square[k]) / (n * n) * self.unit * self.unit;
        let (sum, square) = (bench.paths.pixel.sum[k], bench.paths.pixel.square[k]);
        let (multi, variance) = self.of_batches(f64::from(sum), f64::from(square));
        [two, two_variance, multi, variance]
    }
}

/// Renders a lattice of pixels with few paths, to see how many the image needs.
pub(super) fn pilot(frame: &Frame) -> Vec<Stat> {
    let (width, height) = (frame.width as usize, frame.height as usize);
    let mut stride = 1;
    while (width / (stride + 1)).max(1) * (height / (stride + 1)).max(1) >= PILOT_PIXELS {
        stride += 1;
    }
    let half = stride / 2;
    let pixels: Vec<usize> = (half..height)
        .step_by(stride)
        .flat_map(|row| {
            (half..width)
                .step_by(stride)
                .map(move |col| row * width + col)
        })
        .collect();
    // Passes from the far end of the range, so that no render repeats the pilot's random numbers.
    let pass = (u32::MAX - PILOT_PATHS, PILOT_PATHS);
    pixels
        .into_par_iter()
        .map_init(
            || Bench::new(frame),
            |bench, k| {
                let counts = bench.pixel(frame, k, pass, &mut Overflow::default());
                let moments = Moments::new(bench, counts, 1.0);
                let mut stat = Stat::default();
                for b in 0..frame.walk.gate.bins as usize {
                    let [two, two_variance, multi, multi_variance] = moments.bin(bench, b);
                    stat.norm2 += (two + multi) * (two + multi);
                    stat.two_variance += two_variance;
                    stat.multi_variance += multi_variance;
                }
                stat
            },
        )
        .collect()
}
