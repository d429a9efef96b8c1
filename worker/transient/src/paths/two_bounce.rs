//! Exactly two bounces: stratified sub-pixel samples, each connected to every spot, a whole pixel's
//! samples at once. No random walk. If beams have a width, each sample takes one ray, in turn, for
//! all beams.

use picofarm_scene::Vec3;

use crate::{
    api::Stop,
    film::{blocks::Blocks, slots::Film},
    light::emitters::Emitters,
    numeric::rng::Rng,
    paths::{scratch::Scratch, tracer::Walk},
    scene::{
        centres::Centres, hit::Hit, intersection::lift, lobes::Seen, segments::Segments,
        world::World,
    },
};

/// Exponent of the strata per side in the pixel width, for narrow pixels. 6×6 strata, versus 4×4,
/// at 256×256 (8 to 24 passes): error² × CPU time 0.70 to 0.92 in furnished rooms of 1 to 25 spots,
/// 1.05 with 100.
const NARROW_PIXELS: f32 = 0.1;

/// Returns the strata per side that go with 16 camera paths, for pixels of this width at unit
/// distance: eight for a width of 1/32 (64 pixels over 90°). Wider pixels straddle more bins and
/// get more strata, growing with the square root of the width. In narrower pixels a spot's light
/// falls into one or two bins, which is no easier to sample, so they get nearly as many strata.
fn strata(pixel: f32) -> f32 {
    match pixel * 128.0 {
        wide if wide >= 4.0 => 4.0 * wide.sqrt(),
        narrow => 8.0 * libm::powf(narrow / 4.0, NARROW_PIXELS),
    }
}

/// The sampling density of pixels.
#[derive(Debug, Clone)]
pub(crate) struct Sampling {
    /// Strata per side in an ordinary pixel that go with 16 camera paths, before rounding.
    base: f32,
    /// Row-major: the pixel or one of its neighbours shows a mirror or is in a mirror spot's beam.
    /// Decided from the centres alone, hence independent of the samples: no bias.
    pub refined: Vec<bool>,
}

impl Sampling {
    pub fn plan(world: &World, emitters: &Emitters, centres: &Centres, stop: Stop) -> Self {
        let i = world.camera.intrinsics;
        let base = strata(world.sensitive / i.fx.min(i.fy));
        let narrow = |k: usize| {
            centres.hits[k].as_ref().is_some_and(|h| {
                h.surface.specular()
                    || emitters.on_mirror.iter().any(|&e| {
                        let e = &emitters.list[e];
                        e.intensity((h.p - e.p).normalized()) > 0.0
                    })
            })
        };
        let (width, height) = (i.width as usize, i.height as usize);
        let goes_on = |row: &usize| !row.is_multiple_of(64) || !stop.asked();
        let rows = (0..height).take_while(goes_on);
        let mut marked: Vec<bool> = rows
            .flat_map(|row| row * width..(row + 1) * width)
            .map(narrow)
            .collect();
        marked.resize(width * height, false);
        let refined = (0..width * height)
            .map(|k| {
                let (row, col) = (k / width, k % width);
                let rows = row.saturating_sub(1)..=(row + 1).min(height - 1);
                rows.into_iter().any(|r| {
                    let cols = col.saturating_sub(1)..=(col + 1).min(width - 1);
                    cols.into_iter().any(|c| marked[r * width + c])
                })
            })
            .collect();
        Self { base, refined }
    }

    /// Returns the strata per side (even) in ordinary pixels and in those that may see a narrow
    /// lobe.
    ///
    /// They grow with the passes so that neither part of the histogram is much noisier than the
    /// other. Below eight passes they are those of eight, because they cost little in comparison.
    /// `passes` = 0 is a render of two bounces only.
    pub fn sides(&self, passes: u32) -> (u32, u32) {
        let passes = if passes == 0 { 64 } else { passes.max(8) };
        let side = self.base * libm::powf(passes as f32 / 16.0, 0.4);
        let side = 2 * (0.5 * side).round().clamp(1.0, 16.0) as u32;
        (side, (4 * side).min(64))
    }

