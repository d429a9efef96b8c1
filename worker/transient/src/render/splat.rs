//! Light paths drawn into the image: what they bring where the camera sees their end. They cross tiles,
//! so they are an estimate of their own beside the tiles', made of as many passes as the image's.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    error::{MULTI_REACH, Pool, Spread, Stat, estimate, pool},
    image::{Image, Watch, zeros},
    region::Region,
    tile::Frame,
};
use crate::{
    api::{ErrorEstimate, RenderError, Stop},
    bvh::Stack,
    caustic::{Caustics, Splat, splat},
    contact::Contacts,
    rng::{Rng, Stream},
    turns::Turns,
};

/// Light paths by way of near-mirrors of a pass for each pixel.
const PATHS: f64 = 4.0;
/// Light paths that one random stream makes.
const CHUNK: u32 = 1024;
/// Light paths of a pass in all zones for each pixel, and in one zone at least and at most.
const ZONE_SHARE: u32 = 4;
const ZONE_PATHS: (u32, u32) = (256, 1024);
/// Rows of pixels whose sums are kept together.
const ROWS: u32 = 16;

/// Where light paths come from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sources<'a> {
    caustics: Option<&'a Caustics>,
    contacts: Option<&'a Contacts>,
}

impl<'a> Sources<'a> {
    /// Those of a scene; `None` where it needs none.
    pub fn of(frame: &Frame<'a>) -> Option<Self> {
        let (caustics, contacts) = (frame.walk.caustics, frame.walk.contacts);
        (caustics.is_some() || contacts.is_some()).then_some(Self { caustics, contacts })
    }
}

/// Sums over passes of one part of the image, in render units, by blocks of rows: `None` where nothing came.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Layer(Vec<Option<Rows>>);

/// Sums over some rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Rows {
    /// Σ, `[pixel]` as [`crate::film::Film::pixel`] slots.
    sum: Vec<f32>,
    /// Σ of squares, channel 0.
    square: Vec<f32>,
    /// Σ with alternating sign, channel 0; empty where not wanted.
    alternating: Vec<f32>,
}

impl Rows {
    /// Of the three sums of a block.
    fn lengths(frame: &Frame, block: usize) -> [usize; 3] {
        let pixels = region(frame, block).pixels();
        let narrow = pixels * frame.film.slots;
        let alternating = if frame.split { narrow } else { 0 };
        [pixels * frame.film.pixel(), narrow, alternating]
    }

    fn new(frame: &Frame, block: usize) -> Result<Self, RenderError> {
        let [sum, square, alternating] = Self::lengths(frame, block);
        let zeros = |count| zeros(count, "the sums over light paths");
        Ok(Self {
            sum: zeros(sum)?,
            square: zeros(square)?,
            alternating: zeros(alternating)?,
        })
    }

    fn fits(&self, frame: &Frame, block: usize) -> bool {
        let lengths = [self.sum.len(), self.square.len(), self.alternating.len()];
        lengths == Self::lengths(frame, block)
    }
}

/// The rows of a block.
fn region(frame: &Frame, block: usize) -> Region {
    let row = block as u32 * ROWS;
    Region {
        row,
        col: 0,
        rows: ROWS.min(frame.height - row),
        cols: frame.width,
    }
}

impl Layer {
    fn new(frame: &Frame) -> Self {
        Self(vec![None; frame.height.div_ceil(ROWS) as usize])
    }

    fn fits(&self, frame: &Frame) -> bool {
        let mut rows = self.0.iter().enumerate();
        self.0.len() == frame.height.div_ceil(ROWS) as usize
            && rows.all(|(block, r)| r.as_ref().is_none_or(|r| r.fits(frame, block)))
    }

    /// Adds a pass, sorted by pixel and slot; returns its energy within the gate.
    fn add(&mut self, frame: &Frame, splats: &[Splat], sign: f32) -> Result<f64, RenderError> {
        let film = frame.film;
        let (size, slots) = (film.pixel(), film.slots);
        let mut all = 0.0f64;
        for group in splats.chunk_by(|a, b| (a.pixel, a.slot) == (b.pixel, b.slot)) {
            let (pixel, slot) = (group[0].pixel as usize, group[0].slot as usize);
            let of_block = (ROWS * frame.width) as usize;
            let (block, pixel) = (pixel / of_block, pixel % of_block);
            let rows = match &mut self.0[block] {
                Some(rows) => rows,
                none => none.insert(Rows::new(frame, block)?),
            };
            let out = &mut rows.sum[pixel * size..(pixel + 1) * size];
            let mut sum = 0.0f32;
            for s in group {
                film.add(out, slot, s.value, usize::from(s.spot));
                sum += s.value;
            }
            rows.square[pixel * slots + slot] += sum * sum;
            if let Some(x) = rows.alternating.get_mut(pixel * slots + slot) {
                *x += sign * sum;
            }
            if slot > 0 && slot + 1 < slots {
                all += f64::from(sum);
            }
        }
        Ok(all)
    }

