//! Sums of the light paths' contributions to the image. They reach few of its bins, so only the
//! sums of those bins are stored, by pixel and slot.
//!
//! Contributions wait until there are enough of them, and are then merged with the sums pass by
//! pass. The bits therefore do not depend on the time of the merge, and the work per contribution
//! does not grow with the number of sums.

use std::ops::Range;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    api::{RenderError, Stop},
    film::splat::Splat,
    render::{
        draws::{Draw, Phases, Sums, is_watched, of_variance},
        frame::{Frame, unit},
        image::Image,
        pixel_light::{Found, Moments},
        pooling::{MULTI_REACH, Pool, pool},
        region::Region,
        sparse::{Sparse, Waiting},
    },
};

/// Rows of pixels per block of sums.
const ROWS: u32 = 16;

/// A block is merged when its waiting contributions reach `LEAST` plus 1/`SHARE` of the number of
/// its sums.
const LEAST: usize = 4096;
const SHARE: usize = 4;

/// Sums over passes of one part of the image, in render units, by blocks of rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Layer(Vec<Block>);

/// Sums over some rows.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Block {
    /// Sums of channel 0.
    pub all: Sparse<Moments>,
    /// Sums of the other channels. Their slots are consecutive by channel, as in
    /// [`crate::film::slots::Film::pixel`].
    pub groups: Sparse<f32>,
    /// Sums of channel 0 in the watched pixels.
    pub watched: Sparse<Sums>,
    #[serde(skip)]
    pub waiting: Vec<Waiting>,
}