    /// Returns the relative two-bounce variance after `passes`. It falls as n^(−3/2) for n strata,
    /// because half of it is on edges between bins.
    pub fn variance(&self, passes: u32) -> f64 {
        let side = f64::from(self.sides(passes).0);
        1.0 / (side * side * side)
    }

    /// Returns the weight of the strata of `wave` passes when combined with earlier ones of
    /// variance `before`, which is 0 if there are none. Strata with less variance have more weight.
    pub fn weight(&self, before: f64, wave: u32) -> f64 {
        match before > 0.0 {
            true => before / (before + self.variance(wave)),
            false => 1.0,
        }
    }

    /// Returns the variance of the combination.
    pub fn joined(&self, before: f64, wave: u32) -> f64 {
        self.weight(before, wave) * self.variance(wave)
    }
}

/// Buffers of one thread.
#[derive(Debug, Default)]
pub(crate) struct Strata {
    hits: Vec<Option<Hit>>,
    /// Positions of the hits, lifted off the surface.
    lifted: Vec<Vec3>,
    range_m: Vec<f64>,
    /// `[sample][spot]`, for the spots of the sample's ray.
    weights: Vec<f32>,
    /// Index of the stratum that each block samples twice. The extra samples come after all others.
    twice: Vec<u32>,
    segments: Segments,
    /// `[sample][spot]`: slot, and value if the spot is visible.
    found: Vec<(u32, f32)>,
}