    /// Mean over `passes`, its variance, and a draw of its error, by pixel and bin, in metres; pooled as the tiles are.
    fn each(
        &self,
        frame: &Frame,
        passes: u32,
        stop: Stop,
        mut each: impl FnMut(usize, usize, [f64; 3]),
    ) -> Result<(), RenderError> {
        let slots = frame.film.slots;
        let n = f64::from(passes.max(1));
        let unit = unit(frame);
        // The alternating sum has n times a pass' variance, and the mean has 1/n of it.
        let noise = unit / n;
        let size = frame.film.pixel();
        let (mut variance, mut pooling) = (vec![], Pool::default());
        for (block, rows) in self.0.iter().enumerate() {
            stop.check()?;
            let Some(rows) = rows else { continue };
            let region = region(frame, block);
            let first = (region.row * frame.width) as usize;
            variance.clear();
            for pixel in 0..region.pixels() {
                for slot in 0..slots {
                    let x = f64::from(rows.sum[pixel * size + slot]);
                    let square = f64::from(rows.square[pixel * slots + slot]);
                    let spread = (square - x * x / n).max(0.0) / (n - 1.0).max(1.0);
                    variance.push((spread / n) as f32);
                }
            }
            pool(&mut variance, &region, slots, MULTI_REACH, &mut pooling);
            for pixel in 0..region.pixels() {
                for slot in 1..slots - 1 {
                    let x = f64::from(rows.sum[pixel * size + slot]);
                    let alternating = rows.alternating.get(pixel * slots + slot);
                    let found = [
                        x * unit / n,
                        f64::from(variance[pixel * slots + slot]) * unit * unit,
                        alternating.map_or(0.0, |&x| f64::from(x) * noise),
                    ];
                    each(first + pixel, slot - 1, found);
                }
            }
        }
        Ok(())
    }

    /// Adds the channels beyond 0, and what lies outside the gate, to the image.
    fn join(&self, frame: &Frame, passes: u32, image: &mut Image) {
        let (size, slots) = (frame.film.pixel(), frame.film.slots);
        let bins = frame.film.gate.bins as usize;
        let factor = unit(frame) / f64::from(passes.max(1));
        for (block, rows) in self.0.iter().enumerate() {
            let Some(rows) = rows else { continue };
            let first = (region(frame, block).row * frame.width) as usize;
            for (k, sums) in rows.sum.chunks(size).enumerate() {
                let pixel = first + k;
                for (group, sums) in image.groups.iter_mut().zip(sums.chunks(slots).skip(1)) {
                    let out = &mut group[pixel * bins..(pixel + 1) * bins];
                    for (out, &x) in out.iter_mut().zip(&sums[1..slots - 1]) {
                        *out += (f64::from(x) * factor) as f32;
                    }
                }
                let outside = f64::from(sums[0]) + f64::from(sums[slots - 1]);
                image.overflow += outside * factor;
            }
        }
    }
}

/// What light paths brought, over passes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Splats {
    /// Exactly two bounces.
    two: Layer,
    /// Three and more.
    multi: Layer,
    /// Energy of the whole image by pass.
    all: Vec<f64>,
    passes: u32,
}

impl Splats {
    pub fn new(frame: &Frame) -> Self {
        Self {
            two: Layer::new(frame),
            multi: Layer::new(frame),
            all: vec![],
            passes: 0,
        }
    }

    /// Whether they were made for such an image.
    pub fn fits(&self, frame: &Frame) -> bool {
        self.two.fits(frame) && self.multi.fits(frame)
    }

    /// `wave` more passes; returns the rays traced.
    pub fn round(
        &mut self,
        (frame, sources): (&Frame, &Sources),
        wave: u32,
        watch: &Watch,
    ) -> Result<u64, RenderError> {
        let mut rays = 0;
        for _ in 0..wave {
            let mut all = vec![];
            if let Some(caustics) = sources.caustics {
                rays += self.by_mirrors((frame, caustics), watch, &mut all);
            }
            if let Some(contacts) = sources.contacts {
                rays += self.in_zones((frame, contacts), watch, &mut all);
            }
            if watch.stopped() {
                return Err(RenderError::Stopped);
            }
            self.add(frame, all)?;
            if !watch.go_on() {
                return Err(RenderError::Stopped);
            }
        }
        Ok(rays)
    }

