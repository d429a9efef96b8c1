//! Light paths drawn into the image: what they bring where the camera sees their end. They cross tiles,
//! so they are an estimate of their own beside the tiles', made of as many passes as the image's.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    error::{MULTI_REACH, Spread, Stat, estimate, pool},
    image::{Image, Watch, zeros},
    region::Region,
    tile::Frame,
};
use crate::{
    api::{ErrorEstimate, RenderError, Stop},
    caustic::{Caustics, Splat, splat},
    rng::{Rng, Stream},
};

/// Light paths of a pass for each pixel.
const PATHS: f64 = 4.0;
/// Light paths that one random stream makes.
const CHUNK: u32 = 1024;

/// Sums over passes, in render units.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Splats {
    /// Σ, `[pixel]` as [`crate::film::Film::pixel`] slots.
    sum: Vec<f32>,
    /// Σ of squares, channel 0.
    square: Vec<f32>,
    /// Σ with alternating sign, channel 0; empty where not wanted.
    alternating: Vec<f32>,
    /// Energy of the whole image by pass.
    all: Vec<f64>,
    passes: u32,
}

impl Splats {
    pub fn new(frame: &Frame) -> Result<Self, RenderError> {
        let [sum, square, alternating] = Self::lengths(frame);
        let zeros = |count| zeros(count, "the sums over light paths");
        Ok(Self {
            sum: zeros(sum)?,
            square: zeros(square)?,
            alternating: zeros(alternating)?,
            all: vec![],
            passes: 0,
        })
    }

    /// Of the three sums.
    fn lengths(frame: &Frame) -> [usize; 3] {
        let pixels = frame.width as usize * frame.height as usize;
        let narrow = pixels * frame.film.slots;
        let alternating = if frame.split { narrow } else { 0 };
        [pixels * frame.film.pixel(), narrow, alternating]
    }

    /// Whether they were made for such an image.
    pub fn fits(&self, frame: &Frame) -> bool {
        [self.sum.len(), self.square.len(), self.alternating.len()] == Self::lengths(frame)
    }

    /// `wave` more passes; returns the rays traced.
    pub fn round(
        &mut self,
        (frame, caustics): (&Frame, &Caustics),
        wave: u32,
        watch: &Watch,
    ) -> Result<u64, RenderError> {
        let within = frame.walk.surroundings();
        let pixels = f64::from(frame.width) * f64::from(frame.height);
        let count = (pixels * PATHS).clamp(f64::from(CHUNK), f64::from(1 << 22)) as u32;
        let mut rays = 0;
        for _ in 0..wave {
            let pass = u64::from(self.passes);
            let found: Vec<(Vec<Splat>, u64)> = (0..count.div_ceil(CHUNK))
                .into_par_iter()
                .map_init(
                    || within.world.bvh.stack(),
                    |stack, chunk| {
                        if !watch.go_on() {
                            return (vec![], 0);
                        }
                        let before = stack.rays;
                        let mut rng = Rng::new(frame.seed, Stream::Caustic, u64::from(chunk), pass);
                        let paths = chunk * CHUNK..count.min((chunk + 1) * CHUNK);
                        let (mut ends, mut splats) = (vec![], vec![]);
                        for l in paths {
                            ends.clear();
                            caustics.trace(&within, (l, count), &mut rng, stack, |z| ends.push(z));
                            let seen = ends.iter();
                            splats.extend(
                                seen.filter_map(|z| splat(within.world, frame.film, z, stack)),
                            );
                        }
                        (splats, stack.rays - before)
                    },
                )
                .collect();
            if watch.stopped() {
                return Err(RenderError::Stopped);
            }
            rays += found.iter().map(|f| f.1).sum::<u64>();
            let mut all: Vec<Splat> = found.into_iter().flat_map(|f| f.0).collect();
            self.add(frame, &mut all);
            if !watch.go_on() {
                return Err(RenderError::Stopped);
            }
        }
        Ok(rays)
    }

    /// Adds one pass.
    fn add(&mut self, frame: &Frame, splats: &mut [Splat]) {
        let film = frame.film;
        let (size, slots) = (film.pixel(), film.slots);
        // Stable: what falls into one slot is summed in the order of the paths.
        splats.sort_by_key(|s| (s.pixel, s.slot));
        let sign = if self.passes.is_multiple_of(2) {
            1.0
        } else {
            -1.0
        };
        let mut all = 0.0f64;
        for group in splats.chunk_by(|a, b| (a.pixel, a.slot) == (b.pixel, b.slot)) {
            let (pixel, slot) = (group[0].pixel as usize, group[0].slot as usize);
            let out = &mut self.sum[pixel * size..(pixel + 1) * size];
            let mut sum = 0.0f32;
            for s in group {
                film.add(out, slot, s.value, usize::from(s.spot));
                sum += s.value;
            }
            self.square[pixel * slots + slot] += sum * sum;
            if let Some(x) = self.alternating.get_mut(pixel * slots + slot) {
                *x += sign * sum;
            }
            if slot > 0 && slot + 1 < slots {
                all += f64::from(sum);
            }
        }
        self.all.push(all);
        self.passes += 1;
    }