impl Strata {
    /// Adds one pixel's two-bounce samples to `blocks` and returns the number of strata. `side` is
    /// even.
    pub fn sample_pixel(
        &mut self,
        walk: &Walk,
        film: &Film,
        (row, col, side): (u32, u32, u32),
        rng: &mut Rng,
        scratch: &mut Scratch,
        blocks: &mut Blocks,
    ) -> u32 {
        let (world, emitters) = (walk.world, walk.emitters);
        let rays = emitters.rays.len();
        let spots = emitters.rays.iter().map(ExactSizeIterator::len).max();
        let (count, spots) = ((side * side) as usize, spots.unwrap_or(0));
        // The ray of the first sample.
        let first = match rays {
            1 => 0,
            _ => (rng.uniform() * rays as f32) as usize,
        };
        let ray = |sample: usize| &emitters.rays[(first + sample) % rays];
        self.hits.clear();
        self.lifted.clear();
        self.range_m.clear();
        let samples = count + count / 4;
        self.weights.clear();
        self.weights.resize(samples * spots, 0.0);
        self.found.clear();
        self.found.resize(samples * spots, (0, 0.0));
        self.twice.clear();
        let choice = (0..count / 4).map(|_| ((4.0 * rng.uniform()) as u32).min(3));
        self.twice.extend(choice);
        for (sample, weights) in self.weights.chunks_mut(spots).enumerate() {
            let stratum = match sample.checked_sub(count) {
                None => sample,
                Some(block) => 4 * block + self.twice[block] as usize,
            };
            // Four consecutive strata form a block: two above, two below.
            let (block, corner) = (stratum as u32 / 4, stratum as u32 % 4);
            let a = (2 * (block % (side / 2)) + corner % 2) as f32 + rng.uniform();
            let b = (2 * (block / (side / 2)) + corner / 2) as f32 + rng.uniform();
            let d = world.camera_ray((row, col), (a / side as f32, b / side as f32));
            let hit = world.closest(&mut scratch.stack, Vec3::ZERO, d);
            let hit = hit.filter(|h| !h.surface.is_black());
            let (lifted, range) = hit.map_or((Vec3::ZERO, 0.0), |h| {
                let range = h.p.length();
                let all = &mut scratch.weights;
                let own = ray(sample).clone();
                // Light of the other rays does not count here.
                all.fill(0.0);
                let seen = (Seen::of(&h, -h.p / range), &h.surface);
                emitters.weights_of(own.clone(), seen, &mut scratch.plain, all);
                if h.through != 1.0 {
                    all.iter_mut().for_each(|w| *w *= h.through);
                }
                if let Some(contacts) = walk.contacts {
                    contacts.leave_out_of_two(world, &h, all);
                }
                walk.keep_in_window(h.p, world.metres(range), all);
                for (out, w) in weights.iter_mut().zip(&all[own]) {
                    *out = w * rays as f32;
                }
                (lift(h.p, h.n), range)
            });
            self.hits.push(hit);
            self.lifted.push(lifted);
            self.range_m.push(world.metres(range));
        }
        for (of_ray, range) in emitters.rays.iter().enumerate() {
            let samples = ((of_ray + rays - first) % rays..samples).step_by(rays);
            for (k, spot) in range.clone().enumerate() {
                self.segments.clear();
                for sample in samples.clone() {
                    if self.weights[sample * spots + k] > 0.0 {
                        self.segments.push(sample, self.lifted[sample]);
                    }
                }
                let from = emitters.lifted[spot];
                self.segments.trace(world, &mut scratch.stack, from);
                let e = &emitters.list[spot];
                for (sample, through) in self.segments.found() {
                    if let (Some(h), Some(through)) = (&self.hits[sample], through) {
                        let leg = world.metres((e.p - h.p).length());
                        let slot = film.slot(e.path_m + leg + self.range_m[sample]);
                        let at = sample * spots + k;
                        self.found[at] = (slot as u32, self.weights[at] * through);
                    }
                }
            }
        }
        let found = |sample: usize| {
            let row = &self.found[sample * spots..(sample + 1) * spots];
            let lit = row.iter().enumerate().filter(|(_, f)| f.1 > 0.0);
            let start = ray(sample).start;
            lit.map(move |(k, &(slot, value))| (start + k, slot as usize, value))
        };
        for (block, &twice) in self.twice.iter().enumerate() {
            for corner in 0..4 {
                let half = corner == twice as usize;
                for (spot, slot, value) in found(4 * block + corner) {
                    match half {
                        true => blocks.add_half(film, slot, value, 1.0, spot),
                        false => blocks.add(film, slot, value, spot),
                    }
                }
            }
            for (spot, slot, value) in found(count + block) {
                blocks.add_half(film, slot, value, -1.0, spot);
            }
            blocks.finish(if rng.uniform() < 0.5 { 1.0 } else { -1.0 });
        }
        count as u32
    }
}

#[cfg(test)]
mod tests {
    use crate::paths::two_bounce::Sampling;
    use crate::paths::two_bounce::strata;

    #[test]
    fn wide_pixels_have_more_strata_and_narrow_ones_nearly_as_many() {
        let of = |pixels: f32| strata(2.0 / pixels);
        assert_eq!((of(16.0), of(64.0)), (16.0, 8.0));
        // The two laws join without a step.
        assert!((of(64.1) / 8.0 - 1.0).abs() < 1e-3);
        let base = of(256.0);
        let sides = |n| {
            Sampling {
                base,
                refined: vec![],
            }
            .sides(n)
            .0
        };
        assert_eq!((sides(4), sides(8), sides(24)), (6, 6, 8));
    }

    #[test]
    fn rounds_of_strata_weigh_as_much_as_they_know() {
        let sampling = Sampling {
            base: 4.0,
            refined: vec![],
        };
        let one = sampling.joined(0.0, 64);
        assert_eq!(one, sampling.variance(64));
        let two = sampling.joined(one, 64);
        assert!((two / one - 0.5).abs() < 1e-12, "{two} {one}");
        // Few passes have few strata, which weigh less.
        let more = sampling.joined(one, 4);
        assert!(more < one && more > 0.7 * one, "{more} {one}");
        assert_eq!(sampling.sides(1), sampling.sides(8));
    }
}