    /// A pass of light paths by way of near-mirrors.
    fn by_mirrors(
        &self,
        (frame, caustics): (&Frame, &Caustics),
        watch: &Watch,
        all: &mut Vec<Splat>,
    ) -> u64 {
        let within = frame.walk.surroundings();
        let pixels = f64::from(frame.width) * f64::from(frame.height);
        let count = (pixels * PATHS).clamp(f64::from(CHUNK), f64::from(1 << 22)) as u32;
        let chunk = |stack: &mut Stack, chunk: u32, ends: &mut Vec<Splat>| {
            let pass = u64::from(self.passes);
            let mut rng = Rng::new(frame.seed, Stream::Caustic, u64::from(chunk), pass);
            let mut seen = vec![];
            for l in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                caustics.trace(&within, (l, count), &mut rng, stack, |z| seen.push(z));
                let found = seen.drain(..);
                ends.extend(found.filter_map(|z| splat(within.world, frame.film, &z, stack)));
            }
        };
        side_by_side(frame, count.div_ceil(CHUNK), watch, all, chunk)
    }

    /// A pass of light paths in the zones of spots beside other surfaces.
    fn in_zones(
        &self,
        (frame, contacts): (&Frame, &Contacts),
        watch: &Watch,
        all: &mut Vec<Splat>,
    ) -> u64 {
        let within = frame.walk.surroundings();
        let (least, most) = ZONE_PATHS;
        let share = frame.width * frame.height / ZONE_SHARE / contacts.count();
        let count = share.clamp(least, most);
        let zone = |stack: &mut Stack, zone: u32, ends: &mut Vec<Splat>| {
            let pass = u64::from(self.passes);
            let mut rng = Rng::new(frame.seed, Stream::Contact, u64::from(zone), pass);
            let turns = Turns::new(count, &mut rng);
            let mut seen = vec![];
            for l in 0..count {
                let at = (zone as usize, l, &turns);
                contacts.trace(&within, at, &mut rng, stack, |_, z| seen.push(z));
                let found = seen.drain(..);
                ends.extend(found.filter_map(|z| splat(within.world, frame.film, &z, stack)));
            }
        };
        side_by_side(frame, contacts.count(), watch, all, zone)
    }

    /// Adds one pass.
    fn add(&mut self, frame: &Frame, splats: Vec<Splat>) -> Result<(), RenderError> {
        let sign = if self.passes.is_multiple_of(2) {
            1.0
        } else {
            -1.0
        };
        let (mut two, mut multi): (Vec<_>, Vec<_>) =
            splats.into_iter().partition(|s| s.bounces == 2);
        let mut all = 0.0;
        for (layer, splats) in [(&mut self.two, &mut two), (&mut self.multi, &mut multi)] {
            // Stable: what falls into one slot is summed in the order of the paths.
            splats.sort_by_key(|s| (s.pixel, s.slot));
            all += layer.add(frame, splats, sign)?;
        }
        self.all.push(all);
        self.passes += 1;
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
        for layer in [&self.two, &self.multi] {
            layer.each(
                frame,
                self.passes,
                stop,
                |pixel, bin, [mean, variance, _]| {
                    let (stat, h) = (&mut stats[pixel], image.transient[pixel * bins + bin]);
                    stat.norm2 += mean * (mean + 2.0 * f64::from(h));
                    stat.total += mean;
                    // Of two bounces as well: it falls with the passes as that of more does.
                    stat.multi_variance += variance;
                },
            )?;
        }
        let own = Spread::of(&self.all).scaled(unit(frame));
        Ok(estimate(
            &stats,
            image.total_spread.plus(own),
            image.mean_passes(),
        ))
    }

    /// Adds these passes to the finished image.
    pub fn join(&self, frame: &Frame, image: &mut Image, stop: Stop) -> Result<(), RenderError> {
        let bins = frame.film.gate.bins as usize;
        for (layer, is_two) in [(&self.two, true), (&self.multi, false)] {
            layer.each(
                frame,
                self.passes,
                stop,
                |pixel, bin, [mean, variance, noise]| {
                    let at = pixel * bins + bin;
                    image.transient[at] += mean as f32;
                    if let Some(s) = &mut image.split {
                        let (value, se, draw) = match is_two {
                            true => (&mut s.two, &mut s.two_se, &mut s.two_noise),
                            false => (&mut s.multi, &mut s.multi_se, &mut s.multi_noise),
                        };
                        value[at] += mean as f32;
                        let old = f64::from(se[at]);
                        se[at] = (old * old + variance).sqrt() as f32;
                        draw[at] += noise as f32;
                    }
                },
            )?;
            layer.join(frame, self.passes, image);
        }
        Ok(())
    }
}

/// `count` pieces of a pass on all threads, joined in their order; returns the rays traced.
fn side_by_side(
    frame: &Frame,
    count: u32,
    watch: &Watch,
    all: &mut Vec<Splat>,
    piece: impl Fn(&mut Stack, u32, &mut Vec<Splat>) + Sync,
) -> u64 {
    let found: Vec<(Vec<Splat>, u64)> = (0..count)
        .into_par_iter()
        .map_init(
            || frame.walk.world.bvh.stack(),
            |stack, k| {
                let (mut splats, before) = (vec![], stack.rays);
                if watch.go_on() {
                    piece(stack, k, &mut splats);
                }
                (splats, stack.rays - before)
            },
        )
        .collect();
    let rays = found.iter().map(|f| f.1).sum();
    all.extend(found.into_iter().flat_map(|f| f.0));
    rays
}

/// Render units → metres: every path has one 1/d² left over.
fn unit(frame: &Frame) -> f64 {
    f64::from(frame.walk.world.scale) * f64::from(frame.walk.world.scale)
}