    /// Mean, its variance, and a draw of its error, by pixel and bin, in metres; pooled as the tiles are.
    fn each(
        &self,
        frame: &Frame,
        stop: Stop,
        mut each: impl FnMut(usize, usize, [f64; 3]),
    ) -> Result<(), RenderError> {
        let slots = frame.film.slots;
        let n = f64::from(self.passes.max(1));
        let unit = unit(frame);
        // The alternating sum has n times a pass' variance, and the mean has 1/n of it.
        let noise = unit / n;
        let (width, size) = (frame.width as usize, frame.film.pixel());
        let rows = 16;
        let mut variance = vec![];
        for row in (0..frame.height).step_by(rows) {
            stop.check()?;
            let region = Region {
                row,
                col: 0,
                rows: (rows as u32).min(frame.height - row),
                cols: frame.width,
            };
            let first = row as usize * width;
            variance.clear();
            for pixel in first..first + region.pixels() {
                for slot in 0..slots {
                    let x = f64::from(self.sum[pixel * size + slot]);
                    let square = f64::from(self.square[pixel * slots + slot]);
                    let spread = (square - x * x / n).max(0.0) / (n - 1.0).max(1.0);
                    variance.push((spread / n) as f32);
                }
            }
            pool(&mut variance, &region, slots, MULTI_REACH);
            for k in 0..region.pixels() {
                let pixel = first + k;
                for slot in 1..slots - 1 {
                    let x = f64::from(self.sum[pixel * size + slot]);
                    let alternating = self.alternating.get(pixel * slots + slot);
                    let found = [
                        x * unit / n,
                        f64::from(variance[k * slots + slot]) * unit * unit,
                        alternating.map_or(0.0, |&x| f64::from(x) * noise),
                    ];
                    each(pixel, slot - 1, found);
                }
            }
        }
        Ok(())
    }

    /// The error of the image with these passes.
    pub fn estimate(
        &self,
        frame: &Frame,
        image: &Image,
        stop: Stop,
    ) -> Result<ErrorEstimate, RenderError> {
        let bins = frame.film.gate.bins as usize;
        let mut stats: Vec<Stat> = image.stats.clone();
        self.each(frame, stop, |pixel, bin, [mean, variance, _]| {
            let (stat, h) = (&mut stats[pixel], image.transient[pixel * bins + bin]);
            stat.norm2 += mean * (mean + 2.0 * f64::from(h));
            stat.total += mean;
            stat.multi_variance += variance;
        })?;
        let own = Spread::of(&self.all).scaled(unit(frame));
        Ok(estimate(
            &stats,
            image.total_spread.plus(own),
            image.mean_passes(),
        ))
    }

    /// Adds these passes to the finished image.
    pub fn join(&self, frame: &Frame, image: &mut Image, stop: Stop) -> Result<(), RenderError> {
        let film = frame.film;
        let bins = film.gate.bins as usize;
        self.each(frame, stop, |pixel, bin, [mean, variance, noise]| {
            let at = pixel * bins + bin;
            image.transient[at] += mean as f32;
            if let Some(s) = &mut image.split {
                s.multi[at] += mean as f32;
                let old = f64::from(s.multi_se[at]);
                s.multi_se[at] = (old * old + variance).sqrt() as f32;
                s.multi_noise[at] += noise as f32;
            }
        })?;
        let (size, slots) = (film.pixel(), film.slots);
        let factor = unit(frame) / f64::from(self.passes.max(1));
        for (pixel, sums) in self.sum.chunks(size).enumerate() {
            if pixel % 1024 == 0 {
                stop.check()?;
            }
            for (group, sums) in image.groups.iter_mut().zip(sums.chunks(slots).skip(1)) {
                let out = &mut group[pixel * bins..(pixel + 1) * bins];
                for (out, &x) in out.iter_mut().zip(&sums[1..slots - 1]) {
                    *out += (f64::from(x) * factor) as f32;
                }
            }
            let outside = f64::from(sums[0]) + f64::from(sums[slots - 1]);
            image.overflow += outside * factor;
        }
        Ok(())
    }
}

/// Render units → metres: every path has one 1/d² left over.
fn unit(frame: &Frame) -> f64 {
    f64::from(frame.walk.world.scale) * f64::from(frame.walk.world.scale)
}