/// Returns the rows of a block.
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
    pub fn new(frame: &Frame) -> Self {
        Self(vec![Block::default(); frame.height.div_ceil(ROWS) as usize])
    }

    /// Returns whether the layer was made for an image of this shape and is intact.
    pub fn fits(&self, frame: &Frame) -> bool {
        let (slots, size) = (frame.film.slots as u32, frame.film.pixel() as u32);
        let mut blocks = self.0.iter().enumerate();
        self.0.len() == frame.height.div_ceil(ROWS) as usize
            && blocks.all(|(k, block)| {
                let pixels = region(frame, k).pixels();
                block.all.fits(pixels, 0..slots)
                    && block.groups.fits(pixels, slots..size)
                    && block.watched.fits(pixels, 0..slots)
            })
    }

    /// Adds a pass, sorted by pixel and slot. Returns its energy within the gate.
    pub fn add(&mut self, frame: &Frame, splats: &[Splat], pass: u32) -> Result<f64, RenderError> {
        let of_block = ROWS * frame.width;
        let last = frame.film.slots - 1;
        let mut all = 0.0f64;
        for group in splats.chunk_by(|a, b| (a.pixel, a.slot) == (b.pixel, b.slot)) {
            if (1..last).contains(&(group[0].slot as usize)) {
                all += f64::from(group.iter().map(|s| s.value).sum::<f32>());
            }
        }
        for group in splats.chunk_by(|a, b| a.pixel / of_block == b.pixel / of_block) {
            let waiting = &mut self.0[(group[0].pixel / of_block) as usize].waiting;
            waiting.extend(group.iter().map(|s| Waiting {
                pixel: s.pixel % of_block,
                slot: s.slot,
                pass,
                value: s.value,
                spot: s.spot,
            }));
        }
        self.merge(frame, |block| {
            block.waiting.len() >= LEAST + block.all.slots.len() / SHARE
        })?;
        Ok(all)
    }

    /// Merges all waiting contributions.
    pub fn settle(&mut self, frame: &Frame) -> Result<(), RenderError> {
        self.merge(frame, |block| !block.waiting.is_empty())?;
        self.0.iter_mut().for_each(|b| b.waiting = vec![]);
        Ok(())
    }

    fn merge(
        &mut self,
        frame: &Frame,
        which: impl Fn(&Block) -> bool + Sync,
    ) -> Result<(), RenderError> {
        let blocks = self.0.par_iter_mut().enumerate();
        blocks
            .filter(|(_, block)| which(block))
            .try_for_each(|(k, block)| block.merge(frame, &region(frame, k)))
    }

    /// Calls `each` with the contributions to each pixel, over `passes`. Pixels in rows without
    /// contributions are skipped.
    pub fn each(
        &self,
        frame: &Frame,
        passes: u32,
        stop: Stop,
        mut each: impl FnMut(usize, &Found<'_>),
    ) -> Result<(), RenderError> {
        let slots = frame.film.slots;
        let n = f64::from(passes.max(1));
        let unit = unit(frame);
        let inside = 1..slots as u32 - 1;
        let phases = Phases::of(passes);
        let mut own = vec![];
        let (mut variance, mut pooling) = (vec![], Pool::default());
        for (block, sums) in self.0.iter().enumerate() {
            stop.check()?;
            let (watched, sums) = (&sums.watched, &sums.all);
            if sums.slots.is_empty() {
                continue;
            }
            let region = region(frame, block);
            let first = (region.row * frame.width) as usize;
            variance.clear();
            variance.resize(region.pixels() * slots, 0.0);
            own.clear();
            for (pixel, of_pixel) in variance.chunks_mut(slots).enumerate() {
                let (slots, values) = sums.of(pixel);
                let mut of_gate = 0.0;
                for (slot, [sum, square, _]) in slots.iter().zip(values) {
                    let (x, square) = (f64::from(*sum), f64::from(*square));
                    let spread = (square - x * x / n).max(0.0) / (n - 1.0).max(1.0);
                    of_pixel[*slot as usize] = (spread / n) as f32;
                    if inside.contains(slot) {
                        of_gate += spread / n;
                    }
                }
                own.push(of_gate);
            }
            pool(&mut variance, &region, slots, MULTI_REACH, &mut pooling);
            for (pixel, variance) in variance.chunks(slots).enumerate() {
                let (slots, values) = sums.of(pixel);
                let draw = is_watched(&region, pixel).then(|| match &phases {
                    Some(phases) => drawn(phases, watched.of(pixel), &inside),
                    None => of_variance(own[pixel]),
                });
                let found = Found {
                    slots,
                    values,
                    variance,
                    own: (
                        own[pixel] * unit * unit,
                        draw.map(|d| d.map(|square| square * unit * unit)),
                    ),
                    mean: (unit, n),
                    // The alternating sum has n times the variance of a pass, and the mean has 1/n
                    // of it.
                    noise: unit / n,
                    unit,
                };
                each(first + pixel, &found);
            }
        }
        Ok(())
    }

    /// Adds the channels beyond 0, and the light outside the gate, to the image.
    pub fn join(&self, frame: &Frame, passes: u32, image: &mut Image) {
        let slots = frame.film.slots;
        let bins = frame.film.gate.bins as usize;
        let factor = unit(frame) / f64::from(passes.max(1));
        for (block, sums) in self.0.iter().enumerate() {
            let region = region(frame, block);
            let first = (region.row * frame.width) as usize;
            for k in 0..region.pixels() {
                let pixel = first + k;
                let (of_groups, values) = sums.groups.of(k);
                for (at, x) in of_groups.iter().zip(values) {
                    let (group, slot) = (*at as usize / slots - 1, *at as usize % slots);
                    if (1..slots - 1).contains(&slot) {
                        let out = &mut image.groups[group][pixel * bins + slot - 1];
                        *out += (f64::from(*x) * factor) as f32;
                    }
                }
                let (of_all, values) = sums.all.of(k);
                let outside: f64 = of_all
                    .iter()
                    .zip(values)
                    .filter(|(slot, _)| !(1..slots - 1).contains(&(**slot as usize)))
                    .map(|(_, v)| f64::from(v[0]))
                    .sum();
                image.overflow += outside * factor;
            }
        }
    }
}

