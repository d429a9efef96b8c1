//! Joins a tile's new passes with its earlier ones.

use crate::render::{
    done::TileSums,
    draws::{self, Draw},
    frame::Frame,
    image::Image,
    rounds::TilePasses,
    spread::joined_variance,
    stat::Stat,
};

impl Image {
    /// Joins a tile's new passes with its earlier ones, weighted by passes.
    pub fn join(&mut self, frame: &Frame, passes: TilePasses, done: &TileSums) {
        let TilePasses {
            tile: t,
            two_weight: two,
            more,
        } = passes;
        let (film, region, bins) = (frame.film, self.tiles[t], self.bins);
        let (spent, added) = (f64::from(self.passes), f64::from(done.passes));
        let b = match spent == 0.0 {
            true => 1.0,
            false => added / (spent + added),
        };
        let (a, stays) = (1.0 - b, 1.0 - two);
        // Converts render units to metres: every path has one 1/d² left over.
        let unit = f64::from(frame.tracer.world.scale) * f64::from(frame.tracer.world.scale);
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
        let joined = |old: f32, index: usize, x: f64| {
            let (before, after) = (
                f64::from(before[index]) * unit,
                f64::from(after[index]) * unit,
            );
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
                let index = pixel * bins + bin;
                let place = k * film.pixel() + bin + 1;
                let (h, difference) = joined(self.transient[index], place, m.multi);
                self.transient[index] = h;
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
                    s.two[index] = mean((0.0, 1.0), 0.0, f64::from(after[place]));
                    let variance = blend(of_two, square(s.two_se[index]), m.two_variance * unit2);
                    s.two_se[index] = root(variance);
                    let noise = done.two_noise(film, k, bin + 1);
                    s.two_noise[index] = mean(of_two, s.two_noise[index], noise);
                    s.multi[index] = mean((a, b), s.multi[index], m.multi);
                    s.multi_noise[index] = match alone {
                        true => (f64::from(s.multi_noise[index]) * a.sqrt()) as f32,
                        false => mean((a, b), s.multi_noise[index], done.noise(film, k, bin + 1)),
                    };
                    let old = square(s.multi_se[index]);
                    s.multi_se[index] = root(multi(old, m.multi_variance * unit2));
                }
            }
            for (g, group) in self.groups.iter_mut().enumerate() {
                for bin in 0..bins {
                    let index = pixel * bins + bin;
                    let place = k * film.pixel() + (g + 1) * film.slots + bin + 1;
                    let x = done.multi(film, k, g + 1, bin + 1);
                    group[index] = joined(group[index], place, x).0;
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
        let totals = &mut self.of_tiles[t];
        totals.draws.resize(draws::count(&region), Draw::default());
        totals.two_draws.resize(totals.draws.len(), 0.0);
        let pixels = draws::watched(&region).map(|k| {
            let (row, col) = (k / region.cols as usize, k % region.cols as usize);
            (region.row as usize + row) * self.width + region.col as usize + col
        });
        for ((draw, new), pixel) in totals.draws.iter_mut().zip(done.draws()).zip(pixels) {
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
        for (old, new) in totals.two_draws.iter_mut().zip(done.two_draws()) {
            *old = blend((stays, two), *old, new * unit2);
        }
        let (energy, spread) = done.multi_energy();
        let (energy, spread) = (energy * unit, spread.scaled(unit));
        totals.spread = totals
            .spread
            .joined((spent, totals.multi), spread, (added, energy));
        totals.multi = totals.multi * a + energy * b;
        let two_variance = done.two_energy_variance() * unit2;
        totals.two_variance = blend((stays, two), totals.two_variance, two_variance);
        let outside = done.overflow(film);
        totals.overflow.0 = totals.overflow.0 * stays + outside.0 * unit * two;
        totals.overflow.1 = totals.overflow.1 * a + outside.1 * unit * b;
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
    for &(index, v) in values {
        all[index as usize] = v;
    }
    all
}