impl Block {
    /// Merges the waiting contributions with the sums of their rows.
    pub fn merge(&mut self, frame: &Frame, region: &Region) -> Result<(), RenderError> {
        let pixels = region.pixels();
        let film = frame.film;
        let split = frame.split;
        let by_place = |w: &Waiting| (w.pixel, w.slot);
        if film.channels > 1 {
            let mut of_groups: Vec<Waiting> = vec![];
            for w in &self.waiting {
                let channels = film.of_spot[usize::from(w.spot)].iter();
                of_groups.extend(channels.map(|&channel| Waiting {
                    slot: u32::from(channel) * film.slots as u32 + w.slot,
                    ..*w
                }));
            }
            of_groups.sort_by_key(by_place);
            self.groups.take(pixels, &of_groups, |value, group| {
                group.iter().for_each(|w| *value += w.value);
            })?;
        }
        // Stable: what falls into one slot is summed in the order of the passes, and of the paths.
        self.waiting.sort_by_key(by_place);
        let add = |[sum, square, alternating]: &mut Moments, group: &[Waiting]| {
            for pass in group.chunk_by(|a, b| a.pass == b.pass) {
                let mut of_pass = 0.0f32;
                for w in pass {
                    *sum += w.value;
                    of_pass += w.value;
                }
                *square += of_pass * of_pass;
                if split {
                    let even = pass[0].pass.is_multiple_of(2);
                    *alternating += if even { of_pass } else { -of_pass };
                }
            }
        };
        self.all.take(pixels, &self.waiting, add)?;
        self.waiting
            .retain(|w| is_watched(region, w.pixel as usize));
        self.watched.take(pixels, &self.waiting, add_phases)?;
        self.waiting.clear();
        Ok(())
    }
}

/// Adds the waiting contributions to one slot of a watched pixel.
fn add_phases(sums: &mut Sums, group: &[Waiting]) {
    group
        .iter()
        .for_each(|w| sums[Phases::phase(w.pass)] += w.value);
}

/// Returns draws of a watched pixel's error, in render units², from its slots inside the gate.
fn drawn(phases: &Phases, (slots, sums): (&[u32], &[Sums]), inside: &Range<u32>) -> Draw {
    let mut draw = Draw::default();
    let each = slots.iter().zip(sums);
    for (_, sums) in each.filter(|(slot, _)| inside.contains(slot)) {
        phases.add(*sums, &mut draw);
    }
    draw
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use crate::numeric::rng::Rng;
    use crate::numeric::rng::Stream;
    use crate::render::draws::Draw;
    use crate::render::draws::Phases;
    use crate::render::draws::Sums;
    use crate::render::layer::add_phases;
    use crate::render::layer::drawn;
    use crate::render::sparse::Sparse;
    use crate::render::sparse::Waiting;

    const PIXELS: usize = 5;
    const SLOTS: usize = 7;

    fn waiting(pass: u32, (pixel, slot, value): (u32, u32, f32)) -> Waiting {
        Waiting {
            pixel,
            slot,
            pass,
            value,
            spot: 0,
        }
    }

    /// Merges `found` in pieces that end at `cuts`.
    fn merged(found: &[Waiting], cuts: &[usize]) -> Sparse<f32> {
        let mut sums = Sparse::default();
        let mut from = 0;
        for &to in cuts.iter().chain([&found.len()]) {
            let to = to.clamp(from, found.len());
            let mut piece = found[from..to].to_vec();
            piece.sort_by_key(|w| (w.pixel, w.slot));
            let add = |sum: &mut f32, group: &[Waiting]| {
                group.iter().for_each(|w| *sum += w.value);
            };
            sums.take(PIXELS, &piece, add).expect("there is room");
            from = to;
        }
        sums
    }

    proptest! {
        #[test]
        fn sums_are_those_of_every_bin_whenever_they_are_merged(
            found in prop::collection::vec((0..PIXELS as u32, 0..SLOTS as u32, 0.1f32..9.0), 0..80),
            mut cuts in prop::collection::vec(0usize..80, 0..6),
        ) {
            cuts.sort_unstable();
            let found: Vec<Waiting> = found.into_iter().map(|w| waiting(0, w)).collect();
            let mut every = [[0.0f32; SLOTS]; PIXELS];
            for w in &found {
                every[w.pixel as usize][w.slot as usize] += w.value;
            }
            let sums = merged(&found, &cuts);
            prop_assert!(sums.fits(PIXELS, 0..SLOTS as u32));
            prop_assert_eq!(&sums, &merged(&found, &[]));
            for (pixel, row) in every.iter().enumerate() {
                let (slots, values) = sums.of(pixel);
                let mut of_slot = [0.0f32; SLOTS];
                for (slot, value) in slots.iter().zip(values) {
                    of_slot[*slot as usize] = *value;
                }
                // The values agree to the bit.
                prop_assert_eq!(&of_slot, row);
            }
        }
    }

    #[test]
    fn draws_of_a_watched_pixel_have_the_variance_of_its_mean() {
        // Every slot of each of eight passes has light, and the draws contain everything except the
        // mean.
        let passes = 8;
        let mut rng = Rng::new(1, Stream::Caustic, 0, 0);
        let values: Vec<[f32; SLOTS]> = (0..passes)
            .map(|_| std::array::from_fn(|_| rng.uniform()))
            .collect();
        let mut watched = Sparse::<Sums>::default();
        for (pass, of_pass) in values.iter().enumerate() {
            let found: Vec<Waiting> = (0u32..)
                .zip(of_pass)
                .map(|(slot, &value)| waiting(pass as u32, (2, slot, value)))
                .collect();
            watched.take(PIXELS, &found, add_phases).unwrap();
        }
        let phases = Phases::of(passes as u32).unwrap();
        let draw = drawn(&phases, watched.of(2), &(0..SLOTS as u32));
        let n = f64::from(passes);
        let variance: f64 = (0..SLOTS)
            .map(|slot| {
                let at = || values.iter().map(|v| f64::from(v[slot]));
                let mean = at().sum::<f64>() / n;
                at().map(|x| (x - mean).powi(2)).sum::<f64>() / (n * (n - 1.0))
            })
            .sum();
        let mean = draw.iter().sum::<f64>() / draw.len() as f64;
        assert!((mean / variance - 1.0).abs() < 1e-5, "{mean} {variance}");
        // Light outside the gate does not count, and a pixel without light has no error.
        let inside = drawn(&phases, watched.of(2), &(1..SLOTS as u32 - 1));
        assert!(inside.iter().sum::<f64>() < draw.iter().sum::<f64>());
        assert_eq!(
            drawn(&phases, watched.of(0), &(0..SLOTS as u32)),
            Draw::default()
        );
    }

    #[test]
    fn sums_that_are_not_whole_do_not_fit() {
        let whole = Sparse {
            starts: vec![0, 2, 2, 3],
            slots: vec![1, 4, 0],
            values: vec![1.0f32; 3],
        };
        assert!(whole.fits(3, 0..5));
        assert!(Sparse::<f32>::default().fits(3, 0..5));
        let broken = |change: &dyn Fn(&mut Sparse<f32>)| {
            let mut sums = whole.clone();
            change(&mut sums);
            !sums.fits(3, 0..5)
        };
        assert!(!whole.fits(2, 0..5) && !whole.fits(3, 0..4) && !whole.fits(3, 1..5));
        assert!(broken(&|s| s.starts = vec![]));
        assert!(broken(&|s| s.starts[1] = 3));
        assert!(broken(&|s| s.starts[0] = 1));
        assert!(broken(&|s| s.starts[3] = 9));
        assert!(broken(&|s| s.slots.swap(0, 1)));
        assert!(broken(&|s| s.slots[1] = 1));
        assert!(broken(&|s| s.values.truncate(2)));
    }
}
